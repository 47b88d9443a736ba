"""Bounding volumes: a tree of balls around each body of a robot, boxes around points of a cloud.

A hull is cut in two across its longest axis until the ball around each piece is small. The pieces
together are the hull: a check of all pieces whose balls may touch something is a check of the hull.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.convex import convex_hull, halves
from cvqmpt_lab.base.jit import entry

PIECE_RADIUS_M = 0.095  # of the largest ball around a piece: smaller than GRID_REACH_M
# added to the radius of every ball: exceeds rounding and the errors of `convex_hull` on flat sets
BALL_SLACK_M = 1e-8


class Piece(NamedTuple):
    """One leaf of a sphere tree."""

    points: np.ndarray  # (k, 3), whose inflated hull contains the piece [m]
    inflation: float  # [m]
    number: int  # that the caller gives it


class SphereTrees(NamedTuple):
    """Trees of balls, one after the other, in preorder.

    A ball that is free frees all balls before its `skip`.
    """

    sphere: np.ndarray  # (k, 4) centre and radius [m]
    skip: np.ndarray  # (k,) int64 next node outside the subtree
    leaf: np.ndarray  # (k,) int64 number of the piece inside the ball, -1 for inner nodes
    start: np.ndarray  # (trees + 1,) int64 first node of each tree, and the number of nodes


@entry
def shrink_sphere(
    points: Annotated[np.ndarray, "k 3"],
    rounds: int,
    centre: Annotated[np.ndarray, "3"],
    best: Annotated[np.ndarray, "3"],
):
    """Write the centre of a small ball around points into best; return its radius [m].

    c <- c + (p - c) / (i + 1) with p the point farthest from c, i = 1, 2, ... (Badoiu and Clarkson,
    "Smaller core-sets for balls", 2003).

    Args:
        points: (k, 3) [m].
        rounds: largest i.
        centre: work array (3,).
        best: centre of the ball (3,) [m]; written.
    """
    smallest = np.inf
    for a in range(3):
        centre[a] = 0.5 * (points[0, a] + points[points.shape[0] - 1, a])
    for i in range(1, rounds + 1):
        far, most = 0, -1.0
        for k in range(points.shape[0]):
            distance2 = 0.0
            for a in range(3):
                distance2 += (points[k, a] - centre[a]) ** 2
            if distance2 > most:
                far, most = k, distance2
        for a in range(3):
            if most < smallest:
                best[a] = centre[a]
            centre[a] += (points[far, a] - centre[a]) / (i + 1)
        smallest = min(smallest, most)
    return np.sqrt(smallest) + BALL_SLACK_M


def enclosing_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of a nearly smallest ball around points (k, 3) [m]."""
    centre = np.empty(3)
    radius = shrink_sphere(np.ascontiguousarray(points), 200, np.empty(3), centre)
    return centre, radius


def cut_into_pieces(points: np.ndarray, small: float = 0.08, few: int = 8) -> list[np.ndarray]:
    """Cut the hull of points (n, 3) [m] into convex pieces that fill it.

    Args:
        points: (n, 3) [m].
        small: radius of a ball around a piece that is not cut further [m].
        few: from this many pieces on, only pieces with balls above PIECE_RADIUS_M are cut.

    Returns:
        Corners (k, 3) of each piece [m].
    """
    pieces = [convex_hull(points)]
    radii = [enclosing_sphere(pieces[0].corners)[1]]
    while max(radii) > (small if len(pieces) < few else PIECE_RADIUS_M):
        widest = int(np.argmax(radii))
        radii.pop(widest)
        for half in halves(pieces.pop(widest)):
            pieces.append(half)
            radii.append(enclosing_sphere(half.corners)[1])
    return [piece.corners for piece in pieces]


