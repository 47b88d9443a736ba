"""Collision bodies of a URDF: check them, their origins and meshes; flat ones get a thickness.

What a parser would skip without a word is refused: a body without its origin is elsewhere.
"""

import io
import math
import re
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

from cvqmpt_lab.base.errors import (
    InvalidInputError,
    few,
    located,
    require_choice,
    shown,
    similar,
)


class NumbersOf(NamedTuple):
    """Numbers that an attribute of a collision body or joint must have."""

    tag: str  # element that has the attribute
    attribute: str
    length: int  # count of numbers
    fits: Callable[[Sequence[float]], bool] = lambda _: True  # condition on the numbers
    cure: str = ""  # description of numbers that fit, for messages
    has_default: bool = False  # whether the attribute may be left out


def _not_negative(values: Sequence[float]) -> bool:
    return min(values) >= 0.0


URDF_NUMBERS = (
    NumbersOf("box", "size", 3, _not_negative, "0 or more [m]"),
    NumbersOf("cylinder", "radius", 1, _not_negative, "0 or more [m]"),
    NumbersOf("cylinder", "length", 1, _not_negative, "0 or more [m]"),
    NumbersOf("sphere", "radius", 1, _not_negative, "0 or more [m]"),
    NumbersOf("mesh", "scale", 3, all, "numbers other than 0", has_default=True),
    NumbersOf("origin", "xyz", 3, has_default=True),
    NumbersOf("origin", "rpy", 3, lambda rpy: max(map(abs, rpy)) < 7.0, "radians: degrees?", True),
    NumbersOf("mass", "value", 1, _not_negative, "0 or more [kg]"),
    NumbersOf("axis", "xyz", 3, any, "a direction"),
)


class Prepared(NamedTuple):
    """Remarks on the bodies of a URDF."""

    # links with a visual and no collision body
    bodiless: tuple[str, ...]
    # one line each, for reports
    notes: tuple[str, ...]


def prepare_bodies(root: ElementTree.Element, path: Path, visual: bool) -> Prepared:
    """Check all collision bodies, origins and axes, and bring bodies into a form with a volume.

    Placeholders, which are empty or of size 0, are removed. A flat body gets a thickness.

    Args:
        root: root element of the URDF; it is changed.
        path: its file, for messages.
        visual: whether links without a collision body get their visual bodies.

    Raises:
        InvalidInputError: a body, origin or axis is malformed; the message names link or joint.
    """
    # parts of a link; simulators read others
    known = ("inertial", "visual", "collision", "gazebo", "sensor", "contact", "material")
    of_joints = (
        *("origin", "parent", "child", "axis", "limit", "mimic", "dynamics", "safety_controller"),
        *("calibration", "gazebo", "sensor"),
    )
    placeholders, taken, bodiless, unknown = list[str](), list[str](), list[str](), list[str]()
    for link in root.findall("link"):
        name = link.get("name", "")
        with located(path.name):
            unknown += _unknown_parts(link, known, 3)
        with located(f"link {shown(name)} of {path.name}, inertial"):
            _check_numbers([*link.findall("inertial/mass"), *link.findall("inertial/origin")])
        for body in link.findall("collision"):
            if not _is_body(body, f"link {shown(name)} of {path.name}, collision"):
                link.remove(body)
                placeholders.append(name)
        visuals = [] if link.findall("collision") else link.findall("visual")
        if visual:
            for body in visuals:
                body.tag = "collision"
                if not _is_body(body, f"link {shown(name)} of {path.name}, visual"):
                    link.remove(body)
        if visuals:
            (taken if visual else bodiless).append(name)
    for joint in root.findall("joint"):
        with located(path.name):
            unknown += _unknown_parts(joint, of_joints, 6)
        axes = [] if joint.get("type") == "fixed" else joint.findall("axis")
        with located(f"joint {shown(joint.get('name'))} of {path.name}"):
            _check_numbers([*joint.findall("origin"), *axes])
    remarks = {
        "without size, no body": placeholders,
        "visual bodies are taken": taken,
        "unknown and skipped": unknown,
    }
    notes = (f"{what}: {few(names)}" for what, names in remarks.items() if names)
    return Prepared(tuple(bodiless), tuple(notes))


def _unknown_parts(
    item: ElementTree.Element, known: Sequence[str], offered: int, alike: float = 0.8
) -> list[str]:
    """Name parts of a link or joint that are not `known`; refuse misspelled ones.

    Without its origin or collision the robot would be elsewhere, or smaller than it is.

    Args:
        item: link or joint.
        known: tags of parts; the first `offered` of them may be misspelled.
        offered: see `known`.
        alike: similarity, from 0 to 1, from which a tag counts as misspelled.
    """
    parts = [part.tag for part in item if part.tag not in known]
    for tag in parts:
        if meant := similar(tag, known[:offered], alike):
            raise InvalidInputError(
                f"{item.tag} {shown(item.get('name'))} has an unknown part <{tag}>; did you mean "
                f"<{meant}>?"
            )
    return [f"<{tag}> of {item.get('name')}" for tag in parts]


