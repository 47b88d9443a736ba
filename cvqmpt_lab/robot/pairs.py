"""Choice of the link pairs that are checked; pairs that overlap often; the SRDF that lists them.

An SRDF lists the pairs that are not checked. Without an SRDF, a pair is left out if its links are
fixed to each other, if they are neighbours (one joint and no other body is between them), or if
they overlap in every random configuration and where all joints are 0: no motion could be planned
if such a pair were checked. Of a concave mesh in pieces, only the pieces that overlap so are left
out. The result depends on the robot alone.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import read_xml
from cvqmpt_lab.robot.kinematics import Kinematics, link_poses
from cvqmpt_lab.robot.left_out import OVERLAP, LeftOut
from cvqmpt_lab.robot.robot import LinkGeometry, Robot
from cvqmpt_lab.robot.source import read_source
from cvqmpt_lab.robot.urdf import Urdf

SAMPLES = 2000  # number of random configurations in which a pair that is left out overlaps
CONTACT_M = 1e-6  # distance that counts as overlap; with 0, coal misses 1.3 mm
# the same for pieces of meshes: a base that stands on the middle piece of a floor is beside others
RESTING_M = 1e-3

ALWAYS = f"{OVERLAP}100 % of random states"
CUT = "."  # stands in the name of a piece of a mesh before its number

Pair = tuple[str, str]  # names of links or pieces
Numbers = tuple[int, int]  # of two pieces
Key = TypeVar("Key", Pair, Numbers)


class Bodies(NamedTuple):
    """Bodies of a robot, and its joints as arrays."""

    model: pin.Model  # pinocchio's model of the joints
    geometry: pin.GeometryModel  # pinocchio's model of the convex pieces
    links: Sequence[LinkGeometry]  # the pieces as arrays
    kinematics: Kinematics

    @property
    def pieces(self) -> dict[str, list[int]]:
        """Numbers of the pieces of each link that has some, by the link's name."""
        found: dict[str, list[int]] = {}
        for k, item in enumerate(self.geometry.geometryObjects):
            if item.parentFrame < self.model.nframes:  # the pieces of a door have no link
                found.setdefault(self.model.frames[item.parentFrame].name, []).append(k)
        return found

    def of_links(self, pairs: Iterable[Pair]) -> dict[Pair, list[Numbers]]:
        """Return the pairs of pieces of pairs of links."""
        own = self.pieces
        return {pair: [(i, k) for i in own[pair[0]] for k in own[pair[1]]] for pair in pairs}

    def names(self, numbers: Numbers) -> Pair:
        """Return the names of two pieces."""
        i, k = numbers
        return self.geometry.geometryObjects[i].name, self.geometry.geometryObjects[k].name

    @property
    def zero(self) -> np.ndarray:
        """Configuration (n,) nearest to 0 within the limits [rad or m]."""
        return np.clip(0.0, self.kinematics.lower, self.kinematics.upper)

    def states(self, count: int) -> np.ndarray:
        """Return random configurations (count, n) within the limits; always the same ones."""
        lower, upper = self.kinematics.lower, self.kinematics.upper
        return np.random.default_rng(0).uniform(lower, upper, (count, len(lower)))


def left_out_pairs(bodies: Bodies, urdf: Urdf, srdf: str, whole_links: bool) -> tuple[LeftOut, ...]:
    """Return the link pairs that are not checked: from an SRDF, else by the rule at the top.

    Args:
        bodies: those of the robot.
        urdf: content of the URDF.
        srdf: path of an SRDF, or "".
        whole_links: whether all pieces of two links are left out when any of them always overlap.
    """
    pieces = bodies.pieces
    every = list(combinations(pieces, 2))
    if srdf:
        listed = _left_out_by_srdf(srdf_root(Path(srdf)), list(pieces))
        out = {frozenset(pair[:2]) for pair in listed}
        rest = [pair for pair in every if frozenset(pair) not in out]
        return listed if whole_links else (*listed, *_overlapping_cuts(bodies, rest))
    reasons = by_structure(bodies, urdf)
    others = [pair for pair in every if pair not in reasons]
    near = CONTACT_M if whole_links else RESTING_M
    always = always_overlapping(bodies, bodies.of_links(others), SAMPLES, near)
    alone = list[LeftOut]()
    for pair in always:
        parts = [] if whole_links else _overlapping_parts(bodies, pair)
        alone += parts
        if not parts:
            reasons[pair] = ALWAYS
    return (*(LeftOut(*pair, reasons[pair]) for pair in every if pair in reasons), *alone)


