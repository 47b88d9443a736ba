"""Hulls of few vertices, and points spread over triangles."""

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.scene.extent import MIN_THICKNESS, thickness, thin_direction

MOST_VERTICES = 120  # of a hull
MOST_SAMPLES = 400_000
PLANES = 62  # of a hull that would have more vertices
SLACK = 1e-9  # [m] that such a hull is larger, for rounding


def hull_of(points: FloatArray) -> FloatArray:
    """Vertices (k, 3) of the hull of points (n, 3), n >= 1, made `MIN_THICKNESS` thick where it is thinner [m]."""
    if len(points) < 4 or thickness(points) < 2.0 * MIN_THICKNESS:
        points = _thickened(points)
    return points[ConvexHull(points).vertices]


def of_few_vertices(vertices: FloatArray) -> FloatArray:
    """A hull of at most `MOST_VERTICES` that holds a hull of vertices (n, 3) [m].

    The same where that has no more. Else faces are left out, and those that stay are drawn to where they meet.
    """
    return vertices if len(vertices) <= MOST_VERTICES else _with_fewer_faces(vertices)


def spread_points(triangles: FloatArray, count: int) -> FloatArray:
    """Up to `MOST_SAMPLES` points (count, 3), spread over triangles (f, 3, 3) as evenly as their areas."""
    count = min(count, MOST_SAMPLES)
    a, b, c = np.moveaxis(triangles, 1, 0)
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    k = np.arange(count)
    which = np.searchsorted(area, (k + 0.5) / count * area[-1]).clip(max=len(area) - 1)
    u, v = (
        (k * 0.7548776662466927) % 1.0,
        (k * 0.5698402909980532) % 1.0,
    )  # an evenly spread sequence in the square
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    return a[which] + u[:, None] * (b - a)[which] + v[:, None] * (c - a)[which]


def _thickened(points: FloatArray) -> FloatArray:
    """Points (2 k, 3) whose hull holds the points and is thick enough, whatever they are."""
    normal = thin_direction(points)
    turned = np.linalg.svd(normal[None])[2]  # rows: the normal, and two directions across it
    low, high = (points @ turned.T).min(axis=0), (points @ turned.T).max(axis=0)
    room = np.maximum(0.0, 2.0 * MIN_THICKNESS - (high - low)) / 2.0
    if (room[1:] > 0.0).any():  # no more than a line: a box around it
        low, high = low - room, high + room
        box = np.array(
            [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        )
        return box @ turned
    return np.concatenate([points - room[0] * normal, points + room[0] * normal])


def _with_fewer_faces(vertices: FloatArray) -> FloatArray:
    """Vertices of a polytope of `PLANES` faces that holds the hull of vertices (n, 3)."""
    normals = ConvexHull(vertices).equations[:, :3]
    chosen = [*np.eye(3), *-np.eye(3)]
    nearest = np.max(normals @ np.array(chosen).T, axis=1)
    while len(chosen) < PLANES:  # the normal farthest from those chosen
        chosen.append(normals[np.argmin(nearest)])
        nearest = np.maximum(nearest, normals @ chosen[-1])
    planes = np.unique(np.array(chosen), axis=0)
    reach = (vertices @ planes.T).max(axis=0) + SLACK
    corners = HalfspaceIntersection(np.c_[planes, -reach], vertices.mean(axis=0)).intersections
    return corners[ConvexHull(corners).vertices]
