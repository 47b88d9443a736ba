"""URDF files: read and check links and joints; find the joints that planning does not move.

pinocchio's parser skips malformed elements and only prints a message. Therefore all elements that
planning needs are checked here first; a malformed file gives an error of one line.
"""

import copy
import logging
import math
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cvqmpt_lab.base.errors import (
    InvalidInputError,
    few,
    located,
    require_choice,
    shown,
    similar,
    unique,
)
from cvqmpt_lab.base.files import read_xml, xml_root
from cvqmpt_lab.base.modules import require_code_allowed
from cvqmpt_lab.base.values import FULL_TURN_RAD, other_units, scalar
from cvqmpt_lab.robot.robot import Follower, HeldJoint


@dataclass(frozen=True)
class Joint:
    """One joint of a URDF."""

    name: str
    kind: str  # "revolute", "prismatic", "continuous", "fixed", "floating" or "planar"
    parent: str  # link
    child: str  # link
    lower: float  # [rad or m]; nan if the file states none
    upper: float  # [rad or m]; nan if the file states none
    mimics: str | None  # joint m that it follows, q = multiplier * q_m + offset, or None
    multiplier: float
    offset: float  # [rad or m]
    # of <safety_controller>, inside which a controller brakes [rad or m]; nan if not stated
    soft_lower: float = math.nan
    soft_upper: float = math.nan

    @property
    def immovable_reason(self) -> str | None:
        """Reason why planning cannot move the joint; None if it can."""
        if self.mimics is not None:
            return f"mimics {self.mimics}"
        if self.kind not in ("revolute", "prismatic", "continuous"):
            return f"is {self.kind}"
        finite = math.isfinite(self.lower) and math.isfinite(self.upper)
        if self.kind != "continuous" and math.isnan(self.lower) and math.isnan(self.upper):
            return "has no <limit>"
        if self.kind != "continuous" and not (finite and self.lower < self.upper):
            return f"has limits [{self.lower:g}, {self.upper:g}]"
        return None

    @property
    def neutral(self) -> float:
        """Value nearest to 0 inside the limits [rad or m]; 0 without limits."""
        return min(max(0.0, self.lower), self.upper) if self.lower <= self.upper else 0.0


@dataclass(frozen=True, eq=False)
class Urdf:
    """The content of a URDF file, whose links and joints form a tree."""

    path: Path
    root: ElementTree.Element
    links: tuple[str, ...]
    joints: Mapping[str, Joint]  # by name
    included: tuple[str, ...] = ()  # files that a xacro file includes
    notes: tuple[str, ...] = ()  # what was ignored

    def chain(self, link: str) -> list[Joint]:
        """Return the joints from the base to a link, in this order."""
        joint_above = {joint.child: joint for joint in self.joints.values()}
        chain: list[Joint] = []
        while link in joint_above:
            chain.append(joint_above[link])
            link = joint_above[link].parent
        return chain[::-1]

    def likely_end_effectors(self, least_arm: int = 3) -> list[str]:
        """Return the last links of the chains with the most movable joints, tool frames first.

        A link that carries several moving joints, after at least `least_arm` movable joints, is
        taken as a hand and listed instead of its fingers.
        """
        moving = Counter(joint.parent for joint in self.joints.values() if joint.kind != "fixed")
        parents = {joint.parent for joint in self.joints.values()}
        joints_before: dict[str, int] = {}
        for leaf in (link for link in self.links if link not in parents):
            movable, has_hand = 0, False
            for joint in self.chain(leaf):
                if moving[joint.parent] > 1 and movable >= least_arm:
                    joints_before[joint.parent] = movable
                    has_hand = True
                movable += joint.immovable_reason is None
            if not has_hand:
                joints_before[leaf] = movable
        most = max(joints_before.values(), default=0)
        likely = [link for link, count in joints_before.items() if count == most]
        return sorted(likely, key=lambda link: not re.search("tool|tcp", link, re.IGNORECASE))


