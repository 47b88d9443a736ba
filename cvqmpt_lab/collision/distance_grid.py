"""Grid of lower bounds on obstacle distances: a ball below the bound of its cell is free.

Each cell holds a lower bound, rounded down to a byte; each list block of 2^3 cells lists the
obstacles nearby. The grid is filled by blocks of 8^3 cells: each obstacle that can matter inside a
block lowers the distances of all its cells. For an axis-aligned box, a squared distance is the sum
of one term per axis (24 terms a block): each of 512 cells costs a square root, two additions and a
comparison. Turned boxes are measured cell by cell, where they can be nearest.

In all functions `bounds` (k, BOUNDS_COLUMNS) are oriented boxes around obstacles: rotation by rows,
centre, half edges, inflation [m].
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel

GRID_RANGE_M = 0.3  # distances are cut off here
GRID_STEP_M = GRID_RANGE_M / 255.0  # distance of one unit of a stored byte
GRID_REACH_M = 0.13  # radius of the largest ball whose neighbours are listed
BLOCK_CELLS = 8  # along the edge of a block
BLOCK_LISTS = 4  # list blocks along the edge of a block
# first columns of the centre, the half edges and the inflation in bounds, and number of columns
BOUNDS_CENTRE, BOUNDS_HALF, BOUNDS_INFLATION, BOUNDS_COLUMNS = 9, 12, 15, 16
_CUBE_HALF_DIAGONAL = 1.7320509  # of a cube of half edge 1, rounded up


class DistanceGrid(NamedTuple):
    """Lower bounds of distances, and lists of the obstacles nearby; see `distance_grid`."""

    origin: Annotated[np.ndarray, "3"]  # Corner of the grid [m]
    cell: float  # Edge of a cell [m]
    cells_per_metre: float  # Its inverse [1/m]
    distance: Annotated[np.ndarray, "uint8 cells_x cells_y cells_z"]  # In units of GRID_STEP_M
    # First of `items` of a 2^3 block
    list_start: Annotated[np.ndarray, "int64 lists_x lists_y lists_z"]
    list_count: Annotated[np.ndarray, "int32 lists_x lists_y lists_z"]  # Length of its list
    items: Annotated[np.ndarray, "int32 listed"]  # Obstacle indices


@kernel(inline="machine")
def _distances(bounds, i, x, y, z, half):
    """Distances [m] of obstacle i from a cube (a lower bound) and from the cube's centre (x, y, z).

    half: half edge of the cube [m].
    """
    dx, dy, dz = x - bounds[i, 9], y - bounds[i, 10], z - bounds[i, 11]
    cube2 = centre2 = 0.0
    # axis-aligned, the common case
    if bounds[i, 1] == 0.0 and bounds[i, 2] == 0.0 and bounds[i, 5] == 0.0:
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
def _relevant(bounds, grid, corner, candidates, near, kept):
    """Keep the candidates that can be nearest somewhere in a block, or are within GRID_REACH_M.

    Args:
        bounds: boxes around all obstacles.
        grid: the grid.
        corner: corner of the block (3,) [m].
        candidates: rows of obstacles (c,).
        near: distances from the block to the obstacles that are kept (c,) [m]; written.
        kept: rows of the obstacles that are kept (c,); written.

    Returns:
        Number of obstacles that are kept.
    """
    half, nearest, n = 0.5 * BLOCK_CELLS * grid.cell, GRID_RANGE_M, 0
    x, y, z = corner[0] + half, corner[1] + half, corner[2] + half
    for k in range(candidates.shape[0]):
        near[k], from_centre = _distances(bounds, candidates[k], x, y, z, half)
        nearest = min(nearest, max(from_centre, 0.0) + _CUBE_HALF_DIAGONAL * half)
    for k in range(candidates.shape[0]):
        if near[k] <= max(nearest, GRID_REACH_M):
            kept[n], near[n] = candidates[k], near[k]
            n += 1
    return n


@kernel
def _gaps(low, high, first, edge, gaps):
    """Write squared distances [m^2] from the interval low..high to consecutive intervals.

    first: start of the first interval [m]; edge: length of each interval [m].
    """
    for k in range(gaps.shape[0]):
        gap = max(low - (first + (k + 1) * edge), first + k * edge - high, 0.0)
        gaps[k] = gap * gap


@kernel
def _lower(best, x, yz, inflation):
    """Set best[i, j] = min(best[i, j], sqrt(x[i] + yz[j]) - inflation) [m]."""
    for cx in range(BLOCK_CELLS):
        gap2 = x[cx]
        for c in range(BLOCK_CELLS * BLOCK_CELLS):
            there = np.sqrt(gap2 + yz[c]) - inflation
            best[cx, c] = there if there < best[cx, c] else best[cx, c]


@kernel
def _add_straight(bounds, i, grid, matters, work):
    """Lower the distances of a block's cells by an axis-aligned box; list the box.

    matters: False when no distance of the block can be lowered.
    """
    inflation = bounds[i, 15]
    for a in range(3):
        low, high = bounds[i, 9 + a] - bounds[i, 12 + a], bounds[i, 9 + a] + bounds[i, 12 + a]
        _gaps(low, high, work.corner[a], grid.cell, work.gaps[a])
    x, y, z = work.gaps[0], work.gaps[1], work.gaps[2]
    if matters:
        for cy in range(BLOCK_CELLS):
            for cz in range(BLOCK_CELLS):
                work.yz[BLOCK_CELLS * cy + cz] = y[cy] + z[cz]
        _lower(work.best, x, work.yz, inflation)
    limit2 = (GRID_REACH_M + inflation) * (GRID_REACH_M + inflation)
    for lx in range(BLOCK_LISTS):
        across = min(x[2 * lx], x[2 * lx + 1])
        for ly in range(BLOCK_LISTS if across <= limit2 else 0):
            plane = across + min(y[2 * ly], y[2 * ly + 1])
            for lz in range(BLOCK_LISTS if plane <= limit2 else 0):
                if plane + min(z[2 * lz], z[2 * lz + 1]) <= limit2:
                    s = (lx * BLOCK_LISTS + ly) * BLOCK_LISTS + lz
                    work.listed[s, work.counts[s]] = i
                    work.counts[s] += 1


@kernel
def _add_turned(bounds, i, grid, work):
    """Lower the distances of a block's cells by a turned box; list the box."""
    edge, corner, upper, best = grid.cell, work.corner, work.upper, work.best
    for s in range(BLOCK_LISTS**3):
        lx, ly, lz = 2 * (s >> 4), 2 * (s >> 2 & 3), 2 * (s & 3)
        x, y, z = (
            corner[0] + (lx + 1) * edge,
            corner[1] + (ly + 1) * edge,
            corner[2] + (lz + 1) * edge,
        )
        near, from_centre = _distances(bounds, i, x, y, z, edge)
        if near <= GRID_REACH_M:
            work.listed[s, work.counts[s]] = i
            work.counts[s] += 1
        if near > upper[s]:
            continue
        upper[s] = min(upper[s], max(from_centre, 0.0) + _CUBE_HALF_DIAGONAL * edge)
        for k in range(8):
            cx, cy, cz = lx + (k >> 2), ly + (k >> 1 & 1), lz + (k & 1)
            x, y, z = (
                corner[0] + (cx + 0.5) * edge,
                corner[1] + (cy + 0.5) * edge,
                corner[2] + (cz + 0.5) * edge,
            )
            c = BLOCK_CELLS * cy + cz
            best[cx, c] = min(best[cx, c], _distances(bounds, i, x, y, z, 0.5 * edge)[0])


