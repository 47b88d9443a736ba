"""Which pairs of links are checked against each other: all but those for which there is a reason
not to.

An SRDF names the pairs that its maker leaves out. Without one, a pair is left out if its links are
fixed to each other or neighbours (one joint moves them, and no other body lies between), if they
are proven to stay `GAP` apart at all joint values, or if they overlap in nearly every random
configuration. All others are checked. The result depends on the robot alone and is cached.
"""

import contextlib
import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pinocchio as pin

from cvqmpt_lab.disk_cache import read_cached, sources_digest, write_cached
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text
from cvqmpt_lab.robot.kinematics import Kinematics, link_poses
from cvqmpt_lab.robot.proven_apart import proven_apart
from cvqmpt_lab.robot.robot import LeftOut, LinkGeometry
from cvqmpt_lab.robot.urdf import Urdf

SAMPLES = 2000  # random configurations
GAP = 0.01  # [m] a pair that may come so near is checked
# [m] of an overlap: at 0 coal calls hulls free that are 1.3 mm deep in each other, by where GJK
# begins
CONTACT = 1e-6
# share of them in which two hulls overlap "always": because of their shapes, not of the
# configuration
ALWAYS = 0.95
SPREAD = 0.15  # by which the share among `CHUNK` of them may be smaller: five standard deviations
CHUNK = 50  # configurations after which pairs that are decided are dropped
# reasons for leaving out a pair
FIXED, ADJACENT, APART = "fixed to each other", "adjacent", "proven apart"
# before the share of random states; before what an SRDF says
OVERLAP, FROM_SRDF = "overlap in ", "SRDF: "
# of the rule: other sources make cached files invalid
SOURCES = sources_digest(Path(__file__).parent)

Pair = tuple[str, str]  # names of two links


def left_out_pairs(
    model: pin.Model,
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    urdf: Urdf,
    srdf: Path | None,
) -> tuple[LeftOut, ...]:
    """The pairs that an SRDF leaves out;
    without one, the cached ones, or those found now, which are then cached.
    """
    if srdf is not None:
        return tuple(
            pair._replace(reason=FROM_SRDF + pair.reason.removeprefix(FROM_SRDF))
            for pair in read_srdf(srdf)
        )
    names = [link_of_piece(model, item) for item in geometry.geometryObjects]
    near = neighbours(urdf, set(names))
    key = robot_digest(geometry, links, kinematics, names, near)
    file = f"{model.name.replace('/', '_')}-{key[:16]}.srdf"
    with contextlib.suppress(OSError, ValueError, InvalidInputError):  # not there yet, or damaged
        text = read_cached(KIND, file).decode()
        if text == signed(text.rpartition(SIGNATURE)[0], key):
            return srdf_pairs(text, Path(file))
    found = found_pairs(model, geometry, links, kinematics, near)
    write_cached(KIND, file, signed(srdf_text(model.name, found), key).encode())
    return found


KIND = "self_collision"  # folder of the cache
SIGNATURE = "<!-- sha256 of the robot and of the lines above: "


def signed(text: str, key: str) -> str:
    """A cached file: its text, and the digest of text and robot, without which it is not believed."""
    return f"{text}{SIGNATURE}{hashlib.sha256((key + text).encode()).hexdigest()} -->\n"


def robot_digest(
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    names: Sequence[str],
    near: Collection[Pair],
) -> str:
    """Digest of all that the pairs depend on: every joint's axis, placement and limits, and every
    piece.

    names: URDF links of the pieces. near: of `neighbours`. Axes are in `kinematics.rotation`:
        joints turn about z.
    """
    digest = hashlib.sha256(f"{SOURCES} {sorted(near)!r}".encode())
    for array in kinematics:
        digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    for name, piece, item in zip(names, links, geometry.geometryObjects, strict=True):
        kind = type(item.geometry).__name__
        digest.update(
            f"{name!r} {piece.name!r} {piece.link} {kind} {piece.vertices.shape}".encode()
        )
        digest.update(piece.T_link_geometry.tobytes() + piece.vertices.tobytes())
    return digest.hexdigest()


def neighbours(urdf: Urdf, bodies: Collection[str]) -> set[Pair]:
    """Pairs (nearer to the base, further out) of links with bodies, with none but links without
    bodies between them.
    """
    above = {joint.child: joint.parent for joint in urdf.joints.values()}
    found = set()
    for link in bodies:
        parent = above.get(link)
        while parent is not None and parent not in bodies:
            parent = above.get(parent)
        if parent is not None:
            found.add((parent, link))
    return found


def link_of_piece(model: pin.Model, item: pin.GeometryObject) -> str:
    """The URDF link that a collision piece belongs to."""
    return model.frames[item.parentFrame].name


def checked_pairs(
    model: pin.Model, geometry: pin.GeometryModel, left_out: Sequence[LeftOut]
) -> tuple[tuple[int, int], ...]:
    """Set the pairs that the geometry model checks; return their indices."""
    skipped = {frozenset((pair.first, pair.second)) for pair in left_out}
    names = [link_of_piece(model, item) for item in geometry.geometryObjects]
    geometry.addAllCollisionPairs()
    every = [(int(pair.first), int(pair.second)) for pair in geometry.collisionPairs]
    kept = tuple((i, k) for i, k in every if frozenset((names[i], names[k])) not in skipped)
    geometry.removeAllCollisionPairs()
    for i, k in kept:
        geometry.addCollisionPair(pin.CollisionPair(i, k))
    return kept


