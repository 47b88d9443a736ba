"""Covering a convex hull by spheres: cheap to test, and never smaller than what they stand for.

The hull is cut in two across its longest axis, again and again; the ball around the vertices of each
piece contains the piece, so the balls together contain the hull.
"""

import numpy as np
from scipy.spatial import ConvexHull

LARGEST_RADIUS = 0.06  # [m] pieces are cut until their ball is this small
MOST_PIECES = 12  # more only while a ball is larger than ANY_RADIUS
ANY_RADIUS = 0.15  # [m] balls must stay below the distance grid's range


def enclosing_ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius [m] of a nearly smallest ball around points (n, 3) (Badoiu and Clarkson 2003)."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    for i in range(1, 60):
        farthest = points[np.argmax(((points - centre) ** 2).sum(axis=1))]
        centre = centre + (farthest - centre) / (i + 1)
    return centre, float(np.linalg.norm(points - centre, axis=1).max()) * (1.0 + 1e-12)


def cover_by_balls(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (k, 3) and radii (k,) [m] of balls whose union contains the hull of vertices (n, 3)."""
    pieces = [vertices]
    balls = [enclosing_ball(vertices)]
    while True:
        widest = int(np.argmax([radius for _, radius in balls]))
        if balls[widest][1] <= (LARGEST_RADIUS if len(pieces) < MOST_PIECES else ANY_RADIUS):
            break
        halves = _halves(pieces.pop(widest))
        balls.pop(widest)
        pieces.extend(halves)
        balls.extend(enclosing_ball(half) for half in halves)
    return np.array([centre for centre, _ in balls]), np.array([radius for _, radius in balls])


def _halves(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the two parts of a hull, cut across its longest axis."""
    centred = points - points.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    height = centred @ axis
    height = height - 0.5 * (height.min() + height.max())
    hull = ConvexHull(points)
    edges = np.unique(np.sort(hull.simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    a, b = edges[(height[edges[:, 0]] < 0) != (height[edges[:, 1]] < 0)].T
    fraction = (height[a] / (height[a] - height[b]))[:, None]
    cut = points[a] + fraction * (points[b] - points[a])
    corner = hull.vertices
    below, above = points[corner[height[corner] < 0]], points[corner[height[corner] >= 0]]
    return np.concatenate([below, cut]), np.concatenate([above, cut])
