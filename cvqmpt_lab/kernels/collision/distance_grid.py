"""A grid of distances to the nearest obstacle: one look-up clears a ball, whatever the obstacle count.

Each cell stores a lower bound of the distance from any of its points to any obstacle, cut off at RANGE and
rounded down to a byte. Each block of 2^3 cells also lists the obstacles within REACH of it, for balls that
the bound does not clear.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.kernels.collision.grid_filling import COARSE, RANGE, STEP, fill, work_arrays
from cvqmpt_lab.kernels.compiling import kernel

REACH = 0.13  # [m] largest ball whose neighbours are listed

# Columns of an obstacle's bounds: an oriented box swelled by a radius.
ROTATION, CENTRE, HALF, SWELLING, COLUMNS = 0, 9, 12, 15, 16


class DistanceGrid(NamedTuple):
    """Lower bounds of distances, and lists of the obstacles nearby; see the module's docstring."""

    origin: Annotated[np.ndarray, "3"]
    """Corner of the grid [m]."""
    cell: float
    """Edge of a cell [m]."""
    cells_per_metre: float
    """Its inverse [1/m]."""
    distance: Annotated[np.ndarray, "uint8 cells_x cells_y cells_z"]
    """In units of RANGE / 255."""
    list_start: Annotated[np.ndarray, "int64 lists_x lists_y lists_z"]
    """Where the list of a block of 2^3 cells begins in `items`."""
    list_count: Annotated[np.ndarray, "int32 lists_x lists_y lists_z"]
    """How long it is."""
    items: Annotated[np.ndarray, "int32 listed"]
    """Obstacle indices."""


@kernel(allocates=True)
def _assign(bounds, origin, edge, blocks, starts, items, fill):
    """Count (fill False) or write (fill True) the obstacles within RANGE of each coarse block."""
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for i in range(bounds.shape[0]):
        for a in range(3):
            extent = RANGE + bounds[i, 15]
            for k in range(3):
                extent += abs(bounds[i, 3 * a + k]) * bounds[i, 12 + k]
            low[a] = int(min(max(np.floor((bounds[i, 9 + a] - extent - origin[a]) / edge), 0.0), blocks[a]))
            high[a] = int(
                min(max(np.floor((bounds[i, 9 + a] + extent - origin[a]) / edge) + 1.0, 0.0), blocks[a])
            )
        for bx in range(low[0], high[0]):
            for by in range(low[1], high[1]):
                for bz in range(low[2], high[2]):
                    block = (bx * blocks[1] + by) * blocks[2] + bz
                    if fill:
                        items[starts[block]] = i
                    starts[block] += 1


def distance_grid(
    bounds: np.ndarray, lower: np.ndarray, upper: np.ndarray, cell: float, reach: float = REACH
) -> DistanceGrid:
    """Return the grid over the box lower..upper (3,) [m] around obstacles with bounds (n, COLUMNS)."""
    edge = COARSE * cell
    origin = np.asarray(lower, dtype=float).copy()
    blocks = np.maximum(np.ceil((np.asarray(upper) - origin) / edge - 1e-9).astype(np.int64), 1)
    starts = np.zeros(int(blocks.prod()) + 1, dtype=np.int64)
    _assign(bounds, origin, edge, blocks, starts[1:], np.empty(0, dtype=np.int32), False)
    starts = np.cumsum(starts)
    block_items = np.empty(starts[-1], dtype=np.int32)
    _assign(bounds, origin, edge, blocks, starts[:-1].copy(), block_items, True)
    pairs = tuple(COARSE // 2 * blocks)
    work = work_arrays(int(np.diff(starts).max()))
    grid = DistanceGrid(
        origin,
        float(cell),
        1.0 / float(cell),
        np.full(tuple(COARSE * blocks), 255, dtype=np.uint8),
        np.zeros(pairs, dtype=np.int64),
        np.zeros(pairs, dtype=np.int32),
        np.empty(0, dtype=np.int32),
    )
    return grid._replace(items=fill(bounds, grid, starts, block_items, reach, work))


@kernel(inline="machine")
def cell_of(grid, x, y, z):
    """Return the cell (3 ints) of a point and whether the point lies in the grid (else cell 0)."""
    scale = grid.cells_per_metre
    fx, fy, fz = (x - grid.origin[0]) * scale, (y - grid.origin[1]) * scale, (z - grid.origin[2]) * scale
    nx, ny, nz = grid.distance.shape
    if 0.0 <= fx < nx and 0.0 <= fy < ny and 0.0 <= fz < nz:
        return int(fx), int(fy), int(fz), True
    return 0, 0, 0, False


@kernel(inline="machine")
def known_distance(grid, ix, iy, iz):
    """Return the lower bound stored in a cell [m]."""
    return grid.distance[ix, iy, iz] * STEP