def read_urdf(path: Path, package_dirs: Sequence[Path | str] = ()) -> Urdf:
    """Read a URDF or xacro file; InvalidInputError if it is malformed or no tree of joints.

    xacro expands a file only after `allow_code`; definitions that nothing uses are ignored.

    Args:
        path: the file.
        package_dirs: folders of the packages that a xacro file names, or folders that hold them.
    """
    root, included = read_xml(path, "URDF"), tuple[str, ...]()
    invalid = f"{path} does not contain a valid URDF"
    notes = _without_unused_xacro(root, path)
    if _needs_xacro(root):
        (root, included), notes = _expanded(path, package_dirs), ()
    if root.tag != "robot":
        raise InvalidInputError(f"{invalid}: its root is <{root.tag}>, not <robot>")
    if not root.get("name"):
        raise InvalidInputError(f"{invalid}: its <robot> has no name")
    links = tuple(link.get("name", "") for link in root.findall("link"))
    joints = [_joint(element, path) for element in root.findall("joint")]
    _check_tree(path.name, links, joints)
    return Urdf(path, root, links, {joint.name: joint for joint in joints}, included, notes)


def _needs_xacro(element: ElementTree.Element) -> bool:
    """Return whether an element or one inside it belongs to xacro, or has ${...} or $(...)."""
    return any(
        part.tag.startswith("xacro:") or re.search(r"\$[({]", " ".join(part.attrib.values()))
        for part in element.iter()
    )


def _without_unused_xacro(root: ElementTree.Element, path: Path) -> tuple[str, ...]:
    """Remove definitions of xacro if the rest of the file needs no xacro; return a note on them.

    Nothing uses a property, an argument or a macro in a file without ${...}, $(...) and calls.
    """
    definitions = ("xacro:property", "xacro:arg", "xacro:macro")
    found = [(parent, part) for parent in root.iter() for part in parent if part.tag in definitions]
    if not found:
        return ()
    plain = copy.deepcopy(root)
    for parent in list(plain.iter()):
        for part in [part for part in parent if part.tag in definitions]:
            parent.remove(part)
    # macros were once called without the prefix
    called = {part.get("name", "").removeprefix("xacro:") for _, part in found}
    if _needs_xacro(plain) or any(part.tag in called for part in plain.iter()):
        return ()
    root[:] = plain[:]
    names = [f"<{part.tag} name={shown(part.get('name', ''))}>" for _, part in found]
    return (f"{path.name}: elements of xacro that nothing uses are ignored: {few(names)}",)


def _expanded(
    path: Path, package_dirs: Sequence[Path | str]
) -> tuple[ElementTree.Element, tuple[str, ...]]:
    """Return the root of a xacro file, expanded, and the files that it includes."""
    by_hand = f"expand it by hand: xacro {path.name} > expanded.urdf"
    require_code_allowed(
        f"{path} needs xacro, whose expressions can run any command", f"{by_hand}, and give that"
    )
    try:
        import xacro  # both are optional
        from xacrodoc import packages  # makes xacro find packages without ROS
    except ImportError as error:
        raise InvalidInputError(
            f"{path} has unexpanded elements of xacro: pip install xacrodoc, which expands it; or "
            f"with ROS: xacro {path.name} > expanded.urdf"
        ) from error
    places = [*path.resolve().parents[:4], *map(Path, package_dirs)]
    known = {place.name: place for place in places if (place / "package.xml").is_file()}
    beside = [file.parent for place in places for file in place.glob("*/package.xml")]
    packages.update_package_cache({**{place.name: place for place in beside}, **known})
    packages.walk_up_from(path)
    xacro.all_includes.clear()
    try:
        text = xacro.process_file(str(path)).toxml()
    except Exception as error:  # a file evaluates expressions of Python
        said = " ".join(str(getattr(error, "exc", None) or error).split())
        raise InvalidInputError(
            f"cannot expand {path}: {said}; --package-dir names folders of packages; with "
            f"arguments, expand it by hand: xacrodoc {path.name} NAME:=VALUE -o expanded.urdf"
        ) from error
    return xml_root(text, f"URDF expanded from {path}"), tuple(dict.fromkeys(xacro.all_includes))