def sphere_trees(groups: Sequence[Sequence[Piece]]) -> SphereTrees:
    """Make a tree of balls over each group; a ball contains the inflated pieces below it."""
    spheres, skips, leaves = [np.empty((0, 4))], list[int](), list[int]()

    def visit(group: Sequence[Piece]) -> None:
        node = len(skips)
        centre, _ = enclosing_sphere(np.concatenate([piece.points for piece in group]))
        radius = max(np.linalg.norm(p.points - centre, axis=1).max() + p.inflation for p in group)
        spheres.append(np.append(centre, radius + BALL_SLACK_M)[None])
        leaves.append(group[0].number if len(group) == 1 else -1)
        skips.append(0)
        if len(group) > 1:
            middles = np.array([piece.points.mean(axis=0) for piece in group])
            axis = int(np.argmax(np.ptp(middles, axis=0)))
            order = np.argsort(middles[:, axis], kind="stable")
            visit([group[i] for i in order[: len(group) // 2]])
            visit([group[i] for i in order[len(group) // 2 :]])
        skips[node] = len(skips)

    starts = [0]
    for group in groups:
        visit(group)
        starts.append(len(skips))
    skip, leaf, start = (np.array(rows, dtype=np.int64) for rows in (skips, leaves, starts))
    return SphereTrees(np.concatenate(spheres), skip, leaf, start)


class Cloud(NamedTuple):
    """Boxes along the axes of one frame, inflated by a radius; points are boxes of size zero."""

    centre: np.ndarray  # (k, 3) [m]
    half: np.ndarray  # (k, 3) half edges [m]
    radius: float  # inflation of every box [m]
    T_world_cloud: np.ndarray  # (4, 4), pose of their frame [m]


class Clusters(NamedTuple):
    """Boxes around neighbouring primitives, along the axes of their cloud's frame."""

    bounds: np.ndarray  # (n, 16) as in `distance_grid`, inflated like the primitives
    listed: np.ndarray  # (n,) int64 numbers of rows of `primitives`; 0 for a single primitive
    # (k, 6) centres, from the cluster's in the cloud's axes, and half edges [m]
    primitives: np.ndarray


def cluster_primitives(cloud: Cloud, voxel: float, most: int = 16, fine: int = 8) -> Clusters:
    """Boxes around those primitives of a cloud whose centres lie in the same voxel.

    Args:
        cloud: the primitives.
        voxel: edge of a voxel [m].
        most: largest number of primitives in a box.
        fine: steps along the edge of a voxel of the curve by which primitives are sorted.
    """
    key = _curve_position(cloud.centre, voxel / fine)
    order = np.argsort(key)
    centre, half, cell = cloud.centre[order], cloud.half[order], key[order] // fine**3
    first_of_cell = np.append(True, cell[1:] != cell[:-1])
    place = np.arange(len(cell)) - np.flatnonzero(first_of_cell)[np.cumsum(first_of_cell) - 1]
    start = np.flatnonzero(place % most == 0)
    low, high = np.minimum.reduceat(centre - half, start), np.maximum.reduceat(centre + half, start)
    middle, count = 0.5 * (low + high), np.diff(start, append=len(cell))
    listed = np.repeat(count > 1, count)
    primitives = np.concatenate([centre - np.repeat(middle, count, axis=0), half], axis=1)[listed]
    T, bounds = cloud.T_world_cloud, np.empty((len(start), 16))
    bounds[:, :9] = T[:3, :3].ravel()
    bounds[:, 9:12] = middle @ T[:3, :3].T + T[:3, 3]
    bounds[:, 12:15] = 0.5 * (high - low) + 1e-12
    bounds[:, 15] = cloud.radius
    return Clusters(bounds, np.where(count > 1, count, 0), primitives)


def _curve_position(points: np.ndarray, step: float, bits: int = 21) -> np.ndarray:
    """Positions (k,) int64 of points (k, 3) on a Morton curve with cells of edge step [m]."""
    extent = float(np.ptp(points, axis=0).max())
    step = max(step, extent / ((1 << bits) - 1))
    index = ((points - points.min(axis=0)) / step).astype(np.int64)
    # move bit k of each coordinate to bit 3 k: shifts, and masks that open gaps of two bits
    for shift, mask in (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        index = (index | index << shift) & mask
    return index[:, 0] | index[:, 1] << 1 | index[:, 2] << 2
