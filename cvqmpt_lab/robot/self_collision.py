"""Which pairs of links are checked against each other: by an SRDF, or found by sampling and cached as one.

Without an SRDF, a pair is left out if its links are neighbours, if they overlap in nearly every random
configuration, or if they come closer than `NEAR` in none. The result depends on the robot alone.
"""

import contextlib
import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pinocchio as pin

from cvqmpt_lab.disk_cache import read_cached, write_cached
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import cache_folder, read_text
from cvqmpt_lab.robot.kinematics import Kinematics, link_poses
from cvqmpt_lab.robot.robot import LeftOut, LinkGeometry

SAMPLES = 2000  # random configurations
NEAR = 0.02  # [m] a pair that comes so near in one of them is checked
ALWAYS = 0.95  # share of them in which two hulls overlap "always": because of their shapes, not of the configuration
SPREAD = 0.15  # by which the share among `CHUNK` of them may be smaller: five standard deviations
CHUNK = 50  # configurations after which pairs that are decided are dropped
VERSION = b"3"  # of the rule; another number makes cached files invalid

Pair = tuple[str, str]  # names of two links


def left_out_pairs(
    model: pin.Model,
    geometry: pin.GeometryModel,
    links: Sequence[LinkGeometry],
    kinematics: Kinematics,
    srdf: Path | None,
) -> tuple[LeftOut, ...]:
    """The pairs that an SRDF leaves out; without one, the cached ones, or found by sampling and cached."""
    if srdf is not None:
        return read_srdf(srdf)
    cached = cache_file(model, links)
    with contextlib.suppress(OSError, ValueError, InvalidInputError):  # not there yet, or damaged
        return srdf_pairs(read_cached(cached.parent.name, cached.name).decode(), cached)
    found = sampled_pairs(model, geometry, links, kinematics)
    write_cached(cached.parent.name, cached.name, srdf_text(model.name, found).encode())
    return found


def cache_file(model: pin.Model, links: Sequence[LinkGeometry]) -> Path:
    """The file for the sampled pairs of a robot; its name depends on placements, limits and corners."""
    digest = hashlib.sha256(VERSION)
    for placement in model.jointPlacements:
        digest.update(placement.homogeneous.tobytes())
    for piece in links:
        digest.update(f"{piece.name} {piece.link} ".encode())
        digest.update(piece.T_link_geometry.tobytes() + np.sort(piece.vertices, axis=0).tobytes())
    digest.update(f"{list(model.parents)} {[j.shortname() for j in model.joints]}".encode())
    digest.update(np.concatenate([model.lowerPositionLimit, model.upperPositionLimit]).tobytes())
    name = f"{model.name.replace('/', '_')}-{digest.hexdigest()[:16]}.srdf"
    return cache_folder() / "self_collision" / name


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


def sampled_pairs(
    model: pin.Model, geometry: pin.GeometryModel, links: Sequence[LinkGeometry], kinematics: Kinematics
) -> tuple[LeftOut, ...]:
    """Pairs of links to leave out, by the rule at the top of this file."""
    pieces: dict[str, list[int]] = {}
    for k, item in enumerate(geometry.geometryObjects):
        pieces.setdefault(link_of_piece(model, item), []).append(k)
    every = list(combinations(pieces, 2))
    joints = {name: geometry.geometryObjects[indices[0]].parentJoint for name, indices in pieces.items()}
    reasons = {}
    for pair in every:
        a, b = joints[pair[0]], joints[pair[1]]
        if a == b or model.parents[a] == b or model.parents[b] == a:
            reasons[pair] = "Adjacent"
    pairs = [pair for pair in every if pair not in reasons]
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    states = np.random.default_rng(0).uniform(lower, upper, (SAMPLES, model.nq))
    sampling = _Sampling(model, geometry, pieces, states, _balls(links, kinematics, states))
    often, apart = set(pairs), set(pairs)  # what may still be nearly always near, or never
    for rows in np.array_split(np.arange(SAMPLES), SAMPLES // CHUNK):
        undecided = often | apart
        seen = sampling.close([pair for pair in pairs if pair in undecided], rows, NEAR)
        often -= {pair for pair, hits in seen.items() if hits.mean() < ALWAYS - SPREAD}
        apart -= {pair for pair, hits in seen.items() if hits.any()}
    touching = sampling.close([pair for pair in pairs if pair in often], np.arange(SAMPLES), 0.0)
    reasons |= dict.fromkeys(apart, "Never")
    reasons |= {pair: "Always" for pair, hits in touching.items() if hits.mean() >= ALWAYS}
    return tuple(LeftOut(*pair, reasons[pair]) for pair in every if pair in reasons)


def _balls(
    links: Sequence[LinkGeometry], kinematics: Kinematics, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (k, p, 3) and radii (p,) [m] of balls around the pieces, in each state (k, n)."""
    rotations, translations = link_poses(kinematics, states)
    centres, radii = np.empty((len(states), len(links), 3)), np.empty(len(links))
    for i, piece in enumerate(links):
        points = piece.vertices @ piece.T_link_geometry[:3, :3].T + piece.T_link_geometry[:3, 3]
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        centres[:, i] = rotations[:, piece.link] @ middle + translations[:, piece.link]
        radii[i] = np.linalg.norm(points - middle, axis=1).max()
    return centres, radii


@dataclass(frozen=True)
class _Sampling:
    """The check of pairs of links in random states."""

    model: pin.Model
    geometry: pin.GeometryModel
    pieces: Mapping[str, list[int]]  # indices of the pieces of each link
    states: np.ndarray  # (k, n) [rad or m]
    balls: tuple[np.ndarray, np.ndarray]  # of `_balls`: pieces whose balls are apart need no exact check

    def close(self, pairs: Sequence[Pair], rows: np.ndarray, margin: float) -> dict[Pair, np.ndarray]:
        """Whether each pair of links is closer than a margin [m], in each of the states `rows`."""
        tested = pin.GeometryModel(self.geometry)
        tested.removeAllCollisionPairs()
        indices = [
            (k, i, j) for k, (a, b) in enumerate(pairs) for i in self.pieces[a] for j in self.pieces[b]
        ]
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
