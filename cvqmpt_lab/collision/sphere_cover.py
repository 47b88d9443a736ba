"""Covering convex shapes by spheres: a tree of balls per rigid body, whose leaves are small convex
pieces.

A hull is cut in two across its longest axis until the ball around each piece is small. The union of
the pieces is the
hull: checking the pieces whose balls may touch something checks the hull. Runs once a robot.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.jit import entry

LARGEST_RADIUS = 0.08  # [m] pieces are cut until their ball is this small
MOST_PIECES = 8  # per shape; more only while a ball is larger than ANY_RADIUS
ANY_RADIUS = 0.095  # [m] below the reach of the distance grid's lists
ROUNDS = 200  # steps towards the smallest ball around points
FLAT = 1e-9  # [m] thinner point sets are treated as flat
SLACK = 1e-8  # [m] added to every ball: more than FLAT and the rounding of its vertices


class Piece(NamedTuple):
    """One leaf of a sphere tree."""

    points: np.ndarray  # (k, 3), whose hull, inflated, holds the piece [m]
    inflation: float  # [m]
    number: int  # The caller's number for it


class SphereTree(NamedTuple):
    """Balls in preorder: one that is cleared clears all nodes up to its `skip`."""

    sphere: np.ndarray  # (k, 4) centre and radius [m]
    skip: np.ndarray  # (k,) int64 next node outside the subtree
    leaf: np.ndarray  # (k,) int64 number of the piece inside the ball, -1 for inner nodes


@entry
def shrink_sphere(
    points: Annotated[np.ndarray, "k 3"],
    rounds: int,
    centre: Annotated[np.ndarray, "3"],
    best: Annotated[np.ndarray, "3"],
):
    """Write the centre of what `enclosing_sphere` returns into best, return its radius; centre:
    work array.
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
    return np.sqrt(smallest) + SLACK


def enclosing_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of a nearly smallest ball around points (k, 3) [m].

    Badoiu and Clarkson, "Smaller core-sets for balls", 2003: ever shorter steps towards the
    farthest point.
    """
    centre = np.empty(3)
    radius = shrink_sphere(np.ascontiguousarray(points), ROUNDS, np.empty(3), centre)
    return centre, radius


class Hull(NamedTuple):
    """A convex hull."""

    corners: np.ndarray  # (k, 3) [m]
    edges: np.ndarray  # (e, 2) pairs of corners that include all its edges


def convex_hull(points: np.ndarray) -> Hull:
    """Return the hull of points (n, 3) [m]; flat and straight sets of points have one too."""
    from scipy.spatial import ConvexHull, QhullError  # 0.3 s to import, needed once a robot

    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    along = along[:, np.ptp(along, axis=0) > FLAT]
    if along.shape[1] == 0:
        return Hull(points[:1], np.empty((0, 2), dtype=np.int64))
    if along.shape[1] == 1:
        return Hull(points[[np.argmin(along), np.argmax(along)]], np.array([[0, 1]]))
    try:
        hull = ConvexHull(along)
    except QhullError:  # too thin for Qhull: every point may be a corner, every pair an edge
        return Hull(points, np.argwhere(np.triu(np.ones((len(points), len(points))), 1)))
    row = np.zeros(len(points), dtype=np.int64)
    row[hull.vertices] = np.arange(len(hull.vertices))
    sides = [[0, 1]] if along.shape[1] == 2 else [[0, 1], [1, 2], [2, 0]]
    return Hull(points[hull.vertices], row[hull.simplices[:, sides].reshape(-1, 2)])


def cut_into_pieces(points: np.ndarray) -> list[np.ndarray]:
    """Convex pieces (points (k, 3) each) whose union is the hull of points (n, 3)."""
    pieces = [convex_hull(points)]
    radii = [enclosing_sphere(pieces[0].corners)[1]]
    while max(radii) > (LARGEST_RADIUS if len(pieces) < MOST_PIECES else ANY_RADIUS):
        widest = int(np.argmax(radii))
        radii.pop(widest)
        for half in _halves(pieces.pop(widest)):
            pieces.append(half)
            radii.append(enclosing_sphere(half.corners)[1])
    return [piece.corners for piece in pieces]


def _halves(hull: Hull) -> tuple[Hull, Hull]:
    """Cut a hull in the middle of its longest principal axis."""
    points = hull.corners
    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    height = along[:, np.argmax(np.ptp(along, axis=0))]
    height = height - 0.5 * (height.min() + height.max())
    a, b = hull.edges.T
    crossing = (height[a] < 0.0) != (height[b] < 0.0)
    a, b = a[crossing], b[crossing]
    fraction = (height[a] / (height[a] - height[b]))[:, None]
    cut = points[a] + fraction * (points[b] - points[a])
    below, above = points[height < 0.0], points[height >= 0.0]
    return convex_hull(np.concatenate([below, cut])), convex_hull(np.concatenate([above, cut]))


def sphere_tree(pieces: Sequence[Piece]) -> SphereTree:
    """Return a tree of balls over pieces; every ball contains the inflated pieces below it."""
    spheres: list[np.ndarray] = []
    skips: list[int] = []
    leaves: list[int] = []

    def visit(group: Sequence[Piece]) -> None:
        node = len(spheres)
        centre, _ = enclosing_sphere(np.concatenate([piece.points for piece in group]))
        radius = max(np.linalg.norm(p.points - centre, axis=1).max() + p.inflation for p in group)
        spheres.append(np.append(centre, radius + SLACK))
        leaves.append(group[0].number if len(group) == 1 else -1)
        skips.append(0)
        if len(group) > 1:
            middles = np.array([piece.points.mean(axis=0) for piece in group])
            axis = int(np.argmax(np.ptp(middles, axis=0)))
            order = np.argsort(middles[:, axis], kind="stable")
            visit([group[i] for i in order[: len(group) // 2]])
            visit([group[i] for i in order[len(group) // 2 :]])
        skips[node] = len(spheres)

    visit(pieces)
    return SphereTree(
        np.array(spheres), np.array(skips, dtype=np.int64), np.array(leaves, dtype=np.int64)
    )