def _joint(element: ElementTree.Element, path: Path) -> Joint:
    """Read a joint; errors name it."""
    # stands for elements that the file does not have
    nothing = ElementTree.Element("nothing")
    parts = {part.tag: part for part in reversed(element)}
    parent, child, limit, mimic, safety = (
        parts.get(tag, nothing)
        for tag in ("parent", "child", "limit", "mimic", "safety_controller")
    )

    def number(part: ElementTree.Element, attribute: str, default: float) -> float:
        text = part.get(attribute)
        try:
            if text is not None and (text.split() != [text] or "_" in text):
                raise ValueError  # Python reads them as numbers, pinocchio does not
            return default if text is None else float(text)
        except ValueError as error:
            raise InvalidInputError(f"{attribute} is {shown(text)}, not a number") from error

    with located(f"joint {shown(element.get('name', ''))} of {path.name}"):
        limits = ("lower", "upper", "velocity", "effort")
        for attribute in limit.attrib:
            # files have private attributes, too; a misspelled limit would count as 0
            if attribute not in limits and similar(attribute, limits, 0.8):
                require_choice("attribute of its <limit>", attribute, limits)
        for attribute in ("velocity", "effort"):
            value = number(limit, attribute, 0.0)
            if not (value >= 0.0 or value == -1.0):  # -1 and infinity stand for no limit
                raise InvalidInputError(
                    f"{attribute} is {value:g}; give a number of 0 or more, 0 if it is not known"
                )
        # a <limit> without lower or upper means 0, by the URDF format
        unstated = math.nan if limit is nothing else 0.0
        known = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
        require_choice("type", element.get("type"), known)
        if mimic is not nothing and not mimic.get("joint"):
            raise InvalidInputError('its <mimic> names no joint; give joint="NAME"')
        for attribute in mimic.attrib:
            require_choice("attribute of its <mimic>", attribute, ("joint", "multiplier", "offset"))
        joint = Joint(
            name=element.get("name", ""),
            kind=element.get("type", ""),
            parent=parent.get("link", ""),
            child=child.get("link", ""),
            lower=number(limit, "lower", unstated),
            upper=number(limit, "upper", unstated),
            mimics=None if mimic is nothing else mimic.get("joint", ""),
            multiplier=number(mimic, "multiplier", 1.0),
            offset=number(mimic, "offset", 0.0),
            soft_lower=number(safety, "soft_lower_limit", math.nan),
            soft_upper=number(safety, "soft_upper_limit", math.nan),
        )
        if not (math.isfinite(joint.multiplier) and math.isfinite(joint.offset)):
            raise InvalidInputError(
                f"its <mimic> has multiplier {joint.multiplier} and offset {joint.offset}; give "
                "finite numbers"
            )
        return joint


def _check_tree(file: str, links: Sequence[str], joints: Sequence[Joint]) -> None:
    """Refuse names used twice, links that do not exist, two roots or none, and loops."""
    unique(links, f"links of {file}")
    unique((joint.name for joint in joints), f"joints of {file}")
    joints_above: dict[str, list[str]] = {link: [] for link in links}
    links_below: dict[str, list[str]] = {link: [] for link in links}
    for joint in joints:
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links_below:
                raise InvalidInputError(
                    f"joint {shown(joint.name)} of {file}: its {role} {shown(link)} is not a link"
                )
        joints_above[joint.child].append(joint.name)
        links_below[joint.parent].append(joint.child)
        if len(joints_above[joint.child]) > 1:
            raise InvalidInputError(
                f"link {shown(joint.child)} of {file} is the child of "
                f"{_listed(joints_above[joint.child])}: a link has one parent"
            )
    reached = [link for link in links if not joints_above[link]]
    if len(reached) != 1:
        raise InvalidInputError(
            f"{file} needs one base link, no joint's child; it has {_listed(reached) or 'none'}"
        )
    # the list grows during the loop, until all links below the root are in it
    for link in reached:
        reached += links_below[link]
    loose = [link for link in links if link not in reached]
    if loose:
        raise InvalidInputError(
            f"links {_listed(loose)} of {file} are not connected to the base link: their joints "
            "form a loop"
        )


def _listed(names: Sequence[str], most: int = 8) -> str:
    return ", ".join(map(shown, names[:most]))


