"""Sorting the points of clouds into small boxes of at most a handful of neighbours."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError

MOST_POINTS = 16  # in one cluster
_FINE = 8  # steps of the sorting curve along the edge of a voxel


class Cloud(NamedTuple):
    """Points in the world, each a ball."""

    points: np.ndarray
    """(k, 3) [m]."""
    radius: float
    """Of every ball [m]."""


class PointClusters(NamedTuple):
    """Axis-aligned boxes around the centres of neighbouring points."""

    centre: np.ndarray
    """(n, 3) [m]."""
    half: np.ndarray
    """(n, 3) half edges [m]."""
    radius: np.ndarray
    """(n,) of the points' balls [m]."""
    cloud: np.ndarray
    """(n,) int64, which cloud."""
    start: np.ndarray
    """(n + 1,) int64 range of each cluster in `points`."""
    points: np.ndarray
    """(k, 3), sorted by cluster [m]."""


def cluster_points(clouds: Sequence[Cloud], voxel: float) -> PointClusters:
    """Return the points of clouds in clusters no larger than a voxel of this edge [m].

    Raises InvalidInputError for points that are not finite or a negative radius.
    """
    parts = [_cluster_cloud(cloud, k, voxel) for k, cloud in enumerate(clouds) if len(cloud.points)]
    if not parts:
        none = np.empty((0, 3))
        return PointClusters(none, none, np.empty(0), np.empty(0, np.int64), np.zeros(1, np.int64), none)
    offsets = np.cumsum([0, *(len(part.points) for part in parts)])
    starts = [part.start[:-1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
    return PointClusters(
        np.concatenate([part.centre for part in parts]),
        np.concatenate([part.half for part in parts]),
        np.concatenate([part.radius for part in parts]),
        np.concatenate([part.cloud for part in parts]),
        np.concatenate([*starts, offsets[-1:]]).astype(np.int64),
        np.concatenate([part.points for part in parts]),
    )


def _cluster_cloud(cloud: Cloud, number: int, voxel: float) -> PointClusters:
    points = np.asarray(cloud.points, dtype=float).reshape(-1, 3)
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise InvalidInputError(
            f"cloud {number}: point {bad} is {points[bad]}; remove points that are not finite"
        )
    if not 0.0 <= cloud.radius < np.inf:
        raise InvalidInputError(
            f"cloud {number}: radius {cloud.radius} of its points; give a length >= 0 [m]"
        )
    key = _curve_position(points, voxel / _FINE)
    order = np.argsort(key, kind="stable")
    points, cell = points[order], key[order] // _FINE**3
    first_of_cell = np.concatenate([[True], cell[1:] != cell[:-1]])
    place = np.arange(len(points)) - np.flatnonzero(first_of_cell)[np.cumsum(first_of_cell) - 1]
    start = np.flatnonzero(place % MOST_POINTS == 0)
    low, high = np.minimum.reduceat(points, start), np.maximum.reduceat(points, start)
    n = len(start)
    return PointClusters(
        0.5 * (low + high),
        0.5 * (high - low) + 1e-12,
        np.full(n, float(cloud.radius)),
        np.full(n, number, dtype=np.int64),
        np.append(start, len(points)),
        points,
    )


def _curve_position(points: np.ndarray, step: float) -> np.ndarray:
    """Return the position (k,) int64 of points on a Morton curve with cells of edge step [m]."""
    extent = float(np.ptp(points, axis=0).max())
    step = max(step, extent / (1 << 20))
    index = ((points - points.min(axis=0)) / step).astype(np.int64)
    position = np.zeros(len(points), dtype=np.int64)
    for bit in range(max(int(index.max()).bit_length(), 1)):
        for a in range(3):
            position |= ((index[:, a] >> bit) & 1) << (3 * bit + a)
    return position
