"""Proof that two convex pieces of a robot stay apart over the whole ranges of the joints between
them.

Branch and bound over boxes of joint values. When joint j alone changes by d, the distance of the
pieces changes by at most L_j |d|. So in a box with centre q and half widths h it is at least
distance(q) - sum_j L_j h_j; where that is too little, the box is halved along the joint with the
largest L_j h_j.
"""

from collections.abc import Sequence

import coal
import numpy as np

from cvqmpt_lab.robot.hulls import coal_distance
from cvqmpt_lab.robot.kinematics import Kinematics, link_poses
from cvqmpt_lab.robot.robot import LinkGeometry

MOST_DISTANCES = 10_000  # computed for one pair that up to three joints move; 0.15 s
MORE_JOINTS = 3  # by which that number is divided for each further joint: a proof gets less likely


def proven_apart(
    kinematics: Kinematics,
    pieces: tuple[LinkGeometry, LinkGeometry],
    shapes: tuple[coal.CollisionGeometry, coal.CollisionGeometry],
    gap: float,
) -> bool:
    """Whether the pieces stay more than gap [m] apart at all joint values; "no" may mean "not
    known".

    shapes: of the pieces, in their frames; the vertices of the pieces contain them.
    """
    a, b = (piece.link for piece in pieces)
    levers = distance_levers(kinematics, *pieces)
    joints, lever = np.array(list(levers), dtype=int), np.array(list(levers.values()))
    left = MOST_DISTANCES // MORE_JOINTS ** max(len(joints) - 3, 0)
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
        distance = np.array([_distance(pieces, shapes, R[i], t[i]) for i in undecided])
        if not (distance > gap).all():
            return False
        open_boxes = undecided[distance <= needed[undecided]]
        low, high = _halved(low[open_boxes], high[open_boxes], lever)
    return True


def _halved(low: np.ndarray, high: np.ndarray, lever: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both halves of each box, (k, m) each to (2 k, m), along the joint that moves the pieces
    furthest.
    """
    row, widest = np.arange(len(low)), ((high - low) * lever).argmax(axis=1)
    middle = 0.5 * (low[row, widest] + high[row, widest])
    below, above = high.copy(), low.copy()
    below[row, widest] = above[row, widest] = middle
    return np.concatenate([low, above]), np.concatenate([below, high])


def _distance(
    pieces: Sequence[LinkGeometry],
    shapes: Sequence[coal.CollisionGeometry],
    rotations: np.ndarray,
    translations: np.ndarray,
) -> float:
    """Distance of two shapes [m] at the poses of all links."""
    placed = []
    for piece in pieces:
        R, T = rotations[piece.link], piece.T_link_geometry
        placed.append(coal.Transform3s(R @ T[:3, :3], R @ T[:3, 3] + translations[piece.link]))
    return coal_distance(shapes[0], placed[0], shapes[1], placed[1])


def distance_levers(
    kinematics: Kinematics, first: LinkGeometry, second: LinkGeometry
) -> dict[int, float]:
    """L_j of each joint j between two pieces [m/rad, or m/m]: for a hinge, of the two sides that it
    turns against each other, the one whose points are closer to its axis in all configurations.
    """
    sides = [_chain(kinematics, piece.link) for piece in (first, second)]
    sides = [[j for j in side if j not in other] for side, other in (sides, sides[::-1])]
    levers = {}
    for joints, piece, others, other in zip(
        sides, (first, second), sides[::-1], (second, first), strict=True
    ):
        own, far = (
            piece.vertices_in_link,
            float(np.linalg.norm(other.vertices_in_link, axis=1).max()),
        )
        # of the other piece from where both chains part
        far += sum(_step(kinematics, j) for j in others)
        to_other = {}
        for j in reversed(joints):
            off_axis = np.cross(kinematics.translation[j], kinematics.rotation[j, :, 2])
            to_other[j] = float(np.linalg.norm(off_axis)) + far
            far += _step(kinematics, j)
        # of the own piece around joint j's axis z
        around = float(np.linalg.norm(own[:, :2], axis=1).max())
        # of the own piece from the origin of joint j
        reach = float(np.linalg.norm(own, axis=1).max())
        for j in joints:
            levers[j] = 1.0 if kinematics.prismatic[j] else min(around, to_other[j])
            around = (
                float(np.linalg.norm(kinematics.translation[j, :2])) + _slide(kinematics, j) + reach
            )
            reach += _step(kinematics, j)
    return levers


def _chain(kinematics: Kinematics, row: int) -> list[int]:
    """The joints from a pose row to the world."""
    joints = []
    while row > 0:
        joints.append(row - 1)
        row = int(kinematics.parent[row - 1])
    return joints


def _slide(kinematics: Kinematics, j: int) -> float:
    """How far joint j slides from 0 [m]; zero for a hinge."""
    return float(
        max(abs(kinematics.lower[j]), abs(kinematics.upper[j])) if kinematics.prismatic[j] else 0.0
    )


def _step(kinematics: Kinematics, j: int) -> float:
    """The largest distance [m] between the origins of joint j's frame and of its parent's."""
    return float(np.linalg.norm(kinematics.translation[j])) + _slide(kinematics, j)