def held_joints(
    urdf: Urdf, end_effectors: Sequence[str], locked: Mapping[str, float], base_given: bool
) -> tuple[tuple[HeldJoint, ...], tuple[Follower, ...]]:
    """Return the joints that planning does not move, and the joints that follow a planned one.

    Planned are the joints of the chains from the base to the end effectors, and the joints that
    those mimic. Locked joints and all others are held.

    Args:
        urdf: content of the URDF.
        end_effectors: links at the ends of the chains, which begin at the base.
        locked: values [rad or m] of joints to hold, by name.
        base_given: whether the pose of the base is given; floating joints are then held, too.

    Returns:
        Both kinds of joints in the order of the file.

    Raises:
        UnknownChoiceError: the URDF has no link or joint of this name.
        InvalidInputError: a joint can be neither moved nor held (the message has options that
            help), or no joint is left to move.
    """
    for name in end_effectors:
        require_choice("end-effector frame", name, urdf.links)
    movable = {joint.name: joint for joint in urdf.joints.values() if joint.kind != "fixed"}
    held = {name: _lock(urdf, movable, name, value) for name, value in locked.items()}
    chains = {name: {joint.name for joint in urdf.chain(name)} for name in end_effectors}
    chain = set[str]().union(*chains.values())
    free = {name: joint for name, joint in movable.items() if name not in held}
    follows = {
        name: _followed(urdf, name, held)
        for name, joint in free.items()
        if joint.mimics is not None
    }
    planned = {follows[name].leader if name in follows else name for name in chain}
    followers = dict[str, Follower]()
    # joints that mimic come last: the joint that they follow decides whether they are held
    for name, joint in sorted(free.items(), key=lambda item: item[0] in follows):
        if name in follows:
            found = follows[name]
            leader = held.get(found.leader)
            turns_or_slides = joint.kind in ("revolute", "prismatic", "continuous")
            if found.leader in planned & free.keys() and turns_or_slides and leader is None:
                followers[name] = found
                continue
            lost = found.leader not in urdf.joints
            if (lost and name in chain) or (leader is None and found.leader in free):
                continue
            value = found.multiplier * (leader.value if leader else 0.0) + found.offset
            if lost:  # nothing moves it, and nothing says where it stands
                value = joint.neutral
            held[name] = HeldJoint(name, value, f"mimics {joint.mimics}")
        elif name not in planned:
            reason = "not between the base and the end effector"
            held[name] = HeldJoint(name, joint.neutral, reason)
        elif joint.kind == "floating" and base_given:
            held[name] = HeldJoint(name, 0.0, "the base is given")
    left = [joint for name, joint in free.items() if name not in held and name not in followers]
    offending = [joint for joint in left if joint.immovable_reason]
    # a joint follows when the joint that it mimics is held
    wrong = {joint.name for joint in offending if joint.name not in follows}
    offending = [j for j in offending if j.name in wrong or follows[j.name].leader not in wrong]
    if offending:
        floats = any(joint.kind == "floating" for joint in offending)
        raise InvalidInputError(
            f"joints of {urdf.path.name} that cannot be planned for: "
            + ", ".join(f"{joint.name!r} {joint.immovable_reason}" for joint in offending)
            + "; hold them: "
            + " ".join(f"--lock {joint.name}={joint.neutral:g}" for joint in offending)
            + (", or place the base: --base X,Y,Z" if floats else "")
        )
    for end_effector, joints in chains.items():
        if not joints & movable.keys() - held.keys():
            if not movable:
                raise InvalidInputError(
                    f"no joint of {urdf.path.name} moves, it has {len(urdf.joints)} fixed ones: "
                    "give the URDF of an arm"
                )
            raise InvalidInputError(
                f"no joint of {urdf.path.name} moves {end_effector!r}; end effectors it may have: "
                + ", ".join(urdf.likely_end_effectors())
            )
    for name in locked:
        _warn_of_lock(urdf, held[name], {k: joint for k, joint in held.items() if k != name})
    return (
        tuple(held[name] for name in movable if name in held),
        tuple(followers[name] for name in movable if name in followers),
    )


