"""What of a measured cloud is no obstacle: the robot itself, and points that stand alone."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.robot.robot import LinkGeometry, Robot


class _Piece(NamedTuple):
    """A convex piece of a robot, as half spaces of its link's frame."""

    link: int
    """Pose row that carries it."""
    middle: FloatArray
    """(3,) of a ball around it [m]."""
    radius: float
    """Of that ball [m]."""
    faces: FloatArray
    """(f, 4), each outward normal and offset: a point x is inside when normal @ x + offset <= 0 for all."""


def near_robot(points: FloatArray, robot: Robot, q: FloatArray, margin: float) -> np.ndarray:
    """Which of points (m, 3) [m, world] lie on, in or near the robot at q (n,): a mask (m,).

    Near is within margin [m] of every face of one of its convex pieces; off a corner that reaches a little farther.
    """
    (rotations,), (translations,) = link_poses(robot.kinematics, np.ascontiguousarray(q, dtype=float)[None])
    near = np.zeros(len(points), dtype=bool)
    for piece in _pieces(robot):
        turn = rotations[piece.link]
        away = points - (turn @ piece.middle + translations[piece.link])
        close = np.flatnonzero(np.einsum("ij,ij->i", away, away) <= (piece.radius + margin) ** 2)
        local = away[close] @ turn + piece.middle
        near[close[(local @ piece.faces[:, :3].T + piece.faces[:, 3] <= margin).all(axis=1)]] = True
    return near


def lonely(points: FloatArray, radius: float, neighbours: int) -> np.ndarray:
    """Which of points (m, 3) have fewer than `neighbours` others within radius [m]: a mask (m,)."""
    from scipy.spatial import cKDTree  # a third of a second to import

    distances, _ = cKDTree(points).query(points, k=[neighbours + 1], distance_upper_bound=radius)
    return ~np.isfinite(distances[:, 0])


@lru_cache(maxsize=4)
def _pieces(robot: Robot) -> tuple[_Piece, ...]:
    return tuple(_piece(part) for part in robot.links)


def _piece(part: LinkGeometry) -> _Piece:
    from scipy.spatial import ConvexHull

    T = part.T_link_geometry
    vertices = part.vertices @ T[:3, :3].T + T[:3, 3]
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    radius = float(np.linalg.norm(vertices - middle, axis=1).max())
    return _Piece(part.link, middle, radius, ConvexHull(vertices).equations)
