"""Which pairs of links are checked against each other: all but those with a reason not to.

An SRDF names the pairs that its maker leaves out. Without one, a pair is left out if its links are
fixed to each other or neighbours (one joint moves them, and no other body lies between), if they
are proven to stay `GAP` apart at all joint values, or if they overlap in nearly every random
configuration. The result depends on the robot alone and is cached.
"""

import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from cvqmpt_lab.caches import cached_arrays, sources_digest
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text
from cvqmpt_lab.robot.hulls import coal_distance
from cvqmpt_lab.robot.kinematics import Kinematics, link_poses
from cvqmpt_lab.robot.robot import LeftOut, LinkGeometry
from cvqmpt_lab.robot.urdf import Urdf

# [m] a pair that may come so near is checked
GAP = 0.01
# reasons for leaving out a pair
FIXED, ADJACENT, APART = "fixed to each other", "adjacent", "proven apart"
# beginnings of two more: the share of random states follows, or the reason of an SRDF
OVERLAP, FROM_SRDF = "overlap in ", "SRDF: "

Pair = tuple[str, str]


def left_out_pairs(
    model: pin.Model,
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    urdf: Urdf,
    srdf: str,
) -> tuple[LeftOut, ...]:
    """The pairs that an SRDF leaves out; without one those found by the rule above, cached."""
    if srdf:
        return read_srdf(Path(srdf))
    names = [model.frames[item.parentFrame].name for item in geometry.geometryObjects]
    near = _neighbours(urdf, set(names))
    # all that the pairs depend on: the rule, axes, placements and limits of joints, and the pieces
    pieces = [
        (name, piece.name, piece.link, type(item.geometry).__name__)
        for name, piece, item in zip(names, links, geometry.geometryObjects, strict=True)
    ]
    arrays = list(kinematics)
    for piece in links:
        arrays += [piece.T_link_geometry, piece.vertices]
    shapes = [(str(array.dtype), array.shape) for array in arrays]
    text = f"{sources_digest(Path(__file__).parent)} {sorted(near)!r} {pieces!r} {shapes!r}"
    content = b"".join(array.tobytes() for array in arrays)
    key = hashlib.sha256(text.encode() + content).hexdigest()

    def find() -> dict[str, np.ndarray]:
        found = _found_pairs(model, geometry, names, links, kinematics, near)
        return {"robot": np.array(key), "pairs": np.array(found, dtype=str).reshape(-1, 3)}

    kept = cached_arrays(
        "self_collision", key.encode(), find, lambda kept: str(kept["robot"]) == key
    )
    return tuple(LeftOut(*map(str, row)) for row in kept["pairs"])


def _neighbours(urdf: Urdf, bodies: Collection[str]) -> set[Pair]:
    """Pairs (nearer to the base, further out) of links with bodies, and no body between them."""
    above = {joint.child: joint.parent for joint in urdf.joints.values()}
    found = set()
    for link in bodies:
        parent = above.get(link)
        while parent is not None and parent not in bodies:
            parent = above.get(parent)
        if parent is not None:
            found.add((parent, link))
    return found


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