def _is_body(body: ElementTree.Element, where: str, thinnest: float = 1e-4) -> bool:
    """Check a body; return False for a placeholder, which is empty or of size 0.

    A length of 0 beside others becomes `thinnest` [m]: solids need a volume.
    """
    known = ("box", "cylinder", "sphere", "mesh")
    # the parts after the first two change no shape
    parts = (
        *("origin", "geometry", "name", "material", "verbose", "gazebo", "surface"),
        *("contact_coefficients", "max_contacts", "bounce"),
    )
    with located(where):
        for part in body:
            if ":" not in part.tag:  # simulators' parts have a namespace
                require_choice("part", part.tag, parts)
        shapes = [shape for geometry in body.findall("geometry") for shape in geometry]
        if not shapes:
            return False
        if len(shapes) != 1:
            raise InvalidInputError(
                f"it has {len(shapes)} shapes; give one <geometry> with one of {', '.join(known)}"
            )
        shape = shapes[0]
        require_choice("shape", shape.tag, known)
        _check_numbers([shape, *body.findall("origin")])
    sizes = [name for name in ("size", "radius", "length") if name in shape.attrib]
    lengths = [float(word) for name in sizes for word in shape.get(name, "").split()]
    if shape.tag == "mesh":
        return True
    if not any(lengths):
        return False
    if not all(lengths):
        for name in sizes:
            words = [float(word) or thinnest for word in shape.get(name, "").split()]
            shape.set(name, " ".join(map(repr, words)))
    return True


def _check_numbers(elements: Sequence[ElementTree.Element]) -> None:
    """Refuse elements whose attributes do not have the numbers that `URDF_NUMBERS` demands.

    They have no other attributes: a rotation in another form, or a unit, would be left out.
    """
    for element in elements:
        known = [one.attribute for one in URDF_NUMBERS if one.tag == element.tag]
        known += ["filename"] if element.tag == "mesh" else []
        for name in element.attrib:
            require_choice(f"attribute of its {element.tag}", name, known)
    for element, wanted in product(elements, URDF_NUMBERS):
        text = element.get(wanted.attribute, "")
        stated = wanted.attribute in element.attrib
        if element.tag != wanted.tag or (wanted.has_default and not stated):
            continue
        what = f"{wanted.attribute} of its {wanted.tag} is {shown(text)}"
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        # Python reads 1_0 as a number
        if len(values) != wanted.length or not all(map(math.isfinite, values)) or "_" in text:
            raise InvalidInputError(
                f"{what}; it must be {wanted.length} finite numbers"
                + (", separated by blanks" if wanted.length > 1 else "")
            )
        if not wanted.fits(values):
            raise InvalidInputError(f"{what}; give {wanted.cure}")


def collada_unit(data: bytes) -> float:
    """Return the unit [m] that a COLLADA file states, 1 without one; refuse one that is not > 0.

    Files with content that coal's or trimesh's readers leave out are refused, too: the body would
    be smaller than it is.
    """
    if zipfile.is_zipfile(io.BytesIO(data)) or b"\0" in data[:100]:
        raise InvalidInputError("it is an archive or no UTF-8 text; give the text of the DAE file")
    data = re.sub(rb"(?s)<!--.*?-->", b"", data)
    if b"<!ENTITY" in data:
        raise InvalidInputError("it declares entities (<!ENTITY), which could grow; write them out")
    known = set(re.findall(rb"<geometry\b[^>]*?\bid\s*=\s*[\"']([^\"']*)", data))
    for name in re.findall(rb"<instance_geometry\b[^>]*?\burl\s*=\s*[\"']([^\"']*)", data):
        if name[:1] != b"#" or name[1:] not in known:
            raise InvalidInputError(
                f"its scene has the geometry {shown(name.decode(errors='replace'))}, which the "
                "file does not contain; export it again with all geometry in one file"
            )
    left_out = {
        "instance_controller": "skinned or morphed geometry",
        "ph": "polygons with holes",
        "skew": "a skewed node",
    }
    for tag, what in left_out.items():
        if re.search(rf"<{tag}\b".encode(), data):
            raise InvalidInputError(
                f"it has {what} (<{tag}>), which is not read; export it again as plain triangles"
            )
    stated = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']*)", data)
    if stated is None:
        return 1.0
    try:
        unit = float(stated[1])
    except ValueError:
        unit = math.nan
    if not 0.0 < unit < math.inf:
        text = stated[1].decode(errors="replace")
        raise InvalidInputError(f"its unit is {shown(text)} m; give a positive number")
    return unit
