"""Boxes that contain point clouds and occupancy maps, for both collision checkers."""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.scene.shapes import Measured, OccupancyMap, PointCloud, require_resolution

MAX_BALLS = 1000  # larger clouds are checked as boxes that contain their balls
# edge of a cloud's cells in radii of its balls; larger: fewer boxes with more free space inside
CELL_EDGE_RADII = np.sqrt(2.0)


class Blocks(NamedTuple):
    """Axis-aligned boxes in a shape's frame, all inflated by the same radius."""

    low: np.ndarray  # (b, 3) least corners [m]
    high: np.ndarray  # (b, 3) greatest corners [m]
    padding: float  # inflation radius [m]

    def poses(self, T_parent_shape: np.ndarray) -> np.ndarray:
        """Poses (b, 4, 4) of their centres for a pose (4, 4) of the shape [m]."""
        poses = np.tile(T_parent_shape, (len(self.low), 1, 1))
        poses[:, :3, 3] += 0.5 * (self.low + self.high) @ T_parent_shape[:3, :3].T
        return poses


class Cells(NamedTuple):
    """Boxes of one or more grid cells, and the bounds of the points in each box."""

    low: np.ndarray  # (b, 3) int64 index (i, j, k) of the first cell of each box
    high: np.ndarray  # (b, 3) int64 index after the last cell, along each axis
    least: np.ndarray  # (b, 3) least corner of the bounds of the points in each box [m]
    most: np.ndarray  # (b, 3) greatest corner of these bounds [m]


def blocks_of(shape: Measured, T_parent_shape: np.ndarray, reach: float = np.inf) -> Blocks:
    """Return boxes that together contain the cells of a map, or the balls of a cloud.

    Map: a box is a block of occupied cells. Cloud of up to `MAX_BALLS` points: a box is one point;
    inflated by the radius it is the ball. Larger cloud: its points are sorted into cells with edges
    of `CELL_EDGE_RADII` radii, and a box bounds the points of a block of cells. Inflated by the
    radius, these boxes contain every ball. Before that, a point of a box is at most
    sqrt(3) `CELL_EDGE_RADII` radii from a point of the cloud.

    Args:
        shape: a cloud or a map.
        T_parent_shape: (4, 4) pose of the shape [m].
        reach: boxes farther than this from the parent's origin may be left out [m].
    """
    if isinstance(shape, PointCloud):
        points, padding = shape.points, shape.radius
        edge, half = CELL_EDGE_RADII * shape.radius, 0.0
        if len(points) <= MAX_BALLS:
            return Blocks(points, points, padding)
    else:
        points, padding = shape.centres, shape.padding
        edge, half = shape.resolution, 0.5 * shape.resolution
    columns = np.ascontiguousarray(points.T)  # (3, m): faster than (m, 3)
    if reach < np.inf:
        away = T_parent_shape[:3, :3] @ columns + T_parent_shape[:3, 3:]
        farthest = reach + np.sqrt(3.0) * half + padding
        columns = columns[:, np.einsum("ij,ij->j", away, away) <= farthest**2]
    if columns.shape[1] == 0:
        return Blocks(columns.T, columns.T, padding)
    cells = merged(cells_with(columns, edge))
    return Blocks(cells.least - half, cells.most + half, padding)


def cells_with(columns: np.ndarray, edge: float, most_across: int = 60_000) -> Cells:
    """Return the grid cells with an `edge` [m] that contain points (3, m) [m], m >= 1, sorted.

    The edge is increased if the cloud spans more than `most_across` cells along an axis: the int64
    keys of cells then cannot overflow.
    """
    first = columns.min(axis=1)
    edge = max(edge, float(np.ptp(columns, axis=1).max()) / most_across)
    place = np.rint((columns - first[:, None]) * (1.0 / edge)).astype(np.int64)
    across = tuple(place.max(axis=1) + 1)
    keys = np.ravel_multi_index(tuple(place), across)
    order = np.argsort(keys)  # the order within a cell does not matter
    keys, columns = keys[order], columns[:, order]
    start = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    index = np.stack(np.unravel_index(keys[start], across), axis=1)
    least = np.minimum.reduceat(columns, start, axis=1).T
    most = np.maximum.reduceat(columns, start, axis=1).T
    return Cells(index, index + 1, least, most)


def map_of_points(points: FloatArray, resolution: float, padding: float = 0.0) -> OccupancyMap:
    """Return the cells that contain points (m, 3) [m], m >= 1; cell (0, 0, 0) is at the origin."""
    require_resolution(resolution)
    place = np.floor(points / resolution)
    first = place.min(axis=0)
    return OccupancyMap(distinct((place - first).astype(np.int64)) + first, resolution, padding)


def distinct(index: np.ndarray, dense: int = 1 << 26) -> np.ndarray:
    """Return the sorted distinct rows (k, 3) of indices (m, 3) >= 0.

    A boolean grid of up to `dense` bytes is faster than sorting and is used if it suffices.
    """
    across = tuple(index.max(axis=0) + 1)
    keys = np.ravel_multi_index(tuple(index.T), across)
    if np.prod(across) <= dense:
        taken = np.zeros(across, dtype=bool)
        taken.ravel()[keys] = True
        keys = np.flatnonzero(taken)
    else:
        keys = np.unique(keys)
    return np.stack(np.unravel_index(keys, across), axis=1)


def merged(cells: Cells) -> Cells:
    """Merge ordered cells into few boxes: neighbours of equal extent along z, then y, then x."""
    boxes = _joined(cells, 2)
    for axis in (1, 0):
        # after sorting, boxes that touch along this axis are consecutive rows
        columns = [*(k for k in range(3) if k != axis), axis]
        across = tuple(boxes.high[:, columns].max(axis=0))
        order = np.argsort(np.ravel_multi_index(tuple(boxes.low[:, columns].T), across))
        boxes = _joined(Cells(*(corners[order] for corners in boxes)), axis)
    return boxes


def _joined(boxes: Cells, axis: int) -> Cells:
    """Merge consecutive boxes that touch along an axis and have equal extents along the others."""
    low, high, least, most = boxes
    follows = low[1:, axis] == high[:-1, axis]
    for k in range(3):
        if k != axis:
            follows &= (low[1:, k] == low[:-1, k]) & (high[1:, k] == high[:-1, k])
    start = np.flatnonzero(np.append(True, ~follows))
    last = np.append(start[1:], len(low)) - 1
    return Cells(
        low[start], high[last], np.minimum.reduceat(least, start), np.maximum.reduceat(most, start)
    )


def seen_points(shape: Measured) -> FloatArray:
    """Return points (p, 3) [m, shape's frame] that a camera could see.

    These are all points of a cloud, or the centres of a map's cells next to a free cell.
    """
    if isinstance(shape, PointCloud):
        return shape.points
    index = shape.cells.astype(np.int64)
    # with a border of one free cell, key + step is the key of a neighbour for every cell
    from_one = index - index.min(axis=0) + 1
    across = tuple(from_one.max(axis=0) + 2)
    keys = np.ravel_multi_index(tuple(from_one.T), across)
    steps = np.array([across[1] * across[2], across[2], 1])
    taken = np.sort(keys)
    inside = np.ones(len(keys), dtype=bool)
    for step in (*steps, *-steps):
        place = np.searchsorted(taken, keys + step).clip(max=len(taken) - 1)
        inside &= taken[place] == keys + step
    return shape.centres[~inside]
