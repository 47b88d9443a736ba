"""Convex pieces that together contain a mesh, and how far a mesh's hull extends beyond it.

The mesh is cut by planes normal to the axes. A piece is the convex hull of the surface in a box
between cuts and of those corners of the box that are inside the mesh. Therefore the union of the
pieces contains the mesh for any choice of cuts; the excess of a piece is the volume of its hull
that is not solid. The piece with the largest excess is cut next, where the hulls of its halves are
small and the cut goes through empty space. The solid volume is measured on a grid.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import ConvexHull, HalfspaceIntersection

from cvqmpt_lab.base.convex import (
    MIN_THICKNESS_M,
    box_corners,
    few_vertices_around,
    hull_volume,
    planes_around,
    principal_axes,
    require_volume,
    thickness,
)
from cvqmpt_lab.base.values import FloatArray

MAX_MESH_PIECES = 48


class FilledCells:
    """Cells of a grid that a mesh fills; the centres of the outermost cells are on its bounds.

    Args:
        triangles: (f, 3, 3) [m].
        closed: whether the triangles enclose a volume.
        across: number of cells along the longest side of the mesh.
        per_cell: mean number of surface samples in a cell of the surface.
    """

    def __init__(
        self, triangles: FloatArray, closed: bool, across: int = 56, per_cell: int = 20
    ) -> None:
        points = triangles.reshape(-1, 3)
        self._low, extent = points.min(axis=0), np.ptp(points, axis=0)
        self._cell = float(extent.max()) / across
        cells = np.ceil(extent / self._cell).astype(int) + 1
        area = float(trimesh.triangles.area(triangles).sum())
        surface = np.zeros(cells, dtype=bool)
        samples = spread_points(triangles, int(per_cell * area / self._cell**2) + 1)
        surface[tuple(self._cells_of(samples, cells).T)] = True
        self._closed, self._triangles = closed, triangles
        # least and greatest y and z of each triangle, for `_encloses`
        self._least = np.ascontiguousarray(triangles.min(axis=1).T[1:])
        self._greatest = np.ascontiguousarray(triangles.max(axis=1).T[1:])
        filled = ndimage.binary_fill_holes(surface)
        if closed:
            filled &= ~self._cavities(filled & ~surface)
        self._inside = filled & ~surface
        self._share = filled - 0.5 * surface
        if closed:
            # correct the volume of the cells by the volume of the mesh
            cells_volume = self._share.sum() * self._cell**3
            ratio = np.clip(abs(as_mesh(triangles).volume) / cells_volume, 0.5, 1.5)
            self._share = self._share * float(ratio)

    def _cavities(self, enclosed: np.ndarray, least: int = 30) -> np.ndarray:
        """Return a mask of the enclosed cells that are hollow: rooms with walls all around.

        Args:
            enclosed: mask of the cells that the surface encloses.
            least: smallest number of cells of a cavity; smaller ones count as solid.
        """
        parts, count = ndimage.label(enclosed)
        sizes = np.bincount(parts.ravel(), minlength=count + 1)
        hollow = np.zeros(count + 1, dtype=bool)
        deep = ndimage.distance_transform_edt(enclosed)
        for part in (np.flatnonzero(sizes[1:] >= least) + 1).tolist():
            middle = ndimage.maximum_position(deep, parts, part)
            hollow[part] = not self.contains(self._low + self._cell * np.array([middle]))[0]
        return np.asarray(hollow[parts])

    def gap(self, hull: ConvexHull) -> float:
        """Return the largest distance [m] from a point in a hull to the mesh, to about a cell."""
        empty = self._share == 0.0
        away = self._cell * ndimage.distance_transform_edt(empty)
        cells = np.argwhere(empty)
        # the few planes leave few cells for the many
        for plane in (*planes_around(hull), *hull.equations):
            heights = (self._low + self._cell * cells) @ plane[:3] + plane[3]
            cells = cells[heights <= 0.0]
        return float(away[tuple(cells.T)].max(initial=0.0))

    def volume(self, low: FloatArray, high: FloatArray) -> float:
        """Return the approximate solid volume [m^3] between two corners (3,) [m]."""
        first, last = self._cells_of(np.array([low, high]), self._share.shape)
        # include the outermost cells
        last = np.where(last == np.array(self._share.shape) - 1, last + 1, last)
        part = self._share[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
        return float(part.sum()) * self._cell**3

    def voids(
        self, planes: FloatArray, low: FloatArray, high: FloatArray
    ) -> Callable[[int, float], float]:
        """Return a function (axis, coordinate) -> area [m^2] of a hull's cut that is not solid.

        Args:
            planes: (p, 4) planes of the hull: outward normals; offsets [m], < 0 at inner points.
            low: least corner (3,) of the hull's box [m].
            high: greatest corner (3,) of the hull's box [m].
        """
        first, last = self._cells_of(np.array([low, high]), self._share.shape)
        x, y, z = (self._low[k] + self._cell * np.arange(first[k], last[k] + 1) for k in range(3))
        a, b, c, d = planes.T
        beyond = (x[:, None, None] * a + y[:, None] * b) + d  # per column and plane, at z = 0
        up = c > 0.0
        down = c < 0.0
        along = c == 0.0
        top = (beyond[..., up] / -c[up]).min(axis=2, initial=np.inf)
        bottom = (beyond[..., down] / -c[down]).max(axis=2, initial=-np.inf)
        top[(beyond[..., along] >= 0.0).any(axis=2)] = -np.inf
        in_hull = (z > bottom[..., None]) & (z < top[..., None])
        part = tuple(slice(i, j + 1) for i, j in zip(first, last, strict=True))
        void = in_hull & (self._share[part] == 0.0)
        areas = [self._cell**2 * void.sum(axis=tuple({0, 1, 2} - {axis})) for axis in range(3)]

        def area(axis: int, at: float) -> float:
            cell = round((at - self._low[axis]) / self._cell) - int(first[axis])
            return float(areas[axis][min(max(cell, 0), len(areas[axis]) - 1)])

        return area

    def contains(self, points: FloatArray) -> np.ndarray:
        """Return a mask of points (k, 3) inside a closed mesh, or well inside an open one."""
        if self._closed:
            # rays must not meet corners and edges of faces
            aside = 1e-8 * np.array([0.0, 0.618, 0.414]) * self._cell
            return np.array([self._encloses(point + aside) for point in points])
        return self._inside[tuple(self._cells_of(points, self._inside.shape).T)]

    def _encloses(self, point: FloatArray) -> bool:
        """Return whether the mesh encloses a point (3,), by its winding number from a ray along x.

        The point is inside if the numbers of crossed faces whose normals are along and against the
        ray differ. It is taken as inside, too, if they differ along the whole line: the line has
        then met an edge.
        """
        y, z = point[1:]
        near = (self._least[0] < y) & (self._greatest[0] > y)
        near &= (self._least[1] < z) & (self._greatest[1] > z)
        a, b, c = np.moveaxis(self._triangles[near] - point, 1, 0)
        turns = np.stack(
            [u[:, 1] * v[:, 2] - u[:, 2] * v[:, 1] for u, v in ((b, c), (c, a), (a, b))]
        )
        # sign of each crossed face's normal along the ray; 0: not crossed
        sign = (turns > 0.0).all(axis=0).astype(int) - (turns < 0.0).all(axis=0)
        ahead = sign * (turns[0] * a[:, 0] + turns[1] * b[:, 0] + turns[2] * c[:, 0]) > 0.0
        return bool(sign[ahead].sum() != 0 or sign.sum() != 0)

    def _cells_of(self, points: FloatArray, shape: np.ndarray | tuple[int, ...]) -> np.ndarray:
        """Return the indices (k, 3) of the cells that contain points (k, 3)."""
        cells = np.round((points - self._low) / self._cell).astype(int)
        return np.clip(cells, 0, np.array(shape) - 1)


@dataclass(frozen=True, eq=False)
class Piece:
    """The part of a mesh in a box between cuts."""

    triangles: FloatArray  # (f, 3, 3) [m]
    low: FloatArray  # (3,) least corner of the box [m]
    high: FloatArray  # (3,) greatest corner of the box [m]
    solid: FilledCells  # the whole mesh

    @cached_property
    def hull(self) -> ConvexHull:
        """Hull [m] of the surface and the solid corners of the box, at least `MIN_THICKNESS_M`."""
        corners = box_corners(self.low, self.high)
        inside = corners[self.solid.contains(corners)]
        points = np.concatenate([self.triangles.reshape(-1, 3), inside])
        if len(points) < 4 or thickness(points) < 2.0 * MIN_THICKNESS_M:
            points = thickened(points)
        # the second hull has no points but vertices
        return ConvexHull(points[ConvexHull(points).vertices])

    @cached_property
    def excess(self) -> float:
        """Volume of the hull that is not solid [m^3]."""
        return max(0.0, self.hull.volume - self.solid.volume(self.low, self.high))

    def halves(self, through_void: float = 0.05) -> "list[Piece]":
        """Return the two parts of the best cut, or the piece if every cut leaves one side empty.

        The best cut at x of an axis minimises

            (V_below + V_above - through_void A l) / V,

        where V are the volumes of the hulls of both sides and of the piece, A is the area of the
        cut that is not solid, and l is the length of the piece along the axis.
        """
        # cuts are compared on the largest triangles and a sample of the others
        count = 600 if len(self.triangles) <= 600 else 120
        order = np.argsort(-trimesh.triangles.area(self.triangles))
        rest = order[count // 2 :]
        sketched = np.r_[order[: count // 2], rest[:: max(1, 2 * len(rest) // count)]]
        sketch = self.triangles[sketched]
        whole = max(self.hull.volume, 1e-30)
        area = self.solid.voids(planes_around(self.hull), self.low, self.high)
        best, axis, at = np.inf, 0, 0.0
        for axis_now, at_now in self._cuts():
            sides = _sides(sketch, axis_now, at_now)
            void = area(axis_now, at_now) * (self.high - self.low)[axis_now]
            cost = (sum(map(hull_volume, sides)) - through_void * void) / whole
            if min(map(len, sides)) > 0 and cost < best:
                best, axis, at = cost, axis_now, at_now
        if not np.isfinite(best):
            return [self]
        low, high = self.low.copy(), self.high.copy()
        low[axis] = high[axis] = at
        parts = [
            Piece(_clipped(self.triangles, axis, at, -1.0), self.low, high, self.solid),
            Piece(_clipped(self.triangles, axis, at, 1.0), low, self.high, self.solid),
        ]
        return parts if all(len(part.triangles) for part in parts) else [self]

    def _cuts(
        self,
        even: int = 3,
        faces: int = 4,
        least: float = 0.01,
        across: float = 0.99,
        nudge: float = 1e-4,
    ) -> Iterator[tuple[int, float]]:
        """Yield candidate cuts (axis, coordinate): evenly spaced ones, and on both sides of faces.

        Args:
            even: number of evenly spaced cuts along each axis.
            faces: number of the largest faces normal to an axis that get a cut on each side.
            least: smallest share of such a face in the surface of the piece.
            across: smallest cosine between the axis and the normal of such a face.
            nudge: distance of a cut from its face, as a share of the piece's length.
        """
        points = self.triangles.reshape(-1, 3)
        low, length = points.min(axis=0), np.ptp(points, axis=0)
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        twice = np.cross(b - a, c - a)
        area = np.linalg.norm(twice, axis=1)
        for axis in np.flatnonzero(length > 4.0 * nudge * length.max()):
            turned = np.abs(twice[:, axis]) > across * area
            at, which = np.unique(np.round(self.triangles[turned, 0, axis], 6), return_inverse=True)
            size = np.bincount(which, area[turned], len(at))
            large = [k for k in np.argsort(-size)[:faces] if size[k] > least * area.sum()]
            beside = [at[k] + side * nudge * length[axis] for k in large for side in (-1.0, 1.0)]
            evenly = low[axis] + length[axis] * np.arange(1, even + 1) / (even + 1)
            for cut in (*beside, *evenly):
                if self.low[axis] < cut < self.high[axis]:
                    yield int(axis), float(cut)


def convex_pieces(
    triangles: FloatArray, enough: float = 0.02, most_pieces: int = MAX_MESH_PIECES
) -> tuple[FloatArray, ...]:
    """Cut a mesh into convex pieces.

    Args:
        triangles: (f, 3, 3) [m], f >= 1, finite; of a closed or open mesh, in any orientation.
            Triangles without area are left out.
        enough: cutting ends when the excess of all pieces is below this share of the mesh's hull.
        most_pieces: largest number of pieces.

    Returns:
        Vertices (k, 3) [m] of up to `most_pieces` pieces. Their hulls together contain every
        triangle and the inside of a closed mesh.

    Raises:
        InvalidInputError: the mesh as a whole has no volume.
    """
    whole = _whole(triangles)
    most = enough * whole.hull.volume
    parts = [whole]
    final = list[Piece]()  # pieces that cannot be cut
    while parts and len(parts) + len(final) < most_pieces:
        if sum(part.excess for part in parts) <= most:
            break
        worst = max(parts, key=lambda part: part.excess)
        parts.remove(worst)
        halves = worst.halves()
        if len(halves) > 1:
            parts += halves
        else:
            final += halves
    return tuple(few_vertices_around(part.hull) for part in (*parts, *final))


def hull_gap(triangles: FloatArray) -> float:
    """Return how far the hull of a mesh extends beyond it: the largest distance [m] of its points.

    It is measured on a grid of 56 cells along the mesh, and accurate to about a cell. The arguments
    and errors are those of `convex_pieces`.
    """
    whole = _whole(triangles)
    return whole.solid.gap(whole.hull)


def polytope_around(points: FloatArray, most_planes: int) -> tuple[FloatArray, float]:
    """Return corners (k, 3) of a polytope around points (n, 3), and how far it extends beyond [m].

    It has at most `most_planes` of the planes of the points' hull, moved outwards for rounding. The
    number is the largest distance of its corners from that hull.
    """
    hull = ConvexHull(points)
    planes = planes_around(hull, most_vertices=0, most_planes=most_planes)
    middle = hull.points[hull.vertices].mean(axis=0)
    corners = HalfspaceIntersection(planes, middle).intersections
    corners = corners[ConvexHull(corners).vertices]
    triangles = hull.points[hull.simplices]
    beyond = 0.0
    for corner in corners:
        nearest = trimesh.triangles.closest_point(triangles, np.tile(corner, (len(triangles), 1)))
        beyond = max(beyond, float(np.linalg.norm(nearest - corner, axis=1).min()))
    return corners, beyond


def _whole(triangles: FloatArray) -> Piece:
    """Return a mesh as one piece; arguments and errors are those of `convex_pieces`."""
    edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    without_points = triangles[edges.min(axis=1) > 0.0]  # flat triangles can close a mesh
    flat = 1e-12 * edges.max(axis=1) ** 2
    triangles = triangles[trimesh.triangles.area(triangles) > flat]
    points = triangles.reshape(-1, 3)
    require_volume(points, "the mesh", MIN_THICKNESS_M)
    closed = as_mesh(triangles).is_watertight or as_mesh(without_points).is_watertight
    return Piece(triangles, points.min(axis=0), points.max(axis=0), FilledCells(triangles, closed))


def as_mesh(triangles: FloatArray) -> trimesh.Trimesh:
    """Return triangles (f, 3, 3) as a mesh in which equal corners are one vertex."""
    return trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))


def _clipped(triangles: FloatArray, axis: int, at: float, sign: float) -> FloatArray:
    """Return triangles (g, 3, 3) of the part on one side of a plane normal to an axis."""
    normal, origin = np.zeros(3), np.zeros(3)
    normal[axis], origin[axis] = sign, at
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    corners = triangles.reshape(-1, 3)
    vertices, faces, *_ = trimesh.intersections.slice_faces_plane(corners, faces, normal, origin)
    return np.asarray(vertices)[np.asarray(faces, dtype=int)].reshape(-1, 3, 3)


def _sides(triangles: FloatArray, axis: int, at: float) -> tuple[FloatArray, FloatArray]:
    """Return points (k, 3) of both sides of triangles (f, 3, 3), which have the sides' hulls."""
    ends = np.roll(triangles, -1, axis=1)
    before, after = triangles[..., axis] - at, ends[..., axis] - at
    crossed = (before < 0.0) != (after < 0.0)
    share = before[crossed] / (before[crossed] - after[crossed])
    between = triangles[crossed] + share[:, None] * (ends - triangles)[crossed]
    low = triangles[before < 0.0], between
    return np.concatenate(low), np.concatenate([triangles[before >= 0.0], between])


