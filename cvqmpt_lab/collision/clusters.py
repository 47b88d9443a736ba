"""Sorting the primitives of clouds, points or small boxes, into boxes of at most a handful of
neighbours.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError

MOST_PRIMITIVES = 16  # in one cluster
_FINE = 8  # steps of the sorting curve along the edge of a voxel
_BITS = 21  # of each coordinate on the curve
_SPREADING = (  # shifts and masks that open gaps of two bits
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


class Cloud(NamedTuple):
    """Boxes along the axes of one frame, each inflated by a radius; points are boxes of size zero."""

    centre: np.ndarray  # (k, 3) [m]
    half: np.ndarray  # (k, 3) half edges [m]
    radius: float  # Inflation of every box [m]
    T_world_cloud: np.ndarray  # (4, 4), pose of their frame [m]


class Clusters(NamedTuple):
    """Boxes around neighbouring primitives, along the axes of their cloud's frame."""

    centre: np.ndarray  # (n, 3) in the world [m]
    half: np.ndarray  # (n, 3) half edges [m]
    rotation: np.ndarray  # (n, 3, 3), of the cloud's frame
    radius: np.ndarray  # (n,) inflation of the primitives [m]
    start: np.ndarray  # (n + 1,) int64 range in `primitives`; empty for a cluster of one primitive
    # (k, 6) centres, from the cluster's in the cloud's axes, and half edges [m]
    primitives: np.ndarray


def cluster_primitives(clouds: Sequence[Cloud], voxel: float) -> Clusters:
    """Return the primitives of clouds in clusters of those whose centres lie in the same voxel of
    this edge [m].

    Raises InvalidInputError for primitives that are not finite or a negative radius.
    """
    parts = [_cluster_cloud(cloud, k, voxel) for k, cloud in enumerate(clouds) if len(cloud.centre)]
    if not parts:
        none = np.empty((0, 3))
        return Clusters(
            none,
            none,
            np.empty((0, 3, 3)),
            np.empty(0),
            np.zeros(1, np.int64),
            primitives=np.empty((0, 6)),
        )
    offsets = np.cumsum([0, *(len(part.primitives) for part in parts)])
    starts = [part.start[:-1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
    names = (name for name in Clusters._fields if name != "start")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Clusters(**joined, start=np.concatenate([*starts, offsets[-1:]]).astype(np.int64))


def _cluster_cloud(cloud: Cloud, number: int, voxel: float) -> Clusters:
    _check(cloud, number)
    key = _curve_position(cloud.centre, voxel / _FINE)
    order = np.argsort(key)
    centre, half, cell = cloud.centre[order], cloud.half[order], key[order] // _FINE**3
    first_of_cell = np.append(True, cell[1:] != cell[:-1])
    place = np.arange(len(cell)) - np.flatnonzero(first_of_cell)[np.cumsum(first_of_cell) - 1]
    start = np.flatnonzero(place % MOST_PRIMITIVES == 0)
    low, high = np.minimum.reduceat(centre - half, start), np.maximum.reduceat(centre + half, start)
    middle, count = 0.5 * (low + high), np.diff(start, append=len(cell))
    listed = np.repeat(count > 1, count)
    primitives = np.concatenate([centre - np.repeat(middle, count, axis=0), half], axis=1)[listed]
    R, n = cloud.T_world_cloud[:3, :3], len(start)
    return Clusters(
        middle @ R.T + cloud.T_world_cloud[:3, 3],
        0.5 * (high - low) + 1e-12,
        np.tile(R, (n, 1, 1)),
        np.full(n, float(cloud.radius)),
        np.append(0, np.cumsum(np.where(count > 1, count, 0))),
        primitives,
    )


def _check(cloud: Cloud, number: int) -> None:
    """Refuse what no kernel could work with."""
    finite = np.isfinite(cloud.centre).all(axis=1) & np.isfinite(cloud.half).all(axis=1)
    if not finite.all():
        bad = int(np.flatnonzero(~finite)[0])
        raise InvalidInputError(
            f"cloud {number}: point {bad} is {cloud.centre[bad]}; remove points that are not finite"
        )
    if not 0.0 <= cloud.radius < np.inf:
        raise InvalidInputError(
            f"cloud {number}: radius {cloud.radius} of its points; give a length >= 0 [m]"
        )


def _curve_position(points: np.ndarray, step: float) -> np.ndarray:
    """Return the position (k,) int64 of points on a Morton curve with cells of edge step [m]."""
    extent = float(np.ptp(points, axis=0).max())
    step = max(step, extent / ((1 << _BITS) - 1))
    index = ((points - points.min(axis=0)) / step).astype(np.int64)
    return _spread(index[:, 0]) | _spread(index[:, 1]) << 1 | _spread(index[:, 2]) << 2


def _spread(number: np.ndarray) -> np.ndarray:
    """Move bit k of each number (below 2^21) to bit 3 k."""
    for shift, mask in _SPREADING:
        number = (number | number << shift) & mask
    return number