def found_pairs(
    model: pin.Model,
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    near: Collection[Pair],
) -> tuple[LeftOut, ...]:
    """Pairs of links to leave out, by the rule at the top of this file."""
    pieces: dict[str, list[int]] = {}
    for k, item in enumerate(geometry.geometryObjects):
        pieces.setdefault(link_of_piece(model, item), []).append(k)
    every = list(combinations(pieces, 2))
    joints = {
        name: geometry.geometryObjects[indices[0]].parentJoint for name, indices in pieces.items()
    }
    reasons = {}
    for pair in every:
        a, b = joints[pair[0]], joints[pair[1]]
        if a == b:
            reasons[pair] = FIXED
        elif (pair in near or pair[::-1] in near) and a in (model.parents[b], *model.children[b]):
            reasons[pair] = ADJACENT
    pairs = [pair for pair in every if pair not in reasons]
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    states = np.random.default_rng(0).uniform(lower, upper, (SAMPLES, model.nq))
    sampling = _Sampling(model, geometry, pieces, states, _balls(links, kinematics, states))
    often, apart = set(pairs), set(pairs)  # what may still be nearly always near, or never
    for rows in np.array_split(np.arange(SAMPLES), SAMPLES // CHUNK):
        undecided = often | apart
        seen = sampling.close([pair for pair in pairs if pair in undecided], rows, GAP)
        often -= {pair for pair, hits in seen.items() if hits.mean() < ALWAYS - SPREAD}
        apart -= {pair for pair, hits in seen.items() if hits.any()}
    touching = sampling.close(
        [pair for pair in pairs if pair in often], np.arange(SAMPLES), CONTACT
    )
    for pair, hits in touching.items():
        if hits.mean() >= ALWAYS:
            reasons[pair] = f"{OVERLAP}{100.0 * hits.mean():.4g} % of random states"
    shapes = [item.geometry for item in geometry.geometryObjects]
    for first, second in sorted(apart):
        bodies = ((i, k) for i in pieces[first] for k in pieces[second])
        if all(
            proven_apart(kinematics, (links[i], links[k]), (shapes[i], shapes[k]), GAP)
            for i, k in bodies
        ):
            reasons[first, second] = APART
    return tuple(LeftOut(*pair, reasons[pair]) for pair in every if pair in reasons)


def _balls(
    links: Sequence[LinkGeometry], kinematics: Kinematics, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (k, p, 3) and radii (p,) [m] of balls around the pieces, in each state (k, n)."""
    rotations, translations = link_poses(kinematics, states)
    centres, radii = np.empty((len(states), len(links), 3)), np.empty(len(links))
    for i, piece in enumerate(links):
        middle, radii[i] = piece.ball
        centres[:, i] = rotations[:, piece.link] @ middle + translations[:, piece.link]
    return centres, radii


@dataclass(frozen=True)
class _Sampling:
    """The check of pairs of links in random states."""

    model: pin.Model
    geometry: pin.GeometryModel
    pieces: Mapping[str, list[int]]  # indices of the pieces of each link
    states: np.ndarray  # (k, n) [rad or m]
    # of `_balls`: pieces whose balls are apart need no exact check
    balls: tuple[np.ndarray, np.ndarray]

    def close(
        self, pairs: Sequence[Pair], rows: np.ndarray, margin: float
    ) -> dict[Pair, np.ndarray]:
        """Whether each pair of links is closer than a margin [m], in each of the states `rows`."""
        tested = pin.GeometryModel(self.geometry)
        tested.removeAllCollisionPairs()
        pieces = ((k, self.pieces[a], self.pieces[b]) for k, (a, b) in enumerate(pairs))
        indices = [(k, i, j) for k, first, second in pieces for i in first for j in second]
        for _, i, j in indices:
            tested.addCollisionPair(pin.CollisionPair(i, j))
        owner, first, second = np.array(indices, dtype=int).reshape(-1, 3).T
        data, tested_data = self.model.createData(), pin.GeometryData(tested)
        for request in tested_data.collisionRequests:
            request.security_margin = margin
        centres, radii = self.balls
        hits = np.zeros((len(rows), len(pairs)), dtype=bool)
        for hit, row in zip(hits, rows, strict=True):
            apart = np.linalg.norm(centres[row, first] - centres[row, second], axis=1)
            pin.updateGeometryPlacements(self.model, data, tested, tested_data, self.states[row])
            for k in np.flatnonzero(apart <= radii[first] + radii[second] + margin).tolist():
                if not hit[owner[k]]:
                    hit[owner[k]] = pin.computeCollision(tested, tested_data, k)
        return dict(zip(pairs, hits.T, strict=True))


# SRDF files.
def read_srdf(path: Path) -> tuple[LeftOut, ...]:
    """The pairs that an SRDF file leaves out; InvalidInputError names a file that is none."""
    return srdf_pairs(read_text(path, "SRDF file"), path)


def srdf_pairs(text: str, path: Path) -> tuple[LeftOut, ...]:
    """The pairs that the text of an SRDF file leaves out; errors name its path."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InvalidInputError(f"cannot read SRDF file {path}: {error}") from error
    if root.tag != "robot":
        raise InvalidInputError(f"SRDF file {path} has the root <{root.tag}>, not <robot>")
    return tuple(
        LeftOut(
            item.get("link1", ""), item.get("link2", ""), item.get("reason", "left out by the SRDF")
        )
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
