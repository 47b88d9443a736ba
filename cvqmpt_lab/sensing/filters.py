"""Filters of measured clouds: crops, voxel means, the robot's own points, outliers."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.values import FloatArray


@dataclass(frozen=True)
class BoxCrop:
    """Keeps points between two corners [m]; the published crop by default."""

    lower: tuple[float, float, float] = (-0.88, -0.88, -0.4)
    upper: tuple[float, float, float] = (0.88, 0.88, 1.2)

    def contains(self, points: FloatArray) -> np.ndarray:
        """Whether each of the points (m, 3) stays."""
        spans = zip(points.T, self.lower, self.upper, strict=True)  # by axis: three times as fast
        return np.logical_and.reduce(
            [(axis >= lower) & (axis <= upper) for axis, lower, upper in spans]
        )


@dataclass(frozen=True)
class BallCrop:
    """Keeps points in a ball [m]; by default the one that training clouds are cut to."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.33)
    radius: float = 1.2

    def contains(self, points: FloatArray) -> np.ndarray:
        """Whether each of the points (m, 3) stays."""
        return np.square(points - self.centre).sum(axis=1) <= self.radius**2


def near_robot(points: FloatArray, robot: Robot, q: FloatArray, margin: float) -> np.ndarray:
    """Mask (m,) of points (m, 3) [m, world] on, in or near the robot at q (n,).

    Near is within margin [m] of every face of one of its convex pieces; near corners this reaches a
    little farther.
    """
    (rotations,), (translations,) = link_poses(
        robot.kinematics, np.ascontiguousarray(q, dtype=float)[None]
    )
    near = np.zeros(len(points), dtype=bool)
    for part, faces in zip(robot.links, _faces(robot), strict=True):
        turn, (middle, radius) = rotations[part.link], part.ball
        away = points - (turn @ middle + translations[part.link])
        close = np.flatnonzero(np.einsum("ij,ij->i", away, away) <= (radius + margin) ** 2)
        local = away[close] @ turn + middle
        # inside a piece n x + d <= 0 for all its planes
        near[close[(local @ faces[:, :3].T + faces[:, 3] <= margin).all(axis=1)]] = True
    return near


def outliers(points: FloatArray, radius: float, neighbours: int) -> np.ndarray:
    """Mask (m,) of points (m, 3) [m] with fewer than `neighbours` others within radius [m]."""
    from scipy.spatial import cKDTree  # a third of a second to import

    distances, _ = cKDTree(points).query(points, k=[neighbours + 1], distance_upper_bound=radius)
    return ~np.isfinite(distances[:, 0])


@lru_cache(maxsize=4)
def _faces(robot: Robot) -> list[FloatArray]:
    """Planes (f, 4) of each convex piece in its link's frame: normals n, offsets d outwards [m]."""
    from scipy.spatial import ConvexHull

    return [ConvexHull(part.vertices_in_link).equations for part in robot.links]


def voxel_means(points: FloatArray, voxel: float) -> FloatArray:
    """Mean (m, 3) of the points (p, 3) in each cell of a grid with edges of `voxel` [m].

    The grid starts half a voxel below the least coordinates.
    InvalidInputError: a voxel so small that its cells cannot be numbered.
    """
    if len(points) == 0:
        return points
    columns = np.ascontiguousarray(points.T)
    places = [(axis - axis.min()) / voxel + 0.5 for axis in columns]
    across = [np.floor(place.max()) + 1.0 for place in places]
    cells = float(np.prod(across))
    if not cells < 2**62:
        raise InvalidInputError(
            f"voxel of {voxel:g} m is too small for a cloud that is "
            f"{np.ptp(points, axis=0).max():.3g} m long; give a larger one, or crop the cloud"
        )
    x, y, z = (place.astype(np.int64) for place in places)
    cell = (x * int(across[1]) + y) * int(across[2]) + z
    # counting cell by cell needs no sorting
    if cells <= 8 * len(points):
        count = np.bincount(cell)
    else:
        _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    taken = count > 0
    sums = [np.bincount(cell, weights=axis)[taken] for axis in columns]
    return np.stack(sums, axis=1) / count[taken, None]