def _overlapping_parts(bodies: Bodies, pair: Pair) -> list[LeftOut]:
    """Return the pairs of pieces of two links that always overlap.

    None are returned if the other pieces, too, leave no configuration free, or there are none.
    """
    both = bodies.of_links([pair])[pair]
    always = always_overlapping(bodies, {one: [one] for one in both}, SAMPLES, RESTING_M)
    rest = {pair: [one for one in both if one not in always]}
    if not rest[pair] or always_overlapping(bodies, rest, SAMPLES, RESTING_M):
        return []
    return [LeftOut(*bodies.names(one), ALWAYS) for one in always]


def _overlapping_cuts(bodies: Bodies, pairs: Sequence[Pair]) -> list[LeftOut]:
    """Return the pairs of pieces of cut meshes that always overlap: an SRDF cannot name them."""
    found = [one for both in bodies.of_links(pairs).values() for one in both]
    cut = [one for one in found if any(CUT in name for name in bodies.names(one))]
    always = always_overlapping(bodies, {one: [one] for one in cut}, SAMPLES, RESTING_M)
    return [LeftOut(*bodies.names(one), ALWAYS) for one in always]


def by_structure(bodies: Bodies, urdf: Urdf) -> dict[Pair, str]:
    """Return the pairs that are neighbours or fixed to each other, with the reason."""
    pieces, model = bodies.pieces, bodies.model
    # for each link, the next link towards the base that has pieces
    above = {
        link: next((joint.parent for joint in urdf.chain(link)[::-1] if joint.parent in pieces), "")
        for link in pieces
    }
    joints = {
        name: bodies.geometry.geometryObjects[own[0]].parentJoint for name, own in pieces.items()
    }
    reasons = {}
    for pair in combinations(pieces, 2):
        a, b = joints[pair[0]], joints[pair[1]]
        neighbours = above[pair[1]] == pair[0] or above[pair[0]] == pair[1]
        if neighbours and a in (model.parents[b], *model.children[b]):
            reasons[pair] = "adjacent"
        if a == b:
            reasons[pair] = "fixed to each other"
    return reasons


def always_overlapping(
    bodies: Bodies, pairs: Mapping[Key, Sequence[Numbers]], samples: int, near: float
) -> list[Key]:
    """Return what overlaps in all random configurations and where joints are 0.

    Most pairs are dismissed after a few configurations.

    Args:
        bodies: those of the robot.
        pairs: numbers of pairs of pieces, in groups; a group overlaps if one of its pairs does.
        samples: number of random configurations.
        near: distance that counts as overlap [m].
    """
    states = np.vstack([bodies.zero, bodies.states(samples)])
    for part in (states[:11], states[:51], states):
        hits = _touching(bodies, pairs, part, near)
        pairs = {key: pairs[key] for key, hit in hits.items() if hit.all()}
    return list(pairs)


def _left_out_by_srdf(srdf: ElementTree.Element, links: Sequence[str]) -> tuple[LeftOut, ...]:
    """Return the pairs of links that an SRDF leaves out, as MoveIt reads it.

    A link of disable_default_collisions is compared only where enable_collisions says so;
    disable_collisions counts last.
    """
    listed = tuple(
        LeftOut(
            item.get("link1", ""),
            item.get("link2", ""),
            "SRDF: " + item.get("reason", "left out by the SRDF"),
        )
        for item in srdf.findall("disable_collisions")
    )
    off, enabled = default_off(srdf)
    known = {frozenset((pair.first, pair.second)) for pair in listed}
    return listed + tuple(
        LeftOut.by_default(*pair)
        for pair in combinations(links, 2)
        if off & set(pair) and frozenset(pair) not in enabled | known
    )


def default_off(srdf: ElementTree.Element) -> tuple[set[str], set[frozenset[str]]]:
    """Return the links that an SRDF compares with nothing by default, and the enabled pairs."""
    off = {item.get("link", "") for item in srdf.findall("disable_default_collisions")}
    pairs = srdf.findall("enable_collisions")
    return off, {frozenset((item.get("link1", ""), item.get("link2", ""))) for item in pairs}


def srdf_oddities(srdf: ElementTree.Element) -> dict[str, list[str]]:
    """Return elements of an SRDF that leave no pair out though they may be meant to, by reason."""
    # elements about pairs of links, with the attributes that name these
    of_pairs = {
        "disable_collisions": ("link1", "link2"),
        "enable_collisions": ("link1", "link2"),
        "disable_default_collisions": ("link",),
    }
    # other elements, of MoveIt and of pinocchio's robots
    others = (
        *("group", "group_state", "end_effector", "virtual_joint", "passive_joint", "gripper"),
        *("joint_property", "link_sphere_approximation", "specificities", "rotor_params"),
    )
    unknown = {item.tag for item in srdf}.difference(of_pairs, others)
    lacking = [
        f"<{item.tag}> without {name}"
        for item in srdf
        for name in of_pairs.get(item.tag, ())
        if name not in item.attrib
    ]
    return {
        "elements of the SRDF that are not known and have no effect": sorted(unknown),
        "elements of the SRDF without effect": lacking,
    }


