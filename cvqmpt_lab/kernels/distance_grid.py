"""A grid of distances to the nearest obstacle: one look-up clears a sphere, whatever the obstacle count.

Space is cut into blocks of BLOCK^3 cells. Each block lists the obstacles within RANGE of it; each cell
stores the distance of its centre to the nearest of them, at most RANGE. The distance of any other point
of the cell is at least that minus the way to the centre.
"""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.kernels.compiling import driver, inlined

BLOCK = 4  # cells along the edge of a block
RANGE = 0.20  # [m] distances are cut off here
MARGIN_FLOAT32 = 1e-6  # [m] more than float32 rounding of distances up to RANGE


class Obstacles(NamedTuple):
    """Bounds of n obstacles: oriented boxes swelled by a radius, exact for boxes and spheres.

    Attributes
    ----------
    rotation (n, 3, 3), translation (n, 3): pose in the world. half: (n, 3) half edges [m].
    radius: (n,) swelling [m]. lower, upper: (n, 3) axis-aligned bounds [m].
    """

    rotation: np.ndarray
    translation: np.ndarray
    half: np.ndarray
    radius: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class DistanceGrid(NamedTuple):
    """See the module's docstring.

    Attributes
    ----------
    origin: (3,) corner of the grid [m]. cell: (1,) edge of a cell [m].
    distance: (nx, ny, nz) float32. block_start: (bx * by * bz + 1,) int64. block_items: obstacle indices.
    """

    origin: np.ndarray
    cell: np.ndarray
    distance: np.ndarray
    block_start: np.ndarray
    block_items: np.ndarray


@inlined
def point_distance(obstacles, i, x, y, z):
    """Distance of a point to obstacle i's bounds [m], zero inside."""
    dx = x - obstacles.translation[i, 0]
    dy = y - obstacles.translation[i, 1]
    dz = z - obstacles.translation[i, 2]
    square = 0.0
    for a in range(3):
        along = (
            obstacles.rotation[i, 0, a] * dx
            + obstacles.rotation[i, 1, a] * dy
            + obstacles.rotation[i, 2, a] * dz
        )
        outside = max(abs(along) - obstacles.half[i, a], 0.0)
        square += outside * outside
    return max(np.sqrt(square) - obstacles.radius[i], 0.0)


@inlined
def _block_range(low, high, origin, edge, count):
    """First and one-past-last block along one axis that [low, high] touches."""
    first = int(np.floor((low - origin) / edge))
    last = int(np.floor((high - origin) / edge)) + 1
    return min(max(first, 0), count), min(max(last, 0), count)


@driver
def _assign(obstacles, origin, edge, blocks, items, starts, fill):
    """Count (fill False) or write (fill True) the obstacles within RANGE of each block."""
    half_diagonal = 0.5 * edge * np.sqrt(3.0)
    for i in range(obstacles.radius.shape[0]):
        x0, x1 = _block_range(
            obstacles.lower[i, 0] - RANGE, obstacles.upper[i, 0] + RANGE, origin[0], edge, blocks[0]
        )
        y0, y1 = _block_range(
            obstacles.lower[i, 1] - RANGE, obstacles.upper[i, 1] + RANGE, origin[1], edge, blocks[1]
        )
        z0, z1 = _block_range(
            obstacles.lower[i, 2] - RANGE, obstacles.upper[i, 2] + RANGE, origin[2], edge, blocks[2]
        )
        for bx in range(x0, x1):
            for by in range(y0, y1):
                for bz in range(z0, z1):
                    far = point_distance(
                        obstacles,
                        i,
                        origin[0] + (bx + 0.5) * edge,
                        origin[1] + (by + 0.5) * edge,
                        origin[2] + (bz + 0.5) * edge,
                    )
                    if far - half_diagonal > RANGE:
                        continue
                    block = (bx * blocks[1] + by) * blocks[2] + bz
                    if fill:
                        items[starts[block]] = i
                    starts[block] += 1


@driver
def _fill_distances(obstacles, grid, blocks):
    """Distance of every cell centre to the nearest obstacle of its block."""
    cell = grid.cell[0]
    for bx in range(blocks[0]):
        for by in range(blocks[1]):
            for bz in range(blocks[2]):
                block = (bx * blocks[1] + by) * blocks[2] + bz
                first, last = grid.block_start[block], grid.block_start[block + 1]
                if first == last:
                    continue
                for ix in range(bx * BLOCK, (bx + 1) * BLOCK):
                    for iy in range(by * BLOCK, (by + 1) * BLOCK):
                        for iz in range(bz * BLOCK, (bz + 1) * BLOCK):
                            x = grid.origin[0] + (ix + 0.5) * cell
                            y = grid.origin[1] + (iy + 0.5) * cell
                            z = grid.origin[2] + (iz + 0.5) * cell
                            best = RANGE
                            for k in range(first, last):
                                best = min(best, point_distance(obstacles, grid.block_items[k], x, y, z))
                                if best == 0.0:
                                    break
                            grid.distance[ix, iy, iz] = max(best - MARGIN_FLOAT32, 0.0)


def distance_grid(obstacles: Obstacles, lower: np.ndarray, upper: np.ndarray, cell: float) -> DistanceGrid:
    """Grid over the box lower..upper (3,) [m] with cells of edge `cell` [m]."""
    edge = BLOCK * cell
    blocks = np.maximum(np.ceil((upper - lower) / edge).astype(np.int64), 1)
    counts = np.zeros(int(blocks.prod()), dtype=np.int64)
    origin = np.array(lower, dtype=float)
    _assign(obstacles, origin, edge, blocks, np.empty(0, dtype=np.int32), counts, False)
    starts = np.concatenate([[0], np.cumsum(counts)])
    items = np.empty(starts[-1], dtype=np.int32)
    _assign(obstacles, origin, edge, blocks, items, starts[:-1].copy(), True)
    distance = np.full(tuple(BLOCK * blocks), RANGE, dtype=np.float32)
    grid = DistanceGrid(origin, np.array([float(cell)]), distance, starts, items)
    _fill_distances(obstacles, grid, blocks)
    return grid


@inlined
def clear_of_obstacles(grid, x, y, z, radius):
    """Whether the ball around a point is surely free, and the block the point lies in (-1 outside the grid)."""
    cell = grid.cell[0]
    fx, fy, fz = (x - grid.origin[0]) / cell, (y - grid.origin[1]) / cell, (z - grid.origin[2]) / cell
    nx, ny, nz = grid.distance.shape
    if not (0.0 <= fx < nx and 0.0 <= fy < ny and 0.0 <= fz < nz):
        return False, -1
    ix, iy, iz = int(fx), int(fy), int(fz)
    dx, dy, dz = fx - ix - 0.5, fy - iy - 0.5, fz - iz - 0.5
    known = grid.distance[ix, iy, iz] - cell * np.sqrt(dx * dx + dy * dy + dz * dz)
    if known > radius:
        return True, 0
    return False, ((ix // BLOCK) * (ny // BLOCK) + iy // BLOCK) * (nz // BLOCK) + iz // BLOCK
