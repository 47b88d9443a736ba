"""pinocchio's models of a URDF, from the parts of the file that planning needs.

pinocchio's parser checks all parts of a file. It drops a link with its mass and bodies if a visual
or an inertial part of it is malformed, and a whole file for a part of a joint: an empty <dynamics>,
a <safety_controller> without k_velocity. Parts that planning does not need are taken out before.
"""

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pinocchio as pin

from cvqmpt_lab.base.errors import InvalidInputError, few

PLACES = ("origin", "parent", "child")
MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def parsed(root: ElementTree.Element, file: Path | str) -> tuple[pin.Model, pin.GeometryModel]:
    """Return pinocchio's models of joints and of collision bodies.

    root: root element of the URDF, after `keep_needed_parts`. file: for messages.
    """
    text = ElementTree.tostring(root, encoding="unicode")
    try:
        model = pin.buildModelFromXML(text)
        geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        said = " ".join(str(error).split())
        raise InvalidInputError(f"cannot load {file}: {said}") from error
    if len(geometry.geometryObjects) != len(root.findall("link/collision")):
        raise InvalidInputError(
            f"cannot load {file}: the parser skipped collision bodies, see its output above"
        )
    return model, geometry


def keep_needed_parts(root: ElementTree.Element) -> tuple[str, ...]:
    """Remove the parts of a URDF that planning does not need; complete masses and limits.

    Return a note about each kind that was completed.

    root: root element of a URDF whose joints and bodies are checked; it is changed.
    """
    root.attrib = {"name": root.get("name", "")}
    without_mass, without_moments = list[str](), list[str]()
    for element in list(root):
        if element.tag not in ("link", "joint"):
            root.remove(element)
            continue
        needed: tuple[str, ...] = ("inertial", "collision")
        if element.tag == "joint":
            needed = PLACES if element.get("type") == "fixed" else (*PLACES, "axis", "limit")
        element[:] = [part for part in element if part.tag in needed]
    for link in root.findall("link"):
        for inertial in link.findall("inertial"):
            if inertial.find("mass") is None:
                link.remove(inertial)
                without_mass.append(link.get("name", ""))
            elif _complete_moments(inertial):
                without_moments.append(link.get("name", ""))
    unlimited = [
        joint.get("name", "") for joint in root.findall("joint") if _complete_limits(joint)
    ]
    remarks = {
        "joints whose velocity or effort is not stated, -1 or infinite: no limit": unlimited,
        "have an <inertial> without mass, which counts as 0": without_mass,
        "have moments of inertia that are missing or no numbers and count as 0": without_moments,
    }
    return tuple(f"{what}: {few(names)}" for what, names in remarks.items() if names)


def _complete_limits(joint: ElementTree.Element) -> bool:
    """Complete the <limit> of a moving joint; return whether velocity or effort were no limit.

    Velocities and efforts of 0 stand for none, -1 in some files. Joints without ends are held.
    """
    if joint.get("type") == "fixed":
        return False
    limit = joint.find("limit")
    if limit is None:
        everything = {"lower": "0", "upper": "0", "velocity": "0", "effort": "0"}
        ElementTree.SubElement(joint, "limit", everything)
        return False
    none = [k for k in ("velocity", "effort") if not 0.0 <= float(limit.get(k, "nan")) < math.inf]
    limit.attrib.update({"lower": "0", "upper": "0"} | limit.attrib | dict.fromkeys(none, "0"))
    return bool(none)


def _complete_moments(inertial: ElementTree.Element) -> bool:
    """Set moments of inertia [kg m^2] that are no finite numbers to 0; return whether one was."""
    inertia = inertial.find("inertia")
    if inertia is None:
        inertia = ElementTree.SubElement(inertial, "inertia")
    lacking = [name for name in MOMENTS if not _is_number(inertia.get(name, ""))]
    for name in lacking:
        inertia.set(name, "0")
    return bool(lacking)


def _is_number(text: str) -> bool:
    """Return whether Python and pinocchio's parser read a text as the same finite number."""
    try:
        return math.isfinite(float(text)) and "_" not in text and text.split() == [text]
    except ValueError:
        return False
