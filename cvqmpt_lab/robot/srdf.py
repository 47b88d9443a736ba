"""SRDF files: pairs of links that are not checked against each other."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text


@dataclass(frozen=True)
class LeftOut:
    """Two links that are not checked against each other."""

    first: str
    second: str
    reason: str
    """As in an SRDF: Adjacent, Always, Never, or what the file says."""


def read_srdf(path: Path) -> tuple[LeftOut, ...]:
    """The pairs that an SRDF file leaves out; InvalidInputError names a file that is none."""
    text = read_text(path, "SRDF file")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InvalidInputError(f"cannot read SRDF file {path}: {error}") from error
    if root.tag != "robot":
        raise InvalidInputError(f"SRDF file {path} has the root <{root.tag}>, not <robot>")
    return tuple(
        LeftOut(item.get("link1", ""), item.get("link2", ""), item.get("reason", "left out by the SRDF"))
        for item in root.findall("disable_collisions")
    )


def srdf_text(name: str, pairs: Sequence[LeftOut]) -> str:
    """An SRDF file that leaves out these pairs."""
    robot = ElementTree.Element("robot", name=name)
    for pair in pairs:
        ElementTree.SubElement(
            robot, "disable_collisions", link1=pair.first, link2=pair.second, reason=pair.reason
        )
    ElementTree.indent(robot)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(robot, encoding="unicode")}\n'
