"""Collision bodies and placements of a URDF, read before the parser that leaves out what it does not understand."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

from cvqmpt_lab.codec.plain import located
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, shown

SIZES: Mapping[str, Mapping[str, int]] = {
    "box": {"size": 3},
    "cylinder": {"radius": 1, "length": 1},
    "sphere": {"radius": 1},
    "mesh": {},
}
"""Shapes, with how many positive numbers [m] each of their attributes must be."""


def check_bodies(root: ElementTree.Element, path: Path) -> None:
    """Refuse a link one of whose collision bodies is not understood, as planning would go on without it, and a joint
    whose origin or axis is none.

    Raises
    ------
    InvalidInputError, UnknownChoiceError
        Naming the link or joint and what is wrong.
    """
    for link in root.findall("link"):
        for body in link.findall("collision"):
            with located(f"link {shown(link.get('name'))} of {path.name}, collision"):
                _check_body(body)
    for joint in root.findall("joint"):
        with located(f"joint {shown(joint.get('name'))} of {path.name}"):
            _check_origins(joint)
            for axis in joint.findall("axis") if joint.get("type") != "fixed" else ():
                if not any(_numbers(axis, "xyz", 3)):
                    raise InvalidInputError("its axis is 0 0 0; give a direction")


def _check_body(body: ElementTree.Element) -> None:
    shapes = [shape for geometry in body.findall("geometry") for shape in geometry]
    if len(shapes) != 1:
        raise InvalidInputError(
            f"it has {len(shapes)} shapes; give one <geometry> with one of {', '.join(SIZES)}"
        )
    shape = shapes[0]
    if shape.tag not in SIZES:
        raise UnknownChoiceError("shape", shape.tag, SIZES)
    for name, count in SIZES[shape.tag].items():
        sizes = _numbers(shape, name, count)
        if not all(size > 0.0 for size in sizes):
            raise InvalidInputError(f"{name} of its {shape.tag} is {sizes}; give more than 0 [m]")
    if shape.get("scale") is not None and 0.0 in _numbers(shape, "scale", 3):
        raise InvalidInputError("scale of its mesh is 0; give other numbers")
    _check_origins(body)


def _check_origins(element: ElementTree.Element) -> None:
    for origin in element.findall("origin"):
        for name in set(origin.keys()) & {"xyz", "rpy"}:
            _numbers(origin, name, 3)


def _numbers(element: ElementTree.Element, name: str, count: int) -> list[float]:
    """So many finite numbers of an attribute."""
    text = element.get(name, "")
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)) or "_" in text:
        raise InvalidInputError(
            f"{name} of its {element.tag} is {shown(text)}; it must be {count} finite numbers"
        )
    return numbers
