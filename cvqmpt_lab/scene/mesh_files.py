"""Meshes of STL, OBJ and DAE files as convex pieces, which hold the surface and a closed inside.

The mesh is cut by planes across its axes. A piece is the convex hull of what lies between the cuts:
the surface, and those corners between the cuts that are inside. So the union holds the mesh
wherever the cuts are; its excess is the part of the hulls that is not solid. The piece with the
largest excess is cut next, where the hulls of its halves are smallest, through what is not solid.
How much is solid is measured on a grid.
"""

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.robot.urdf import collada_unit
from cvqmpt_lab.scene.cloud_files import check_lengths, parsing, read_by_suffix
from cvqmpt_lab.scene.shapes import MIN_THICKNESS, check_volume, thickness

MOST_TRIANGLES = 200_000  # of a file
MOST_PIECES = 48
MOST_VERTICES = 120  # of a hull


class FilledCells:
    """Cells of a grid that a mesh fills; centres of the outermost cells are its boundary.

    Args:
        triangles: (f, 3, 3) [m].
        closed: whether they enclose a volume.
        across: cells along the mesh's longest side.
        per_cell: samples of the surface in a cell that it crosses.
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
        filled = ndimage.binary_fill_holes(surface)
        self._inside = filled & ~surface
        self._share = filled - 0.5 * surface
        self._closed, self._triangles = closed, triangles
        self._ends = [
            np.ascontiguousarray(end(axis=1).T[1:]) for end in (triangles.min, triangles.max)
        ]
        if closed:
            # correct the cells' volume by the mesh's own
            cells_volume = self._share.sum() * self._cell**3
            ratio = np.clip(abs(as_mesh(triangles).volume) / cells_volume, 0.5, 1.5)
            self._share = self._share * float(ratio)

    def volume(self, low: FloatArray, high: FloatArray) -> float:
        """Solid volume [m^3] between two corners (3,), about."""
        first, last = self._cells_of(np.array([low, high]), self._share.shape)
        # the outermost cells
        last = np.where(last == np.array(self._share.shape) - 1, last + 1, last)
        part = self._share[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
        return float(part.sum()) * self._cell**3

    def voids(
        self, planes: FloatArray, low: FloatArray, high: FloatArray
    ) -> Callable[[int, float], float]:
        """The area [m^2] of a hull that is not solid, a function of an axis and a coordinate.

        planes: (p, 4) of the hull: outward normals, offsets [m], negative if the origin is inside.
        """
        first, last = self._cells_of(np.array([low, high]), self._share.shape)
        x, y, z = (self._low[k] + self._cell * np.arange(first[k], last[k] + 1) for k in range(3))
        a, b, c, d = planes.T
        beyond = (x[:, None, None] * a + y[:, None] * b) + d  # per column and plane, at z = 0
        up, down, along = c > 0.0, c < 0.0, c == 0.0
        top = (beyond[..., up] / -c[up]).min(axis=2, initial=np.inf)
        bottom = (beyond[..., down] / -c[down]).max(axis=2, initial=-np.inf)
        top[(beyond[..., along] >= 0.0).any(axis=2)] = -np.inf
        held = (z > bottom[..., None]) & (z < top[..., None])
        part = tuple(slice(i, j + 1) for i, j in zip(first, last, strict=True))
        void = held & (self._share[part] == 0.0)
        areas = [self._cell**2 * void.sum(axis=tuple({0, 1, 2} - {axis})) for axis in range(3)]

        def area(axis: int, at: float) -> float:
            cell = round((at - self._low[axis]) / self._cell) - int(first[axis])
            return float(areas[axis][min(max(cell, 0), len(areas[axis]) - 1)])

        return area

    def holds(self, points: FloatArray) -> np.ndarray:
        """Mask of points (k, 3) inside, to 1e-9 of the mesh's size; well inside, if it is open."""
        if self._closed:
            # rays pass the corners and edges of faces aside
            aside = 1e-8 * np.array([0.0, 0.618, 0.414]) * self._cell
            return np.array([self._encloses(point + aside) for point in points])
        return self._inside[tuple(self._cells_of(points, self._inside.shape).T)]

    def _encloses(self, point: FloatArray) -> bool:
        """Whether the mesh winds around a point (3,), by a ray along x.

        It does if the numbers of crossed faces that look along and against the ray differ. It also
        counts as inside if they differ along the whole line: then the line has met an edge.
        """
        (y0, z0), (y1, z1) = self._ends
        near = (y0 < point[1]) & (y1 > point[1]) & (z0 < point[2]) & (z1 > point[2])
        a, b, c = np.moveaxis(self._triangles[near] - point, 1, 0)
        turns = np.stack(
            [u[:, 1] * v[:, 2] - u[:, 2] * v[:, 1] for u, v in ((b, c), (c, a), (a, b))]
        )
        looks = (turns > 0.0).all(axis=0).astype(int) - (turns < 0.0).all(axis=0)
        ahead = looks * (turns[0] * a[:, 0] + turns[1] * b[:, 0] + turns[2] * c[:, 0]) > 0.0
        return bool(looks[ahead].sum() != 0 or looks.sum() != 0)

    def _cells_of(self, points: FloatArray, shape: np.ndarray | tuple[int, ...]) -> np.ndarray:
        """Indices (k, 3) of the cells with points (k, 3)."""
        cells = np.round((points - self._low) / self._cell).astype(int)
        return np.clip(cells, 0, np.array(shape) - 1)


