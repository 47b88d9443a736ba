"""A grid of distances to the nearest obstacle: one look-up clears a ball, whatever the obstacle count.

Each cell stores a lower bound of the distance from any of its points to any obstacle, cut off at RANGE and
rounded down to a byte. Each block of 2^3 cells also lists the obstacles within REACH of it, for balls that
the bound does not clear.
"""

from typing import Annotated

import numpy as np

from cvqmpt_lab.jit import entry, kernel
from cvqmpt_lab.kernels.collision.grid_filling import (
    COARSE,
    LISTS,
    RANGE,
    STEP,
    DistanceGrid,
    Work,
    fill_blocks,
)

ROOM = 1024  # items of lists, to begin with
REACH = 0.13  # [m] largest ball whose neighbours are listed

# Columns of an obstacle's bounds: an oriented box swelled by a radius.
ROTATION, CENTRE, HALF, SWELLING, COLUMNS = 0, 9, 12, 15, 16


@entry
def assign(
    bounds: Annotated[np.ndarray, "count 16"],
    origin: Annotated[np.ndarray, "3"],
    edge: float,
    blocks: Annotated[np.ndarray, "int64 3"],
    span: Annotated[np.ndarray, "int64 2 3"],
    starts: Annotated[np.ndarray, "int64 all"],
    items: Annotated[np.ndarray, "int32 listed"],
    fill: bool,
):
    """Count (fill False) or write (fill True) the obstacles within RANGE of each coarse block; span: work array."""
    low, high = span[0], span[1]
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
    span = np.empty((2, 3), dtype=np.int64)
    assign(bounds, origin, edge, blocks, span, starts[1:], np.empty(0, dtype=np.int32), False)
    starts = np.cumsum(starts)
    block_items = np.empty(starts[-1], dtype=np.int32)
    assign(bounds, origin, edge, blocks, span, starts[:-1].copy(), block_items, True)
    pairs = tuple(COARSE // 2 * blocks)
    work = _work_arrays(int(np.diff(starts).max()))
    grid = DistanceGrid(
        origin,
        float(cell),
        1.0 / float(cell),
        np.full(tuple(COARSE * blocks), 255, dtype=np.uint8),
        np.zeros(pairs, dtype=np.int64),
        np.zeros(pairs, dtype=np.int32),
        np.empty(0, dtype=np.int32),
    )
    return _fill(bounds, grid, starts, block_items, reach, work)


def _fill(
    bounds: np.ndarray,
    grid: DistanceGrid,
    block_start: np.ndarray,
    block_items: np.ndarray,
    reach: float,
    work: Work,
) -> DistanceGrid:
    """Return the grid with its distances and lists filled, as `fill_blocks` does; grid: without items."""
    grid, block, used = grid._replace(items=np.empty(ROOM, dtype=np.int32)), 0, 0
    while block < len(block_start) - 1:
        block, used = fill_blocks(bounds, grid, block_start, block_items, reach, work, block, used)
        if block < len(block_start) - 1:
            more = max(len(grid.items), work.listed.size)
            grid = grid._replace(items=np.concatenate([grid.items, np.empty(more, dtype=np.int32)]))
    return grid._replace(items=grid.items[:used].copy())


def _work_arrays(most: int) -> Work:
    """Return room for `fill_blocks`, where at most so many obstacles are near one block."""
    plane = COARSE * COARSE
    return Work(
        corner=np.empty(3),
        gaps=np.empty((3, COARSE)),
        yz=np.empty(plane),
        best2=np.empty((COARSE, plane)),
        best=np.empty((COARSE, plane)),
        upper=np.empty(LISTS),
        counts=np.empty(LISTS, dtype=np.int64),
        listed=np.empty((LISTS, most), dtype=np.int32),
        near=np.empty(most),
        kept=np.empty(most, dtype=np.int32),
    )


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
