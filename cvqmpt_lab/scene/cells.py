"""Occupancy maps and large point clouds as cells of a grid: the same cubes for the compiled checker and for coal."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.scene.shapes import Measured, OccupancyMap, PointCloud

MOST_BALLS = 1000  # clouds of more points are checked as cells, which are only roughly the balls
MOST_CELLS_ACROSS = 60_000  # along an edge of a cloud; of finer ones the cells are made larger
DENSE = 1 << 26  # grids of no more cells are searched as a whole: one byte a cell


@dataclass(frozen=True, eq=False)
class Cells:
    """Cubes of a grid, each inflated by a padding."""

    index: np.ndarray  # (k, 3) int64, each only once, in order, the least of every column 0
    edge: float  # of each cube [m]
    padding: float  # inflation radius [m]
    T_parent_cells: np.ndarray  # (4, 4), of the corner of cell 0, 0, 0 in the world or the hand [m]


class Boxes(NamedTuple):
    """Boxes along the axes of a grid."""

    low: np.ndarray  # (b, 3) int64, index of the first cell in each
    high: np.ndarray  # (b, 3) int64, index after the last


def cells_of(shape: Measured, T_parent_shape: np.ndarray, reach: float = np.inf) -> Cells | None:
    """Cells of a map, or those that hold the points of a cloud, within reach [m] of the parent's origin, if any.

    The cells of a cloud are as wide as its balls.
    """
    if isinstance(shape, PointCloud):
        edge, slack, padding, points = 2.0 * shape.radius, shape.radius, 0.0, shape.points
    else:
        edge, padding, points = shape.resolution, shape.padding, shape.centres
        slack = np.sqrt(0.75) * edge + padding
    columns = np.ascontiguousarray(points.T)  # a coordinate each: many times as fast as rows of three
    if reach < np.inf:
        away = T_parent_shape[:3, :3] @ columns + T_parent_shape[:3, 3:]
        columns = columns[:, np.einsum("ij,ij->j", away, away) <= (reach + slack) ** 2]
    if columns.shape[1] == 0:
        return None
    edge = max(edge, float(np.ptp(columns, axis=1).max()) / MOST_CELLS_ACROSS)
    place = np.floor(columns * (1.0 / edge))
    first = place.min(axis=1)
    T_parent_cells = T_parent_shape.copy()
    T_parent_cells[:3, 3] += T_parent_shape[:3, :3] @ (first * edge)
    return Cells(distinct((place - first[:, None]).astype(np.int64).T), edge, padding, T_parent_cells)


def map_of_points(points: FloatArray, resolution: float, padding: float = 0.0) -> OccupancyMap:
    """The cells that hold some of points (m, 3), m >= 1 [m], of the grid through the origin; see `OccupancyMap`."""
    place = np.floor(points / resolution)
    first = place.min(axis=0)
    return OccupancyMap(distinct((place - first).astype(np.int64)) + first, resolution, padding)


def distinct(index: np.ndarray) -> np.ndarray:
    """Rows of an index (m, 3) of int64 >= 0, each once (k, 3), in order."""
    across = tuple(index.max(axis=0) + 1)
    keys = np.ravel_multi_index(tuple(index.T), across)
    if np.prod(across) <= DENSE:
        taken = np.zeros(across, dtype=bool)
        taken.ravel()[keys] = True
        keys = np.flatnonzero(taken)
    else:
        keys = np.unique(keys)
    return np.stack(np.unravel_index(keys, across), axis=1)


def merged(index: np.ndarray) -> Boxes:
    """Few boxes that together are the cells (k, 3), which are in order.

    Neighbours of equal extent are joined along z, then y, then x.
    """
    boxes = _joined(Boxes(index, index + 1), 2)
    for axis in (1, 0):
        boxes = _joined(_in_order(boxes, axis), axis)
    return boxes


def _joined(boxes: Boxes, axis: int) -> Boxes:
    """Boxes that follow each other along an axis, with equal extents along the others, made one."""
    low, high = boxes
    follows = low[1:, axis] == high[:-1, axis]
    for k in range(3):
        if k != axis:
            follows &= (low[1:, k] == low[:-1, k]) & (high[1:, k] == high[:-1, k])
    return Boxes(low[np.append(True, ~follows)], high[np.append(~follows, True)])


def _in_order(boxes: Boxes, axis: int) -> Boxes:
    """The boxes ordered so that those that follow each other along an axis stand beside each other."""
    columns = [*(k for k in range(3) if k != axis), axis]
    across = tuple(boxes.high[:, columns].max(axis=0))
    order = np.argsort(np.ravel_multi_index(tuple(boxes.low[:, columns].T), across))
    return Boxes(boxes.low[order], boxes.high[order])


def seen_points(shape: Measured) -> FloatArray:
    """Points (p, 3) [m] on what was measured, in its frame: those of a cloud, middles of a map's outermost cells."""
    if isinstance(shape, PointCloud):
        return shape.points
    return shape.centres[exposed(shape.cells.astype(np.int64))]


def exposed(index: np.ndarray) -> np.ndarray:
    """Whether each of the cells (k, 3) has a neighbour that is none of them, (k,) bool."""
    from_one = index - index.min(axis=0) + 1
    across = tuple(from_one.max(axis=0) + 2)
    keys = np.ravel_multi_index(tuple(from_one.T), across)
    steps = np.array([across[1] * across[2], across[2], 1])
    taken = np.sort(keys)
    inside = np.ones(len(keys), dtype=bool)
    for step in (*steps, *-steps):
        place = np.searchsorted(taken, keys + step).clip(max=len(taken) - 1)
        inside &= taken[place] == keys + step
    return ~inside