@dataclass(frozen=True, eq=False)
class Piece:
    """The part of a mesh between cuts."""

    triangles: FloatArray  # (f, 3, 3) [m]
    low: FloatArray  # (3,), of the space between the cuts [m]
    high: FloatArray  # (3,) [m]
    solid: FilledCells  # the whole mesh

    @cached_property
    def hull(self) -> ConvexHull:
        """Its hull [m], the solid corners of the space included; `MIN_THICKNESS` thick at least."""
        corners = np.array(list(product(*zip(self.low, self.high, strict=True))))
        inside = corners[self.solid.holds(corners)]
        points = np.concatenate([self.triangles.reshape(-1, 3), inside])
        if len(points) < 4 or thickness(points) < 2.0 * MIN_THICKNESS:
            points = _thickened(points)
        # made twice: the second time of nothing but vertices
        return ConvexHull(points[ConvexHull(points).vertices])

    @cached_property
    def excess(self) -> float:
        """How much of its hull is not solid [m^3]."""
        return max(0.0, self.hull.volume - self.solid.volume(self.low, self.high))

    def halves(self, through_void: float = 0.05) -> "list[Piece]":
        """The two parts of the best cut; the piece itself if every cut leaves one side empty.

        The best cut at x of an axis minimises

            (V_below + V_above - through_void A l) / V,

        with the volumes V of the hulls of both sides and of the piece, the area A of the cut that
        is not solid, and the length l of the piece along the axis.
        """
        # cuts are compared on the largest triangles and some of the others
        count = 600 if len(self.triangles) <= 600 else 120
        order = np.argsort(-trimesh.triangles.area(self.triangles))
        rest = order[count // 2 :]
        sketched = np.r_[order[: count // 2], rest[:: max(1, 2 * len(rest) // count)]]
        sketch, whole = self.triangles[sketched], max(self.hull.volume, 1e-30)
        area = self.solid.voids(planes_around(self.hull), self.low, self.high)
        best, axis, at = np.inf, 0, 0.0
        for axis_now, at_now in self._cuts():
            sides = _sides(sketch, axis_now, at_now)
            void = area(axis_now, at_now) * (self.high - self.low)[axis_now]
            cost = (sum(map(_volume, sides)) - through_void * void) / whole
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
        """Places worth cutting at: (axis, coordinate).

        Args:
            even: evenly spread ones along each axis.
            faces: of the largest faces across an axis, beside which it is cut.
            least: share of the piece's surface of such a face.
            across: cosine between the axis and its normal.
            nudge: share of the piece's length between a face and the cut beside it.
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


def convex_pieces(triangles: FloatArray, enough: float = 0.02) -> tuple[FloatArray, ...]:
    """Cut a mesh into convex pieces.

    Args:
        triangles: (f, 3, 3), f >= 1, finite; closed or open, whichever way round [m]. Those without
            area are left out.
        enough: share of the mesh's own hull that the pieces together may hold too much.

    Returns:
        Vertices (k, 3) of up to `MOST_PIECES` pieces, whose hulls together hold every triangle, and
        all that a closed mesh encloses [m].

    Raises InvalidInputError where the mesh as a whole spans no volume.
    """
    edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    without_points = triangles[edges.min(axis=1) > 0.0]  # flat ones can close a mesh
    flat = 1e-12 * edges.max(axis=1) ** 2
    triangles = triangles[trimesh.triangles.area(triangles) > flat]
    points = triangles.reshape(-1, 3)
    check_volume(points, "the corners of the mesh")
    closed = as_mesh(triangles).is_watertight or as_mesh(without_points).is_watertight
    whole = Piece(triangles, points.min(axis=0), points.max(axis=0), FilledCells(triangles, closed))
    most = enough * whole.hull.volume
    parts, final = [whole], list[Piece]()  # final: those that cannot be cut
    while parts and len(parts) + len(final) < MOST_PIECES:
        if sum(part.excess for part in parts) <= most:
            break
        worst = max(parts, key=lambda part: part.excess)
        parts.remove(worst)
        halves = worst.halves()
        (parts if len(halves) > 1 else final).extend(halves)
    return tuple(of_few_vertices(part.hull) for part in (*parts, *final))


def as_mesh(triangles: FloatArray) -> trimesh.Trimesh:
    """Triangles (f, 3, 3) with equal corners joined."""
    return trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))


def _clipped(triangles: FloatArray, axis: int, at: float, sign: float) -> FloatArray:
    """Triangles (g, 3, 3) of what lies on one side of a plane across an axis."""
    normal, origin = np.zeros(3), np.zeros(3)
    normal[axis], origin[axis] = sign, at
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    corners = triangles.reshape(-1, 3)
    vertices, faces, *_ = trimesh.intersections.slice_faces_plane(corners, faces, normal, origin)
    return np.asarray(vertices)[np.asarray(faces, dtype=int)].reshape(-1, 3, 3)


def _sides(triangles: FloatArray, axis: int, at: float) -> tuple[FloatArray, FloatArray]:
    """Points (k, 3) whose hulls are those of the two sides of triangles (f, 3, 3)."""
    ends = np.roll(triangles, -1, axis=1)
    before, after = triangles[..., axis] - at, ends[..., axis] - at
    crossed = (before < 0.0) != (after < 0.0)
    share = before[crossed] / (before[crossed] - after[crossed])
    between = triangles[crossed] + share[:, None] * (ends - triangles)[crossed]
    low = triangles[before < 0.0], between
    return np.concatenate(low), np.concatenate([triangles[before >= 0.0], between])


def _volume(points: FloatArray) -> float:
    """Volume [m^3] of the hull of points (k, 3) [m]; 0 for flat ones."""
    try:
        return float(ConvexHull(points).volume) if len(points) > 3 else 0.0
    except QhullError:
        return 0.0


def of_few_vertices(hull: ConvexHull) -> FloatArray:
    """Vertices (k, 3) of a hull, or of one of at most `MOST_VERTICES` that holds it [m].

    Hulls with more keep only some of their faces, moved outwards until they hold all.
    """
    vertices = hull.points[hull.vertices]
    if len(vertices) <= MOST_VERTICES:
        return vertices
    corners = HalfspaceIntersection(planes_around(hull), vertices.mean(axis=0)).intersections
    return corners[ConvexHull(corners).vertices]


def planes_around(hull: ConvexHull, most: int = 62, slack: float = 1e-9) -> FloatArray:
    """Planes (p, 4) around a hull: outward normals, and offsets [m].

    A hull of many vertices gets about `most` planes, slack [m] further out for rounding.
    """
    if len(hull.vertices) <= MOST_VERTICES:
        return hull.equations
    normals, vertices = hull.equations[:, :3], hull.points[hull.vertices]
    chosen = [*np.eye(3), *-np.eye(3)]
    nearest = np.max(normals @ np.array(chosen).T, axis=1)
    while len(chosen) < most:
        # the normal farthest from those chosen
        chosen.append(normals[np.argmin(nearest)])
        nearest = np.maximum(nearest, normals @ chosen[-1])
    planes = np.unique(np.array(chosen), axis=0)
    reach = (vertices @ planes.T).max(axis=0) + slack
    return np.c_[planes, -reach]


def spread_points(triangles: FloatArray, count: int, most: int = 400_000) -> FloatArray:
    """Up to `most` points (count, 3), spread over triangles (f, 3, 3) as evenly as their areas."""
    count = min(count, most)
    a, b, c = np.moveaxis(triangles, 1, 0)
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    k = np.arange(count)
    which = np.searchsorted(area, (k + 0.5) / count * area[-1]).clip(max=len(area) - 1)
    u, v = (k * 0.7548776662466927) % 1.0, (k * 0.5698402909980532) % 1.0  # evenly in the square
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    return a[which] + u[:, None] * (b - a)[which] + v[:, None] * (c - a)[which]


def _thickened(points: FloatArray) -> FloatArray:
    """Points (2 k, 3) whose hull holds the points and is thick enough, whatever they are."""
    centred = points - points.mean(axis=0)
    turned = np.linalg.eigh(centred.T @ centred)[1].T  # rows: the thinnest direction first
    low, high = (points @ turned.T).min(axis=0), (points @ turned.T).max(axis=0)
    gap = np.maximum(0.0, 2.0 * MIN_THICKNESS - (high - low)) / 2.0
    if (gap[1:] > 0.0).any():
        low, high = low - gap, high + gap  # a line at most: a box around it
        return np.array(list(product(*zip(low, high, strict=True)))) @ turned
    return np.concatenate([points - gap[0] * turned[0], points + gap[0] * turned[0]])


def read_mesh(path: Path | str, scale: float = 1.0) -> tuple[FloatArray, ...]:
    """Read a mesh as convex pieces that together contain its whole surface; see `convex_pieces`.

    Args:
        path: of the file.
        scale: length of one unit of the file [m]. A DAE file states its own unit: its lengths are
            converted to metres first, and then multiplied by `scale`. Its up axis is ignored.
            Meshes of robots are read in the same way.

    Returns:
        Vertices (k, 3) [m] of each piece.

    Raises InvalidInputError if the file cannot be read, has no triangle or more than
    `MOST_TRIANGLES`, spans no volume, or has lengths that are evidently not metres.
    """
    triangles = scale * read_triangles(path)
    check_lengths(triangles.reshape(-1, 3), f"mesh {path}", room=20.0)
    with parsing(Path(path), "mesh"):
        return convex_pieces(triangles)


def read_triangles(path: Path | str) -> FloatArray:
    """Corners (f, 3, 3) of the triangles of a file, in its unit; those of a DAE file in metres."""
    return read_by_suffix(READERS, path, "mesh")


def _triangles(kind: str, data: bytes) -> FloatArray:
    """Corners (f, 3, 3) of the triangles in the content of a file of a kind, e.g. "stl"."""
    if kind == "obj":
        # the encoding may not be UTF-8, and trimesh skips lines that begin with tabs or blanks
        lines = data.decode("utf-8", errors="replace").splitlines()
        data = "\n".join(" ".join(line.split()) for line in lines).encode()
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False)
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if len(faces) == 0:
        raise InvalidInputError("it has no triangle: cut short?")
    # trimesh leaves out triangles that follow the end of a solid in a text STL
    stated = data.lower().count(b"endfacet") if kind == "stl" else 0
    if stated not in (0, len(faces)):
        raise InvalidInputError(f"{len(faces)} of its {stated} triangles belong to a solid")
    if len(faces) > MOST_TRIANGLES:
        raise InvalidInputError(
            f"it has {len(faces)} triangles; {MOST_TRIANGLES} at most: simplify it"
        )
    corners = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3)[faces]
    if not np.isfinite(corners).all():
        raise InvalidInputError("a corner of a triangle is not finite")
    return collada_unit(data) * corners if kind == "dae" else corners


READERS = {f".{kind}": partial(_triangles, kind) for kind in ("stl", "obj", "dae")}
"""Readers of meshes by the file's suffix."""