@kernel
def _store(grid, bx, by, bz, best):
    """Round the distances `best` of block (bx, by, bz) down to bytes."""
    for cx in range(BLOCK_CELLS):
        for cy in range(BLOCK_CELLS):
            for cz in range(BLOCK_CELLS):
                c = BLOCK_CELLS * cy + cz
                nearest = best[cx, c]
                # subtract 1e-9 m, which exceeds the rounding error of a computed distance
                steps = 255 if nearest >= GRID_RANGE_M else max(nearest - 1e-9, 0.0) / GRID_STEP_M
                x, y, z = BLOCK_CELLS * bx + cx, BLOCK_CELLS * by + cy, BLOCK_CELLS * bz + cz
                grid.distance[x, y, z] = np.uint8(steps)


class Work(NamedTuple):
    """Work arrays of one block."""

    corner: Annotated[np.ndarray, "3"]  # Of the block [m]
    # Squared distances of a box from cells along each axis [m^2]
    gaps: Annotated[np.ndarray, "3 8"]
    yz: Annotated[np.ndarray, "64"]  # Sums of the gaps along y and z
    best: Annotated[np.ndarray, "8 64"]  # Distances of the cells [m]
    # Upper bound on the distances of each list block's cells [m]
    upper: Annotated[np.ndarray, "64"]
    counts: Annotated[np.ndarray, "int64 64"]  # Number of obstacles in each list
    listed: Annotated[np.ndarray, "int32 64 most"]  # The obstacles
    near: Annotated[np.ndarray, "most"]  # Distances of obstacles from the block [m]
    kept: Annotated[np.ndarray, "int32 most"]  # Obstacles that matter to it


