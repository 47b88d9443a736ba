"""A grid of distances to the nearest obstacle: one look-up clears a ball, whatever the obstacle count.

Each cell stores a lower bound of the distance from any of its points to any obstacle, cut off at RANGE and
rounded down to a byte. Each block of 2^3 cells also lists the obstacles within REACH of it, for balls that
the bound does not clear. Both are filled from coarse to fine: a block of 8^3 cells collects the obstacles
that can matter inside it, and hands the shrinking list to its halves, quarters and cells.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.kernels.compiling import kernel

RANGE = 0.3  # [m] distances are cut off here
REACH = 0.13  # [m] largest ball whose neighbours are listed
COARSE = 8  # cells along the edge of the coarsest block
_STEP = RANGE / 255.0  # [m] of a stored byte
_ROUNDING = 1e-9  # [m] more than the rounding of a computed distance
_HALF_DIAGONAL = 1.7320509  # of a cube of half edge 1, rounded up

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


@kernel(inline="machine")
def _distances(bounds, i, x, y, z, half):
    """Distances of obstacle i from a cube (lower bound; exact for parallel axes) and from its centre [m]."""
    dx, dy, dz = x - bounds[i, 9], y - bounds[i, 10], z - bounds[i, 11]
    cube2 = centre2 = 0.0
    if bounds[i, 1] == 0.0 and bounds[i, 2] == 0.0 and bounds[i, 5] == 0.0:  # axis-aligned, the common case
        a, b, c = abs(dx) - bounds[i, 12], abs(dy) - bounds[i, 13], abs(dz) - bounds[i, 14]
        centre2 = max(a, 0.0) ** 2 + max(b, 0.0) ** 2 + max(c, 0.0) ** 2
        cube2 = max(a - half, 0.0) ** 2 + max(b - half, 0.0) ** 2 + max(c - half, 0.0) ** 2
    else:
        for k in range(3):
            rx, ry, rz = bounds[i, k], bounds[i, 3 + k], bounds[i, 6 + k]
            outside = max(abs(rx * dx + ry * dy + rz * dz) - bounds[i, 12 + k], 0.0)
            centre2 += outside * outside
            outside = max(outside - half * (abs(rx) + abs(ry) + abs(rz)), 0.0)
            cube2 += outside * outside
    return max(np.sqrt(cube2) - bounds[i, 15], 0.0), np.sqrt(centre2) - bounds[i, 15]


@kernel
def _measure(bounds, candidates, n, x, y, z, half, near):
    """Write the distances of candidates from a cube to near; return a bound on what any point has nearest."""
    nearest = RANGE
    for k in range(n):
        near[k], from_centre = _distances(bounds, candidates[k], x, y, z, half)
        nearest = min(nearest, max(from_centre, 0.0) + _HALF_DIAGONAL * half)
    return nearest


@kernel
def _keep(candidates, n, near, limit, kept, m):
    """Append to kept, from place m on, the candidates within limit; return the next place."""
    for k in range(n):
        if near[k] <= limit:
            kept[m] = candidates[k]
            m += 1
    return m


@kernel
def _centre(grid, bx, by, bz, cells):
    """Centre of a block of cells^3 cells."""
    edge = cells * grid.cell
    return (
        grid.origin[0] + (bx + 0.5) * edge,
        grid.origin[1] + (by + 0.5) * edge,
        grid.origin[2] + (bz + 0.5) * edge,
    )


@kernel
def _relevant(bounds, grid, bx, by, bz, cells, candidates, n, reach, near, kept):
    """Copy to kept the candidates that can be nearest somewhere in a block, or are within reach of it."""
    x, y, z = _centre(grid, bx, by, bz, cells)
    nearest = _measure(bounds, candidates, n, x, y, z, 0.5 * cells * grid.cell, near)
    return _keep(candidates, n, near, max(nearest, reach), kept, 0)


@kernel
def _fill_cells(bounds, grid, bx, by, bz, candidates, n):
    """Store the distances of the 2^3 cells of a list block."""
    half = 0.5 * grid.cell
    for cx in range(2 * bx, 2 * bx + 2):
        for cy in range(2 * by, 2 * by + 2):
            for cz in range(2 * bz, 2 * bz + 2):
                x, y, z = _centre(grid, cx, cy, cz, 1)
                best = RANGE
                for k in range(n):
                    best = min(best, _distances(bounds, candidates[k], x, y, z, half)[0])
                grid.distance[cx, cy, cz] = np.uint8(max(best - _ROUNDING, 0.0) / _STEP)


@kernel(allocates=True)
def _with_room(items, used, more):
    """Return items, copied into a longer array if more do not fit."""
    if used + more <= items.shape[0]:
        return items
    longer = np.empty(2 * (used + more), np.int32)
    longer[:used] = items[:used]
    return longer


@kernel(allocates=True)
def _fill(bounds, grid, block_start, block_items, reach):
    """Fill distances and lists; return the items of the lists."""
    blocks_y, blocks_z = grid.distance.shape[1] // COARSE, grid.distance.shape[2] // COARSE
    most = 1
    for block in range(block_start.shape[0] - 1):
        most = max(most, block_start[block + 1] - block_start[block])
    near = np.empty(most)
    coarse, middle, fine = np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.int32)
    items, used = np.empty(1024, np.int32), 0
    for block in range(block_start.shape[0] - 1):
        first, last = block_start[block], block_start[block + 1]
        bz, by, bx = block % blocks_z, block // blocks_z % blocks_y, block // (blocks_z * blocks_y)
        n0 = _relevant(
            bounds, grid, bx, by, bz, 8, block_items[first:last], last - first, reach, near, coarse
        )
        for part in range(8 if n0 > 0 else 0):
            px, py, pz = 2 * bx + (part & 1), 2 * by + (part >> 1 & 1), 2 * bz + (part >> 2)
            n1 = _relevant(bounds, grid, px, py, pz, 4, coarse, n0, reach, near, middle)
            for sub in range(8 if n1 > 0 else 0):
                sx, sy, sz = 2 * px + (sub & 1), 2 * py + (sub >> 1 & 1), 2 * pz + (sub >> 2)
                x, y, z = _centre(grid, sx, sy, sz, 2)
                nearest = _measure(bounds, middle, n1, x, y, z, grid.cell, near)
                _fill_cells(bounds, grid, sx, sy, sz, fine, _keep(middle, n1, near, nearest, fine, 0))
                items = _with_room(items, used, n1)
                end = _keep(middle, n1, near, reach, items, used)
                grid.list_start[sx, sy, sz], grid.list_count[sx, sy, sz] = used, end - used
                used = end
    return items[:used].copy()


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
    grid = DistanceGrid(
        origin,
        float(cell),
        1.0 / float(cell),
        np.full(tuple(COARSE * blocks), 255, dtype=np.uint8),
        np.zeros(pairs, dtype=np.int64),
        np.zeros(pairs, dtype=np.int32),
        np.empty(0, dtype=np.int32),
    )
    return grid._replace(items=_fill(bounds, grid, starts, block_items, reach))


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
    return grid.distance[ix, iy, iz] * _STEP
