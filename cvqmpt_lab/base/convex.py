"""Convex polytopes: vertices around simple solids, convex hulls, planes around them, thickness."""

from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull  # 0.3 s to import: each function imports it when called

MIN_THICKNESS_M = 1e-4  # thinner hulls are refused: rounding errors would decide their faces


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Corners (8, 3) of the box between its least and greatest corner (3,)."""
    return np.array(list(product(*zip(low, high, strict=True))))


def prism_around(radius: float, ends: tuple[float, float], sides: int) -> np.ndarray:
    """Vertices (2 sides, 3) [m] of the prism around a cylinder along z.

    Its edges are radius / cos(pi / sides) from the axis, so that its sides touch the cylinder.

    Args:
        radius: radius of the cylinder [m].
        ends: z of its two ends, in the order of the vertices [m].
        sides: number of sides of the prism.
    """
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = radius / np.cos(np.pi / sides) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.c_[ring, np.full(sides, z)] for z in ends])


def polytope_around_ball(radius: float) -> np.ndarray:
    """Vertices (98, 3) [m] of a polytope around a ball, radius / 0.965 from its centre.

    They are a grid on the faces of a cube, moved to a sphere. The corners of a cube alone would be
    1.73 radii from the centre.
    """
    grid = [p for p in product(range(-2, 3), repeat=3) if max(map(abs, p)) == 2]
    points = np.tan(np.pi / 8 * np.array(grid))
    return radius / 0.965 * points / np.linalg.norm(points, axis=1)[:, None]


def principal_axes(points: np.ndarray) -> np.ndarray:
    """Principal axes of points (n, 3): columns of a (3, 3) matrix, the least variance first."""
    centred = points - points.mean(axis=0)
    return np.linalg.eigh(centred.T @ centred)[1]


def thickness(points: np.ndarray) -> float:
    """Extent [m] of points (n, 3) along their principal axis of least variance."""
    return float(np.ptp(points @ principal_axes(points)[:, 0]))


def require_near(points: np.ndarray, what: str, farthest: float = 1e4) -> None:
    """Refuse points (n, 3) more than `farthest` [m] from the origin of their frame."""
    distance = float(np.abs(points).max(initial=0.0))
    if not distance <= farthest:
        raise InvalidInputError(
            f"{what} has a vertex at {distance:.3g} m, beyond {farthest:g}: give metres"
        )


def require_volume(points: np.ndarray, what: str, thinnest: float = 1e-6) -> None:
    """Refuse points (n, 3) that are too far away, or too thin for Qhull, which ends the process.

    Args:
        points: (n, 3) [m].
        what: noun of the error message.
        thinnest: least thickness [m]; 1e-6 of the length where that is more.
    """
    require_near(points, what)
    extents = np.zeros(3)
    if len(points) > 3:
        extents = np.ptp(points @ principal_axes(points), axis=0)
    least = max(thinnest, 1e-6 * float(extents.max()))
    if not extents.min() >= least:
        raise InvalidInputError(
            f"{what} of {len(points)} points is {extents.min():.2g} m thick, less than "
            f"{least:.2g}: give 4 or more points that are not in one plane, or a box"
        )


class Hull(NamedTuple):
    """A convex hull."""

    corners: np.ndarray  # (k, 3) [m]
    edges: np.ndarray  # (e, 2) pairs of corners that include all its edges


def convex_hull(points: np.ndarray, flat: float = 1e-9) -> Hull:
    """Hull of points (n, 3) [m]; sets thinner than `flat` [m] become planar or straight."""
    from scipy.spatial import ConvexHull, QhullError

    along = _principal_coordinates(points)
    along = along[:, np.ptp(along, axis=0) > flat]
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


def halves(hull: Hull) -> tuple[Hull, Hull]:
    """Cut a hull in the middle of its longest principal axis."""
    points = hull.corners
    along = _principal_coordinates(points)
    height = along[:, np.argmax(np.ptp(along, axis=0))]
    height = height - 0.5 * (height.min() + height.max())
    a, b = hull.edges.T
    crossing = (height[a] < 0.0) != (height[b] < 0.0)
    a, b = a[crossing], b[crossing]
    fraction = (height[a] / (height[a] - height[b]))[:, None]
    cut = points[a] + fraction * (points[b] - points[a])
    below, above = points[height < 0.0], points[height >= 0.0]
    return convex_hull(np.concatenate([below, cut])), convex_hull(np.concatenate([above, cut]))


def _principal_coordinates(points: np.ndarray) -> np.ndarray:
    """Coordinates (n, 3) of points along their principal axes, from their mean.

    By singular values: squares of lengths, as in `principal_axes`, would lose extents below 1e-8.
    """
    centred = points - points.mean(axis=0)
    return centred @ np.linalg.svd(centred, full_matrices=False)[2].T


def hull_volume(points: np.ndarray) -> float:
    """Volume [m^3] of the hull of points (k, 3) [m]; 0 for flat ones."""
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < 4:
        return 0.0
    try:
        return float(ConvexHull(points).volume)
    except QhullError:
        return 0.0


def planes_around(
    hull: "ConvexHull", most_vertices: int = 120, most_planes: int = 62, slack: float = 1e-9
) -> np.ndarray:
    """Planes (p, 4) around a hull: outward normals, and offsets [m].

    Args:
        hull: made by scipy [m].
        most_vertices: a hull with more of them gets fewer planes than it has faces.
        most_planes: number of planes of such a hull; equal ones are left out.
        slack: distance by which these are moved outwards for rounding [m].
    """
    if len(hull.vertices) <= most_vertices:
        return hull.equations
    normals, vertices = hull.equations[:, :3], hull.points[hull.vertices]
    chosen = [*np.eye(3), *-np.eye(3)]
    nearest = np.max(normals @ np.array(chosen).T, axis=1)
    while len(chosen) < most_planes:
        # the normal farthest from those chosen
        chosen.append(normals[np.argmin(nearest)])
        nearest = np.maximum(nearest, normals @ chosen[-1])
    planes = np.unique(np.array(chosen), axis=0)
    reach = (vertices @ planes.T).max(axis=0) + slack
    return np.c_[planes, -reach]


def few_vertices_around(hull: "ConvexHull", most_vertices: int = 120) -> np.ndarray:
    """Vertices (k, 3) [m] of a hull, or of a simpler one around it.

    Hulls with more than `most_vertices` keep only some of their faces, moved outwards until they
    hold all.
    """
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    vertices = hull.points[hull.vertices]
    if len(vertices) <= most_vertices:
        return vertices
    planes = planes_around(hull, most_vertices)
    corners = HalfspaceIntersection(planes, vertices.mean(axis=0)).intersections
    return corners[ConvexHull(corners).vertices]