def spread_points(triangles: FloatArray, count: int, most: int = 400_000) -> FloatArray:
    """Return `count` points, at most `most`, spread over triangles (f, 3, 3) evenly by area."""
    count = min(count, most)
    a, b, c = np.moveaxis(triangles, 1, 0)
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    k = np.arange(count)
    which = np.searchsorted(area, (k + 0.5) / count * area[-1]).clip(max=len(area) - 1)
    # a low-discrepancy sequence in the unit square
    u, v = (k * 0.7548776662466927) % 1.0, (k * 0.5698402909980532) % 1.0
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    return a[which] + u[:, None] * (b - a)[which] + v[:, None] * (c - a)[which]


def thickened(points: FloatArray) -> FloatArray:
    """Return points (2 k, 3) whose hull contains any given points and is thick enough."""
    turned = principal_axes(points).T
    low, high = (points @ turned.T).min(axis=0), (points @ turned.T).max(axis=0)
    gap = np.maximum(0.0, 2.0 * MIN_THICKNESS_M - (high - low)) / 2.0
    if (gap[1:] > 0.0).any():
        # the points are on a line or equal: a box around them
        low, high = low - gap, high + gap
        return box_corners(low, high) @ turned
    return np.concatenate([points - gap[0] * turned[0], points + gap[0] * turned[0]])