@kernel
def _add_all(bounds, grid, kept, near, n, work):
    """Lower the distances of a block's cells by n obstacles, and list these."""
    work.best[:], work.upper[:], work.counts[:] = GRID_RANGE_M, GRID_RANGE_M, 0
    farthest = GRID_RANGE_M
    for k in range(n):
        i = kept[k]
        if bounds[i, 1] == 0.0 and bounds[i, 2] == 0.0 and bounds[i, 5] == 0.0:
            _add_straight(bounds, i, grid, near[k] < farthest, work)
        else:
            _add_turned(bounds, i, grid, work)
        if k % 16 == 15:  # only every 16th: it costs as much as adding an obstacle
            farthest = 0.0
            for distances in work.best:
                for distance in distances:
                    farthest = max(farthest, distance)


@entry
def fill_blocks(
    bounds: Annotated[np.ndarray, "count 16"],
    grid: DistanceGrid,
    block_start: Annotated[np.ndarray, "int64 blocks"],
    block_items: Annotated[np.ndarray, "int32 listed"],
    work: Work,
    first: int,
    used: int,
):
    """Fill blocks until `grid.items` is full.

    Args:
        bounds: oriented boxes around all obstacles.
        grid: the grid.
        block_start: (blocks + 1,) index in `block_items` of each block's first obstacle; the last
            entry is the length of `block_items`.
        block_items: rows of the obstacles within GRID_RANGE_M of each block.
        work: work arrays.
        first: block to begin with.
        used: length of the used part of `grid.items`.

    Returns:
        The next block to fill, and the new `used`.
    """
    blocks_y = grid.distance.shape[1] // BLOCK_CELLS
    blocks_z = grid.distance.shape[2] // BLOCK_CELLS
    near, kept, items = work.near, work.kept, grid.items
    for block in range(first, block_start.shape[0] - 1):
        bz, by, bx = block % blocks_z, block // blocks_z % blocks_y, block // (blocks_z * blocks_y)
        work.corner[0] = grid.origin[0] + BLOCK_CELLS * grid.cell * bx
        work.corner[1] = grid.origin[1] + BLOCK_CELLS * grid.cell * by
        work.corner[2] = grid.origin[2] + BLOCK_CELLS * grid.cell * bz
        some = block_items[block_start[block] : block_start[block + 1]]
        n = _relevant(bounds, grid, work.corner, some, near, kept)
        if n == 0:
            continue
        _add_all(bounds, grid, kept, near, n, work)
        _store(grid, bx, by, bz, work.best)
        listed = 0
        # work.counts.sum() would import scipy.linalg wherever this is loaded
        for s in range(BLOCK_LISTS**3):
            listed += work.counts[s]
        if used + listed > items.shape[0]:
            return block, used
        for s in range(BLOCK_LISTS**3):
            count = work.counts[s]
            lx = BLOCK_LISTS * bx + (s >> 4)
            ly = BLOCK_LISTS * by + (s >> 2 & 3)
            lz = BLOCK_LISTS * bz + (s & 3)
            grid.list_start[lx, ly, lz], grid.list_count[lx, ly, lz] = used, count
            for k in range(count):
                items[used + k] = work.listed[s, k]
            used += count
    return block_start.shape[0] - 1, used


