"""Links, joints and collision bodies of a URDF, checked before pinocchio parses it:
its errors name too little.
"""

import copy
import math
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import NamedTuple

from cvqmpt_lab.codec.plain import located
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError, shown
from cvqmpt_lab.files import read_text, require_regular_file

TURN = 2.0 * math.pi  # [rad] a continuous joint turns by up to this much either way
LEAST_ARM = 3  # joints after which a link that carries several moving ones is taken for a hand


@dataclass(frozen=True)
class Joint:
    """One joint of a URDF."""

    name: str
    kind: str  # "revolute", "prismatic", "continuous", "fixed", "floating" or "planar"
    parent: str  # link
    child: str  # link
    lower: float  # [rad or m]; nan if the file states none
    upper: float  # [rad or m]; nan if the file states none
    mimics: str | None  # joint whose value, times `multiplier` plus `offset`, it takes
    multiplier: float
    offset: float  # [rad or m]

    @property
    def hindrance(self) -> str | None:
        """Why planning cannot move it, or None."""
        if self.mimics is not None:
            return f"mimics {self.mimics}"
        if self.kind not in ("revolute", "prismatic", "continuous"):
            return f"is {self.kind}"
        finite = math.isfinite(self.lower) and math.isfinite(self.upper)
        if self.kind != "continuous" and not (finite and self.lower < self.upper):
            return f"has limits [{self.lower:g}, {self.upper:g}]"
        return None

    @property
    def neutral(self) -> float:
        """The value nearest to 0 inside the limits [rad or m]."""
        return min(max(0.0, self.lower), self.upper) if self.lower <= self.upper else 0.0


class HeldJoint(NamedTuple):
    """A joint that planning does not move."""

    name: str
    value: float  # [rad or m]
    reason: str


@dataclass(frozen=True, eq=False)
class Urdf:
    """A file whose links and joints form a tree."""

    path: Path
    root: ElementTree.Element
    links: tuple[str, ...]
    joints: Mapping[str, Joint]

    @property
    def movable(self) -> list[str]:
        """Names of all joints that are not fixed."""
        return [joint.name for joint in self.joints.values() if joint.kind != "fixed"]

    def chain(self, link: str) -> list[Joint]:
        """Joints from the base to a link."""
        above = {joint.child: joint for joint in self.joints.values()}
        chain: list[Joint] = []
        while link in above:
            chain.append(above[link])
            link = above[link].parent
        return chain[::-1]

    @property
    def likely_end_effectors(self) -> list[str]:
        """Links at the ends of the chains with the most joints:
        tool frames first, the hand rather than its fingers.
        """
        stands_on = Counter(joint.parent for joint in self.joints.values() if joint.kind != "fixed")
        parents = {joint.parent for joint in self.joints.values()}
        joints_before: dict[str, int] = {}
        for leaf in (link for link in self.links if link not in parents):
            end, moved = leaf, 0
            for joint in self.chain(leaf):
                if stands_on[joint.parent] > 1 and moved >= LEAST_ARM:
                    joints_before[joint.parent] = moved
                    end = joint.parent
                moved += joint.hindrance is None
            if end == leaf:
                joints_before[leaf] = moved
        most = max(joints_before.values(), default=0)
        likely = [link for link, count in joints_before.items() if count == most]
        return sorted(likely, key=lambda link: not re.search("tool|tcp", link, re.IGNORECASE))


def read_urdf(path: Path) -> Urdf:
    """Read a URDF file; InvalidInputError if its links and joints are no tree."""
    try:
        root = ElementTree.fromstring(read_text(require_regular_file(path, "URDF"), "URDF"))
    except ElementTree.ParseError as error:
        raise InvalidInputError(f"cannot read URDF {path}: {error}") from error
    if root.tag != "robot":
        raise InvalidInputError(
            f"{path} does not contain a valid URDF: its root is <{root.tag}>, not <robot>"
        )
    if not root.get("name"):
        raise InvalidInputError(f"{path} does not contain a valid URDF: its <robot> has no name")
    links = tuple(link.get("name", "") for link in root.findall("link"))
    joints = [_joint(element, path) for element in root.findall("joint")]
    _refuse_no_tree(path, links, joints)
    return Urdf(path, root, links, {joint.name: joint for joint in joints})