def _found_pairs(
    model: pin.Model,
    geometry: pin.GeometryModel,
    names: Sequence[str],
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    near: Collection[Pair],
    samples: int = 2000,
    always: float = 0.95,
    spread: float = 0.15,
    chunk: int = 50,
    contact: float = 1e-6,
) -> tuple[LeftOut, ...]:
    """Pairs of links to leave out, by the rule at the top of this file.

    Args:
        names: URDF links of the pieces.
        near: neighbours.
        samples: random configurations.
        always: share of them in which two hulls overlap because of their shapes.
        spread: by which that share may be smaller among `chunk`: five standard deviations.
        chunk: configurations after which pairs that are decided are dropped.
        contact: [m] of an overlap; at 0 coal calls hulls free that overlap by 1.3 mm.
    """
    pieces: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        pieces.setdefault(name, []).append(k)
    joints = {name: geometry.geometryObjects[own[0]].parentJoint for name, own in pieces.items()}
    every = list(combinations(pieces, 2))
    reasons = {}
    for pair in every:
        a, b = joints[pair[0]], joints[pair[1]]
        if a == b:
            reasons[pair] = FIXED
        elif (pair in near or pair[::-1] in near) and a in (model.parents[b], *model.children[b]):
            reasons[pair] = ADJACENT
    pairs = [pair for pair in every if pair not in reasons]
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    states = np.random.default_rng(0).uniform(lower, upper, (samples, model.nq))
    robot = model, geometry, links, kinematics, pieces
    # pairs that may still be nearly always near, and those that may never be
    often, apart = set(pairs), set(pairs)
    for part in np.array_split(states, samples // chunk):
        undecided = [pair for pair in pairs if pair in often | apart]
        for pair, hits in _close(*robot, undecided, part, GAP).items():
            if hits.mean() < always - spread:
                often.discard(pair)
            if hits.any():
                apart.discard(pair)
    touching = _close(*robot, [pair for pair in pairs if pair in often], states, contact)
    for pair, hits in touching.items():
        if hits.mean() >= always:
            reasons[pair] = f"{OVERLAP}{100.0 * hits.mean():.4g} % of random states"
    shapes = [item.geometry for item in geometry.geometryObjects]
    for first, second in sorted(apart):
        bodies = ((i, k) for i in pieces[first] for k in pieces[second])
        if all(
            _proven_apart(kinematics, (links[i], links[k]), (shapes[i], shapes[k]), GAP)
            for i, k in bodies
        ):
            reasons[first, second] = APART
    return tuple(LeftOut(*pair, reasons[pair]) for pair in every if pair in reasons)


def _close(
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


def _proven_apart(
    kinematics: Kinematics,
    pieces: tuple[LinkGeometry, LinkGeometry],
    shapes: tuple[coal.CollisionGeometry, coal.CollisionGeometry],
    gap: float,
    most: int = 10_000,
) -> bool:
    """Whether two pieces stay more than gap [m] apart at all joint values; "no" may mean unknown.

    Branch and bound over boxes of joint values. When joint j alone changes by d, the distance of
    the pieces changes by at most L_j |d|, so that in a box with centre q and half widths h

        distance >= distance(q) - sum_j L_j h_j.

    Where that is too little, the box is halved along the joint with the largest L_j h_j.

    Args:
        kinematics: of the robot.
        pieces: their vertices contain the shapes.
        shapes: of the pieces, in their frames.
        gap: [m].
        most: distances computed for a pair that up to three joints move (0.15 s); a third of that
            for each further joint: proofs get less likely.
    """
    a, b = (piece.link for piece in pieces)
    levers = distance_levers(kinematics, *pieces)
    joints, lever = np.array(list(levers), dtype=int), np.array(list(levers.values()))
    left = most // 3 ** max(len(joints) - 3, 0)
    low, high = kinematics.lower[joints][None], kinematics.upper[joints][None]
    (ball_a, radius_a), (ball_b, radius_b) = (piece.ball for piece in pieces)
    while len(low):
        # joints that are not between the pieces change nothing
        q = np.tile(kinematics.lower, (len(low), 1))
        q[:, joints] = 0.5 * (low + high)
        R, t = link_poses(kinematics, q)
        needed = 0.5 * (high - low) @ lever + gap
        centres = np.linalg.norm(R[:, a] @ ball_a + t[:, a] - R[:, b] @ ball_b - t[:, b], axis=1)
        undecided = np.flatnonzero(~(centres - radius_a - radius_b > needed))
        left -= len(undecided)
        if left < 0:
            return False
        distance = np.empty(len(undecided))
        for k, i in enumerate(undecided):
            bodies = []
            for shape, piece in zip(shapes, pieces, strict=True):
                R_link, T = R[i, piece.link], piece.T_link_geometry
                origin = R_link @ T[:3, 3] + t[i, piece.link]
                bodies += [shape, coal.Transform3s(R_link @ T[:3, :3], origin)]
            distance[k] = coal_distance(*bodies)
        if not (distance > gap).all():
            return False
        open_boxes = undecided[distance <= needed[undecided]]
        low, high = low[open_boxes], high[open_boxes]
        row, widest = np.arange(len(low)), ((high - low) * lever).argmax(axis=1)
        below, above = high.copy(), low.copy()
        below[row, widest] = above[row, widest] = 0.5 * (low[row, widest] + high[row, widest])
        low, high = np.concatenate([low, above]), np.concatenate([below, high])
    return True


def distance_levers(
    kinematics: Kinematics, first: LinkGeometry, second: LinkGeometry
) -> dict[int, float]:
    """L_j [m/rad, or m/m] of each joint j between two pieces: |d distance / d q_j| <= L_j.

    1 for a slider. For a hinge, of the two sides that it turns against each other, the largest
    distance from its axis of the side whose points are closer to it in all configurations.
    """
    moves = kinematics.moves
    slide = np.maximum(np.abs(kinematics.lower), np.abs(kinematics.upper))
    slide = np.where(kinematics.prismatic, slide, 0.0)
    # largest distance [m] between the origins of joint j's frame and of its parent's
    step = [
        float(np.linalg.norm(t)) + s for t, s in zip(kinematics.translation, slide, strict=True)
    ]
    levers = {}
    for piece, other in ((first, second), (second, first)):
        # from the piece to where both chains part
        joints = np.flatnonzero(moves[:, piece.link] & ~moves[:, other.link])[::-1].tolist()
        others = np.flatnonzero(moves[:, other.link] & ~moves[:, piece.link])[::-1].tolist()
        far = float(np.linalg.norm(other.vertices_in_link, axis=1).max())
        far += sum(step[j] for j in others)
        to_other = {}
        for j in reversed(joints):
            off_axis = np.cross(kinematics.translation[j], kinematics.rotation[j, :, 2])
            to_other[j] = float(np.linalg.norm(off_axis)) + far
            far += step[j]
        # of the own piece: around joint j's axis z, and from the origin of joint j
        own = piece.vertices_in_link
        around = float(np.linalg.norm(own[:, :2], axis=1).max())
        reach = float(np.linalg.norm(own, axis=1).max())
        for j in joints:
            levers[j] = 1.0 if kinematics.prismatic[j] else min(around, to_other[j])
            around = float(np.linalg.norm(kinematics.translation[j, :2])) + slide[j] + reach
            reach += step[j]
    return levers


def srdf_root(path: Path) -> ElementTree.Element:
    """The content of an SRDF file; InvalidInputError names a file that is none."""
    try:
        root = ElementTree.fromstring(read_text(path, "SRDF file"))
    except ElementTree.ParseError as error:
        raise InvalidInputError(f"cannot read SRDF file {path}: {error}") from error
    if root.tag != "robot":
        raise InvalidInputError(f"SRDF file {path} has the root <{root.tag}>, not <robot>")
    return root


def read_srdf(path: Path) -> tuple[LeftOut, ...]:
    """The pairs that an SRDF file leaves out, with its reasons after `FROM_SRDF`."""
    return tuple(
        LeftOut(
            item.get("link1", ""),
            item.get("link2", ""),
            FROM_SRDF + item.get("reason", "left out by the SRDF").removeprefix(FROM_SRDF),
        )
        for item in srdf_root(path).findall("disable_collisions")
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