def distance_grid(bounds: np.ndarray, half: float, cell: float) -> DistanceGrid:
    """Grid over a cube about the world's origin.

    Each cell holds a lower bound of min_i min_{x in cell} d(x, obstacle_i), at most GRID_RANGE_M.
    Obstacles within GRID_REACH_M are listed.

    Args:
        bounds: oriented boxes around all obstacles.
        half: half edge of the cube [m].
        cell: edge of a cell [m].
    """
    edge, origin = BLOCK_CELLS * cell, np.full(3, -half)
    blocks = np.maximum(np.ceil((np.full(3, half) - origin) / edge - 1e-9).astype(np.int64), 1)
    # obstacles within GRID_RANGE_M of each block, in their order: block_items from block_start on
    centre = bounds[:, BOUNDS_CENTRE:BOUNDS_HALF]
    extent = np.tile(GRID_RANGE_M + bounds[:, BOUNDS_INFLATION:], 3)
    for k in range(3):
        extent += np.abs(bounds[:, k:BOUNDS_CENTRE:3]) * bounds[:, BOUNDS_HALF + k, None]
    low = np.clip(np.floor((centre - extent - origin) / edge), 0.0, blocks).astype(np.int64)
    high = np.clip(np.floor((centre + extent - origin) / edge) + 1.0, 0.0, blocks).astype(np.int64)
    counts = (high - low).prod(axis=1)
    item = np.repeat(np.arange(len(bounds)), counts)
    place = np.arange(len(item)) - np.repeat(np.cumsum(counts) - counts, counts)
    _, across_y, across_z = (high - low)[item].T
    turns = place // across_z
    index = low[item].T + (turns // across_y, turns % across_y, place % across_z)
    block_of = np.ravel_multi_index(tuple(index), tuple(blocks))
    # pairs of block and obstacle in one number: sorting numbers is faster than ordering rows
    sorted_pairs = np.sort(block_of * np.int64(len(bounds)) + item)
    block_items = (sorted_pairs % np.int64(max(len(bounds), 1))).astype(np.int32)
    starts = np.append(0, np.cumsum(np.bincount(block_of, minlength=int(blocks.prod()))))
    pairs, most = tuple(BLOCK_CELLS // 2 * blocks), int(np.diff(starts).max())
    grid = DistanceGrid(
        origin,
        float(cell),
        1.0 / float(cell),
        np.full(tuple(BLOCK_CELLS * blocks), 255, dtype=np.uint8),
        np.zeros(pairs, dtype=np.int64),
        np.zeros(pairs, dtype=np.int32),
        np.empty(1024, dtype=np.int32),  # grows below
    )
    block, used = 0, 0
    work = Work(
        corner=np.empty(3),
        gaps=np.empty((3, BLOCK_CELLS)),
        yz=np.empty(BLOCK_CELLS**2),
        best=np.empty((BLOCK_CELLS, BLOCK_CELLS**2)),
        upper=np.empty(BLOCK_LISTS**3),
        counts=np.empty(BLOCK_LISTS**3, dtype=np.int64),
        listed=np.empty((BLOCK_LISTS**3, most), dtype=np.int32),
        near=np.empty(most),
        kept=np.empty(most, dtype=np.int32),
    )
    while block < len(starts) - 1:
        block, used = fill_blocks(bounds, grid, starts, block_items, work, block, used)
        if block < len(starts) - 1:
            more = np.empty(max(len(grid.items), work.listed.size), dtype=np.int32)
            grid = grid._replace(items=np.concatenate([grid.items, more]))
    return grid._replace(items=grid.items[:used].copy())


@kernel(inline="machine")
def cell_of(grid, x, y, z):
    """Cell (3 ints) of a point and whether the point lies in the grid (else cell 0).

    Args:
        grid: a `DistanceGrid`.
        x: of the point [m].
        y: of the point [m].
        z: of the point [m].
    """
    scale = grid.cells_per_metre
    fx, fy, fz = (
        (x - grid.origin[0]) * scale,
        (y - grid.origin[1]) * scale,
        (z - grid.origin[2]) * scale,
    )
    nx, ny, nz = grid.distance.shape
    if 0.0 <= fx < nx and 0.0 <= fy < ny and 0.0 <= fz < nz:
        return int(fx), int(fy), int(fz), True
    return 0, 0, 0, False


@kernel(inline="machine")
def known_distance(grid, ix, iy, iz):
    """Lower bound on the distance from a cell to the nearest obstacle [m].

    Args:
        grid: a `DistanceGrid`.
        ix: index of the cell along x.
        iy: index along y.
        iz: index along z.
    """
    return grid.distance[ix, iy, iz] * GRID_STEP_M