def _joint(element: ElementTree.Element, path: Path) -> Joint:
    name = element.get("name", "")

    def number(part: ElementTree.Element | None, attribute: str, default: float) -> float:
        text = None if part is None else part.get(attribute)
        try:
            return default if text is None else float(text)
        except ValueError as error:
            raise InvalidInputError(
                f"joint {shown(name)} of {path.name}: {attribute} is {shown(text)}, no number"
            ) from error

    def link(role: str) -> str:
        part = element.find(role)
        return "" if part is None else part.get("link", "")

    limit, mimic = element.find("limit"), element.find("mimic")
    for attribute in ("velocity", "effort"):
        number(limit, attribute, math.nan)
        stated = limit is None or attribute in limit.attrib
        if not stated and element.get("type") != "continuous":
            raise InvalidInputError(
                f"joint {shown(name)} of {path.name}: its <limit> states no {attribute}; URDF "
                f"needs velocity and effort"
            )
    # the format's default of a <limit> without lower or upper
    unstated = math.nan if limit is None else 0.0
    return Joint(
        name=name,
        kind=element.get("type", ""),
        parent=link("parent"),
        child=link("child"),
        lower=number(limit, "lower", unstated),
        upper=number(limit, "upper", unstated),
        mimics=None if mimic is None else mimic.get("joint", ""),
        multiplier=number(mimic, "multiplier", 1.0),
        offset=number(mimic, "offset", 0.0),
    )


def _refuse_no_tree(path: Path, links: Sequence[str], joints: Sequence[Joint]) -> None:
    """Refuse names used twice, links that do not exist, two roots or none, and rings."""
    for what, listed in (("link", links), ("joint", [joint.name for joint in joints])):
        twice = [name for name, count in Counter(listed).items() if count > 1]
        if twice:
            raise InvalidInputError(
                f"{path.name} has more than one {what} called {shown(twice[0])}: rename one"
            )
    for joint in joints:
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise InvalidInputError(
                    f"joint {shown(joint.name)} of {path.name}: its {role} {shown(link)} is no link"
                )
    children = Counter(joint.child for joint in joints)
    moved_twice = [link for link, count in children.items() if count > 1]
    if moved_twice:
        movers = [joint.name for joint in joints if joint.child == moved_twice[0]]
        raise InvalidInputError(
            f"link {shown(moved_twice[0])} of {path.name} is the child of "
            f"{', '.join(map(shown, movers[:8]))}: "
            "a link has one parent"
        )
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        found = ", ".join(map(shown, roots[:8])) or "none"
        raise InvalidInputError(f"{path.name} needs one link that no joint moves; it has {found}")
    reached, below = (
        [roots[0]],
        {link: [j.child for j in joints if j.parent == link] for link in links},
    )
    for link in reached:
        reached += below[link]
    if len(reached) < len(links):
        loose = ", ".join(map(shown, [link for link in links if link not in reached][:8]))
        raise InvalidInputError(
            f"links {loose} of {path.name} hang on no link that stands still: a ring of joints"
        )