def _lock(urdf: Urdf, movable: Mapping[str, Joint], name: str, value: float) -> HeldJoint:
    """Return a joint that is held at a value [rad or m] by its name."""
    require_choice("joint to lock", name, movable)
    number = scalar(float, value, f"locked value [rad or m] of joint {name!r}")
    if movable[name].kind != "prismatic" and abs(number) > FULL_TURN_RAD:
        raise InvalidInputError(
            f"joint {name!r} cannot be locked at {number:g} rad, more than 2 pi: "
            f"{other_units([number])}"
        )
    lower, upper = movable[name].lower, movable[name].upper
    # equal limits are placeholders
    limited = movable[name].kind in ("revolute", "prismatic") and lower < upper
    if limited and not lower - 1e-6 <= number <= upper + 1e-6:
        raise InvalidInputError(
            f"joint {name!r} cannot be locked at {number:g}, outside its limits [{lower:g}, "
            f"{upper:g}] in {urdf.path.name}: give a value inside [rad or m], or correct its "
            "<limit>"
        )
    return HeldJoint(name, number, "locked by name")


def _warn_of_lock(urdf: Urdf, lock: HeldJoint, held: Mapping[str, HeldJoint]) -> None:
    """Warn where a locked joint would have another value by its <mimic>.

    held: the other joints that are held.
    """
    joint = urdf.joints[lock.name]
    if joint.mimics is None or joint.mimics not in urdf.joints:
        return
    found = _followed(urdf, lock.name, held)
    leader = held.get(found.leader)
    follows = f"{found.multiplier:g} * {found.leader} {found.offset:+g}"
    if leader is None:
        instead = f"follow {follows}"
    elif abs(found.multiplier * leader.value + found.offset - lock.value) > 1e-6:
        instead = f"stand at {follows} = {found.multiplier * leader.value + found.offset:g}"
    else:
        return
    logging.getLogger("cvqmpt").warning(
        f"{urdf.path.name}: joint {lock.name!r} is locked at {lock.value:g}, where its link "
        f"{joint.child!r} stays; without this lock it would {instead}"
    )


def _followed(urdf: Urdf, name: str, held: Mapping[str, HeldJoint]) -> Follower:
    """Return what a mimicking joint follows: the first joint of the chain that mimics none.

    A joint in `held` ends the chain, too.
    """
    joint, multiplier, offset, seen = urdf.joints[name], 1.0, 0.0, [name]
    while joint.mimics is not None and (joint.name not in held):
        offset += multiplier * joint.offset
        multiplier *= joint.multiplier
        if joint.mimics in seen:
            raise InvalidInputError(
                f"joints of {urdf.path.name} mimic each other in a circle: "
                f"{' -> '.join([*seen, joint.mimics])}; remove one <mimic>"
            )
        seen.append(joint.mimics)
        if joint.mimics not in urdf.joints:
            break
        joint = urdf.joints[joint.mimics]
    return Follower(name, seen[-1], multiplier, offset)


def check_turns(urdf: Urdf, planned: Sequence[str]) -> None:
    """Refuse planned hinges whose limits are degrees, or stand for no limits."""
    most, endless = 4.0, 1e4  # turns from the lower to the upper limit
    for joint in (urdf.joints[name] for name in planned):
        turns = (joint.upper - joint.lower) / FULL_TURN_RAD
        if joint.kind == "revolute" and turns > most:
            why = f"{turns:.0f} turns: degrees?" if turns < endless else "as if without limits:"
            raise InvalidInputError(
                f"joint {joint.name!r} of {urdf.path.name} turns from {joint.lower:g} to "
                f"{joint.upper:g} rad, {why} Give limits in radians, make it "
                f"continuous, or hold it: --lock {joint.name}={joint.neutral:g}"
            )


def one_coordinate_a_joint(urdf: Urdf) -> ElementTree.Element:
    """Return a copy of the URDF in which every joint has one coordinate or is fixed.

    Continuous joints become revolute with limits -2 pi and 2 pi; floating and planar joints become
    fixed.
    """
    root = copy.deepcopy(urdf.root)
    for element in root.findall("joint"):
        kind = element.get("type")
        if kind == "continuous":
            limit = element.find("limit")
            if limit is None:
                limit = ElementTree.SubElement(element, "limit")
            # pinocchio needs velocity and effort; a continuous joint may leave them out
            given = {"velocity": "0", "effort": "0"} | limit.attrib
            limit.attrib.update(
                given | {"lower": repr(-FULL_TURN_RAD), "upper": repr(FULL_TURN_RAD)}
            )
            element.set("type", "revolute")
        elif kind in ("floating", "planar"):
            element.set("type", "fixed")
    return root