def checked_pairs(
    model: pin.Model, geometry: pin.GeometryModel, left_out: Sequence[LeftOut]
) -> tuple[tuple[int, int], ...]:
    """Set the pairs of pieces that the geometry model checks; return their indices."""
    skipped = {frozenset((pair.first, pair.second)) for pair in left_out}
    names = [model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    own = [item.name for item in geometry.geometryObjects]
    geometry.addAllCollisionPairs()
    every = [(int(pair.first), int(pair.second)) for pair in geometry.collisionPairs]
    kept = tuple(
        (i, k)
        for i, k in every
        if frozenset((names[i], names[k])) not in skipped
        and frozenset((own[i], own[k])) not in skipped
    )
    geometry.removeAllCollisionPairs()
    for i, k in kept:
        geometry.addCollisionPair(pin.CollisionPair(i, k))
    return kept


def _touching(
    bodies: Bodies, pairs: Mapping[Key, Sequence[Numbers]], states: np.ndarray, near: float
) -> dict[Key, np.ndarray]:
    """Return (k,) bool by group: is a pair closer than `near` in each of states (k, n)?"""
    model, geometry, links, kinematics = bodies
    tested = pin.GeometryModel(geometry)
    tested.removeAllCollisionPairs()
    indices = [(n, i, j) for n, group in enumerate(pairs.values()) for i, j in group]
    for _, i, j in indices:
        tested.addCollisionPair(pin.CollisionPair(i, j))
    owner, first, second = np.array(indices, dtype=int).reshape(-1, 3).T
    data, tested_data = model.createData(), pin.GeometryData(tested)
    for request in tested_data.collisionRequests:
        request.security_margin = near
    # pieces whose balls are apart need no exact check
    rotations, translations = link_poses(kinematics, states)
    centres, radii = np.empty((len(states), len(links), 3)), np.empty(len(links))
    for i, piece in enumerate(links):
        middle, radii[i] = piece.ball
        centres[:, i] = rotations[:, piece.link] @ middle + translations[:, piece.link]
    hits = np.zeros((len(states), len(pairs)), dtype=bool)
    values = kinematics.joint_values(states)
    for hit, q, centre in zip(hits, values, centres, strict=True):
        apart = np.linalg.norm(centre[first] - centre[second], axis=1)
        pin.updateGeometryPlacements(model, data, tested, tested_data, q)
        for k in np.flatnonzero(apart <= radii[first] + radii[second] + near).tolist():
            if not hit[owner[k]]:
                hit[owner[k]] = pin.computeCollision(tested, tested_data, k)
    return dict(zip(pairs, hits.T, strict=True))


def srdf_root(path: Path) -> ElementTree.Element:
    """Read an SRDF file; InvalidInputError if it is malformed."""
    root = read_xml(path, "SRDF file")
    if root.tag != "robot":
        raise InvalidInputError(f"SRDF file {path} has the root <{root.tag}>, not <robot>")
    for element in root.iter():
        if element.tag.startswith("xacro:") or "${" in " ".join(element.attrib.values()):
            raise InvalidInputError(
                f"SRDF file {path} has unexpanded elements of xacro, <{element.tag}>, whose pairs "
                f"of links would be left out: xacro {path.name} > expanded.srdf, and give that file"
            )
    return root


class Overlap(NamedTuple):
    """How often two links that are checked overlap."""

    first: str
    second: str
    share: float  # of random configurations
    at_zero: bool  # whether they overlap where all joints are 0, or as near to it as limits allow
    slide: bool  # whether one only slides against the other

    @property
    def by_design(self) -> bool:
        """Whether the links may well be nested.

        A share of 0.2 alone is usual for links that hit each other, e.g. base and upper arm of ur5.
        """
        return self.share >= 0.5 or (self.at_zero and (self.slide or self.share >= 0.2))

    def __str__(self) -> str:
        zero = " and where all joints are 0" if self.at_zero else ""
        share = f"{100.0 * self.share:.3g} % of random states"
        return f"{self.first} and {self.second} overlap in {share}{zero}"


def overlaps(robot: Robot, wanted: Pair | None = None, samples: int = 200) -> list[Overlap]:
    """Return how often checked links overlap, most often first; those that never do are left out.

    Args:
        robot: the robot.
        wanted: names of two pieces whose links alone are asked for; None: all.
        samples: number of random configurations.
    """
    bodies = bodies_of(robot)
    owner = {k: link for link, own in bodies.pieces.items() for k in own}
    names = [piece.name for piece in robot.links]
    pairs: dict[Pair, list[Numbers]] = {}
    for i, k in robot.self_collision_pairs:
        # pieces of a door have no link
        if (wanted is None or {names[i], names[k]} == {*wanted}) and {i, k} <= owner.keys():
            pairs.setdefault((owner[i], owner[k]), []).append((i, k))
    states = np.vstack([bodies.zero, bodies.states(samples)])
    hits = _touching(bodies, pairs, states, CONTACT_M)
    found = [
        Overlap(*pair, float(hit[1:].mean()), bool(hit[0]), _slide(bodies, pair))
        for pair, hit in hits.items()
    ]
    return sorted((one for one in found if one.share or one.at_zero), key=lambda one: -one.share)


def _slide(bodies: Bodies, pair: Pair) -> bool:
    """Return whether all joints between two links are prismatic."""
    objects, supports = bodies.geometry.geometryObjects, bodies.model.supports
    a, b = (set(supports[objects[bodies.pieces[link][0]].parentJoint]) for link in pair)
    return all(bodies.kinematics.prismatic[j - 1] for j in a ^ b)


def bodies_of(robot: Robot) -> Bodies:
    """Return the bodies of a robot."""
    return Bodies(robot.model, robot.collision_model, robot.links, robot.kinematics)


def cure_of_overlap(robot: Robot, pieces: Pair | None = None, most: int = 3) -> str:
    """Return which checked links overlap by design, and what leaves such pairs out; "" if none do.

    Args:
        robot: the robot.
        pieces: names of two pieces whose links alone are meant; None: all links.
        most: number of pairs that are named.
    """
    found = [one for one in overlaps(robot, pieces) if one.by_design]
    if not found:
        return ""
    more = f" and {len(found) - most} more pairs" if len(found) > most else ""
    command, own = command_of(robot), robot.source.get("srdf")
    file = (robot.name.partition("+")[0].replace("/", "_") or "robot") + ".srdf"
    begin = command
    if own:
        begin, file = f"{command} --srdf {own}", f"more_{file}"
    return (
        f"{', '.join(map(str, found[:most]))}{more}; if they are built so (a telescope, a cover), "
        f"`{begin} --out {file}` writes an SRDF that leaves out such pairs; read it, then write "
        f'"srdf": "{file}" in \'robot\' of the problem file, or `{command} --srdf {file} --out '
        "robot.json` for --robot robot.json"
    )


def command_of(robot: Robot) -> str:
    """Return the command `cvqmpt robot` with what a robot's collision bodies depend on."""
    given = read_source(robot.source)
    path = Path(given.urdf)
    near = path.is_relative_to(Path.cwd())
    words = [given.name or str(path.relative_to(Path.cwd()) if near else path)]
    words += [f"--package-dir {folder}" for folder in given.package_dirs]
    words += ["--visual-as-collision"] if given.visual_as_collision else []
    words += ["--skip-missing-meshes"] if given.skip_missing_meshes else []
    if not given.name:
        several = "s" if len(given.end_effectors) > 1 else ""
        words.append(f"--end-effector{several} {' '.join(given.end_effectors)}")
    return f"cvqmpt robot {' '.join(words)}"


def srdf_text(robot: Robot) -> str:
    """Return an SRDF that leaves out what the robot leaves out, and pairs that often overlap."""
    given = read_source(robot.source).srdf
    root = ElementTree.Element("robot", name=robot.name)
    if given:
        root = srdf_root(Path(given))
    known = {
        frozenset((item.get("link1", ""), item.get("link2", "")))
        for item in root.findall("disable_collisions")
    }
    links = bodies_of(robot).pieces
    out = [pair for pair in robot.left_out_pairs if {pair.first, pair.second} <= links.keys()]
    often = {(one.first, one.second): one for one in overlaps(robot) if one.by_design}
    out += [LeftOut(*pair, "overlap by design") for pair in often]
    for pair in out:
        if frozenset((pair.first, pair.second)) in known:
            continue
        if pair[:2] in often:
            root.append(ElementTree.Comment(f" {often[pair[:2]]} "))
        names = {"link1": pair.first, "link2": pair.second}
        ElementTree.SubElement(root, "disable_collisions", names, reason=pair.reason)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