def held_joints(
    urdf: Urdf, end_effector: str, locked: Mapping[str, float], base_given: bool
) -> tuple[HeldJoint, ...]:
    """The joints that planning does not move, with their values: those locked, and those off the
    chain.

    InvalidInputError names every joint that can be neither moved nor held, and the options that
    hold them.
    """
    if end_effector not in urdf.links:
        raise UnknownChoiceError("end-effector frame", end_effector, urdf.links)
    values = {name: _locked_value(urdf, name, value) for name, value in locked.items()}
    held = {name: HeldJoint(name, value, "as asked for") for name, value in values.items()}
    chain = {joint.name for joint in urdf.chain(end_effector)}
    followers = []
    for joint in (urdf.joints[name] for name in urdf.movable if name not in held):
        if joint.mimics is not None:
            followers.append(joint)
        elif joint.name not in chain:
            held[joint.name] = HeldJoint(
                joint.name, joint.neutral, "not between the base and the end effector"
            )
        elif joint.kind == "floating" and base_given:
            held[joint.name] = HeldJoint(joint.name, 0.0, "the base is given")
    for joint in followers:
        leader = held.get(joint.mimics or "")
        if joint.name in chain or (leader is None and joint.mimics in chain):
            continue
        value = joint.neutral if leader is None else joint.multiplier * leader.value + joint.offset
        held[joint.name] = HeldJoint(joint.name, value, f"mimics {joint.mimics}")
    offending = [urdf.joints[n] for n in urdf.movable if n not in held and urdf.joints[n].hindrance]
    if offending:
        raise InvalidInputError(
            f"joints of {urdf.path.name} that cannot be planned for: "
            + ", ".join(f"{joint.name!r} {joint.hindrance}" for joint in offending)
            + "; hold them: "
            + " ".join(f"--lock {joint.name}={joint.neutral:g}" for joint in offending)
            + (
                ", or place the base: --base X,Y,Z"
                if any(j.kind == "floating" for j in offending)
                else ""
            )
        )
    if not chain - set(held) - {j.name for j in urdf.joints.values() if j.kind == "fixed"}:
        raise InvalidInputError(
            f"no joint of {urdf.path.name} moves {end_effector!r}; end effectors it may have: "
            + ", ".join(urdf.likely_end_effectors)
        )
    return tuple(held[name] for name in urdf.movable if name in held)


def _locked_value(urdf: Urdf, name: str, value: float) -> float:
    if name not in urdf.movable:
        raise UnknownChoiceError("joint to lock", name, urdf.movable)
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(float(value)):
        raise InvalidInputError(
            f"joint {name!r} cannot be locked at {value!r}: give a finite number [rad or m]"
        )
    if urdf.joints[name].kind != "prismatic" and abs(value) > TURN:
        raise InvalidInputError(
            f"joint {name!r} cannot be locked at {value:g} rad, more than 2 pi: degrees? Give "
            f"radians"
        )
    return float(value)


def one_coordinate_a_joint(urdf: Urdf) -> ElementTree.Element:
    """The file with continuous joints limited to a turn either way, and floating and planar ones
    fixed.
    """
    root = copy.deepcopy(urdf.root)
    for element in root.findall("joint"):
        kind = element.get("type")
        if kind == "continuous":
            limit = element.find("limit")
            if limit is None:
                limit = ElementTree.SubElement(element, "limit")
            stated = {"velocity": "0", "effort": "0"} | dict(limit.attrib)
            limit.attrib.update(stated | {"lower": repr(-TURN), "upper": repr(TURN)})
        new = {"continuous": "revolute", "floating": "fixed", "planar": "fixed"}
        element.set("type", new.get(kind or "", kind or ""))
    return root


# Collision bodies: pinocchio leaves out those that it does not understand, and planning would go on
# without them.
SIZES: Mapping[str, Mapping[str, int]] = {  # numbers [m] in each attribute of a shape
    "box": {"size": 3},
    "cylinder": {"radius": 1, "length": 1},
    "sphere": {"radius": 1},
    "mesh": {},
}


def collada_unit(data: bytes) -> float:
    """The unit [m] that a COLLADA file states, 1 if none;
    InvalidInputError if it is no positive number.
    """
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


def check_bodies(root: ElementTree.Element, path: Path) -> None:
    """Refuse collision bodies, origins and axes that are malformed; errors name the link or joint."""
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
    """The `count` finite numbers of an attribute."""
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
