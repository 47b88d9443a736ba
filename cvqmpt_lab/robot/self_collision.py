"""Which pairs of links are checked against each other: all but those with a reason not to.

An SRDF names the pairs that its maker leaves out. Without one, a pair is left out if its links are
fixed to each other or neighbours (one joint moves them, and no other body lies between), or if they
overlap in nearly every random configuration. The result depends on the robot alone.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pinocchio as pin

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text
from cvqmpt_lab.robot.kinematics import Kinematics, link_poses
from cvqmpt_lab.robot.robot import LeftOut, LinkGeometry
from cvqmpt_lab.robot.urdf import Urdf

# reasons for leaving out a pair; after the last two follow the share of random states, or the
# reason of the SRDF
FIXED, ADJACENT, OVERLAP, FROM_SRDF = "fixed to each other", "adjacent", "overlap in ", "SRDF: "

Pair = tuple[str, str]


def left_out_pairs(
    model: pin.Model,
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    urdf: Urdf,
    srdf: str,
    samples: int = 2000,
    always: float = 0.95,
    spread: float = 0.15,
    few: int = 50,
    contact: float = 1e-6,
) -> tuple[LeftOut, ...]:
    """The pairs that an SRDF leaves out; without one those found by the rule above.

    Args:
        model: of the joints.
        geometry: of the pieces.
        links: the pieces as arrays.
        kinematics: arrays of the joints.
        urdf: the file.
        srdf: path of an SRDF, or "".
        samples: random configurations.
        always: share of them in which two hulls overlap because of their shapes.
        spread: by which that share may be smaller among the first `few` configurations: five
            standard deviations.
        few: configurations after which most pairs are decided.
        contact: [m] of an overlap; at 0 coal calls hulls free that overlap by 1.3 mm.
    """
    if srdf:
        return tuple(
            LeftOut(
                item.get("link1", ""),
                item.get("link2", ""),
                FROM_SRDF + item.get("reason", "left out by the SRDF"),
            )
            for item in srdf_root(Path(srdf)).findall("disable_collisions")
        )
    pieces: dict[str, list[int]] = {}
    for k, item in enumerate(geometry.geometryObjects):
        pieces.setdefault(model.frames[item.parentFrame].name, []).append(k)
    # the nearest link towards the base that has bodies
    above = {
        link: next((joint.parent for joint in urdf.chain(link)[::-1] if joint.parent in pieces), "")
        for link in pieces
    }
    joints = {name: geometry.geometryObjects[own[0]].parentJoint for name, own in pieces.items()}
    every = list(combinations(pieces, 2))
    reasons = {}
    for pair in every:
        a, b = joints[pair[0]], joints[pair[1]]
        neighbours = above[pair[1]] == pair[0] or above[pair[0]] == pair[1]
        if neighbours and a in (model.parents[b], *model.children[b]):
            reasons[pair] = ADJACENT
        if a == b:
            reasons[pair] = FIXED
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    states = np.random.default_rng(0).uniform(lower, upper, (samples, model.nq))
    robot = model, geometry, links, kinematics, pieces
    others = [pair for pair in every if pair not in reasons]
    first = _touching(*robot, others, states[:few], contact)
    often = [pair for pair, hit in first.items() if hit.mean() >= always - spread]
    for pair, hit in _touching(*robot, often, states, contact).items():
        if hit.mean() >= always:
            reasons[pair] = f"{OVERLAP}{100.0 * hit.mean():.4g} % of random states"
    return tuple(LeftOut(*pair, reasons[pair]) for pair in every if pair in reasons)


def checked_pairs(
    model: pin.Model, geometry: pin.GeometryModel, left_out: Sequence[LeftOut]
) -> tuple[tuple[int, int], ...]:
    """Set the pairs that the geometry model checks; return their indices."""
    skipped = {frozenset((pair.first, pair.second)) for pair in left_out}
    names = [model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    geometry.addAllCollisionPairs()
    every = [(int(pair.first), int(pair.second)) for pair in geometry.collisionPairs]
    kept = tuple((i, k) for i, k in every if frozenset((names[i], names[k])) not in skipped)
    geometry.removeAllCollisionPairs()
    for i, k in kept:
        geometry.addCollisionPair(pin.CollisionPair(i, k))
    return kept


def _touching(
    model: pin.Model,
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    pieces: Mapping[str, list[int]],
    pairs: Sequence[Pair],
    states: np.ndarray,
    margin: float,
) -> dict[Pair, np.ndarray]:
    """Whether each pair of links is closer than margin [m], (k,) in states (k, n)."""
    tested = pin.GeometryModel(geometry)
    tested.removeAllCollisionPairs()
    indices = [(k, i, j) for k, (a, b) in enumerate(pairs) for i in pieces[a] for j in pieces[b]]
    for _, i, j in indices:
        tested.addCollisionPair(pin.CollisionPair(i, j))
    owner, first, second = np.array(indices, dtype=int).reshape(-1, 3).T
    data, tested_data = model.createData(), pin.GeometryData(tested)
    for request in tested_data.collisionRequests:
        request.security_margin = margin
    # pieces whose balls are apart need no exact check
    rotations, translations = link_poses(kinematics, states)
    centres, radii = np.empty((len(states), len(links), 3)), np.empty(len(links))
    for i, piece in enumerate(links):
        middle, radii[i] = piece.ball
        centres[:, i] = rotations[:, piece.link] @ middle + translations[:, piece.link]
    hits = np.zeros((len(states), len(pairs)), dtype=bool)
    for hit, q, centre in zip(hits, states, centres, strict=True):
        apart = np.linalg.norm(centre[first] - centre[second], axis=1)
        pin.updateGeometryPlacements(model, data, tested, tested_data, q)
        for k in np.flatnonzero(apart <= radii[first] + radii[second] + margin).tolist():
            if not hit[owner[k]]:
                hit[owner[k]] = pin.computeCollision(tested, tested_data, k)
    return dict(zip(pairs, hits.T, strict=True))


def srdf_root(path: Path) -> ElementTree.Element:
    """The content of an SRDF file; InvalidInputError names a file that is none."""
    try:
        root = ElementTree.fromstring(read_text(path, "SRDF file"))
    except ElementTree.ParseError as error:
        raise InvalidInputError(f"cannot read SRDF file {path}: {error}") from error
    if root.tag != "robot":
        raise InvalidInputError(f"SRDF file {path} has the root <{root.tag}>, not <robot>")
    return root
