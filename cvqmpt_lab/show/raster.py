"""Pictures of triangles without a display: viewpoints, z-buffer, light, shadow and outlines."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.show.meshes import Colour, Mesh, joined, unit


@dataclass(frozen=True)
class Viewpoint:
    """A viewpoint: a pinhole camera, z up."""

    eye: tuple[float, float, float] = (-1.7, -2.0, 1.75)  # [m]
    target: tuple[float, float, float] = (0.4, -0.1, 0.5)  # in the middle of the picture [m]
    height_angle: float = 0.64  # angle of view from the bottom to the top of the picture [rad]
    near: float = 0.05  # triangles closer to the eye than this are left out [m]
    sun_left: float = 0.14  # angle of the sun to the left of the eye, seen from the target [rad]
    sun_elevation: float = 0.722  # angle of the sun above the ground [rad]

    @property
    def axes(self) -> np.ndarray:
        """Directions right, down, forward: rows (3, 3)."""
        forward = unit(np.subtract(self.target, self.eye))
        right = unit(np.cross(forward, (0.0, 0.0, 1.0)))
        return np.array([right, np.cross(forward, right), forward])

    @property
    def sun(self) -> np.ndarray:
        """Direction (3,) towards the sun, which is behind the viewer."""
        away = np.subtract(self.eye, self.target)
        azimuth = np.arctan2(away[1], away[0]) - self.sun_left
        across = np.cos(self.sun_elevation)
        return np.array(
            [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(self.sun_elevation)]
        )

    def screen(self, points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Points (..., 3) [m] as (column, row [pixels], depth [m]) of a picture."""
        right, down, depth = np.moveaxis((points - self.eye) @ self.axes.T, -1, 0)
        scale = 0.5 * shape[0] / np.tan(0.5 * self.height_angle) / np.maximum(depth, self.near)
        return np.stack(
            [scale * right + 0.5 * shape[1], scale * down + 0.5 * shape[0], depth], axis=-1
        )

    def rays(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Directions (k, 3) through pixels; a point at depth d is eye + d * ray."""
        scale = 2.0 * np.tan(0.5 * self.height_angle) / shape[0]
        right, down = scale * (columns - 0.5 * shape[1]), scale * (rows - 0.5 * shape[0])
        return np.stack([right, down, np.ones(len(rows))], axis=1) @ self.axes

    def light(
        self, normals: np.ndarray, sky: float = 0.58, steep: float = 0.1, sun: float = 0.46
    ) -> tuple[np.ndarray, np.ndarray]:
        """Light at normals n (k, 3): `sky + steep n_z`, and the sun's `sun max(n . s, 0)`."""
        return sky + steep * normals[:, 2], sun * np.maximum(normals @ self.sun, 0.0)


@dataclass(frozen=True, eq=False)
class View:
    """The pixels in which a mesh is seen."""

    rows: np.ndarray  # (k,)
    columns: np.ndarray  # (k,)
    face: np.ndarray  # (k,), the triangle seen
    depth: np.ndarray  # (k,) [m] along the picture's axis
    normals: np.ndarray  # (k, 3), length 1


def rasterise(
    mesh: Mesh,
    viewpoint: Viewpoint,
    shape: tuple[int, int],
    small: Sequence[int] = (0, 4, 8, 16, 32),
    at_once: int = 1_000_000,
) -> View:
    """The pixels of a picture in which a mesh is seen; the nearest triangle counts.

    Args:
        mesh: what is seen.
        viewpoint: from where.
        shape: rows and columns of the picture.
        small: sides of squares [pixels] in which small triangles are drawn many at a time.
        at_once: pixels of such squares.
    """
    screen = viewpoint.screen(mesh.corners, shape)
    nearness = 1.0 / np.maximum(screen[..., 2], viewpoint.near)  # linear on the screen
    weights, area = _corner_weights(screen[..., :2])
    planes = (nearness[..., None] * weights).sum(axis=1)
    low = np.maximum(np.ceil(screen[..., :2].min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(screen[..., :2].max(axis=1)) + 1, shape[::-1]).astype(int)
    drawn = (area < 0.0) & (low < high).all(axis=1) & (screen[..., 2] > viewpoint.near).all(axis=1)
    face, nearest = np.full(shape, -1), np.zeros(shape)
    edges, width = np.concatenate([planes[:, None], weights], axis=1), (high - low).max(axis=1)
    for least, most in pairwise(small):
        faces = np.flatnonzero(drawn & (least < width) & (width <= most))
        for part in np.array_split(faces, 1 + len(faces) * most**2 // at_once):
            _fill_small(face, nearest, part, edges[part], low[part], high[part], most)
    row, column = np.arange(shape[0])[:, None], np.arange(shape[1])
    for f in np.flatnonzero(drawn & (width > small[-1])):
        block = slice(low[f, 1], high[f, 1]), slice(low[f, 0], high[f, 0])
        y, x = row[block[0]], column[block[1]]
        here = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2]
        inside = (here > nearest[block]) | ((here == nearest[block]) & (f < face[block]))
        for a, b, c in weights[f]:
            inside &= a * x + b * y + c >= 0.0
        nearest[block][inside] = here[inside]
        face[block][inside] = f
    rows, columns = np.nonzero(face >= 0)
    seen = face[rows, columns]
    pixel = np.stack([columns, rows, np.ones(len(rows))], axis=1)
    normals = np.zeros_like(pixel)
    for k in range(3):
        normals += (weights[seen, k] * pixel).sum(axis=1, keepdims=True) * mesh.normals[seen, k]
    return View(rows, columns, seen, 1.0 / nearest[rows, columns], unit(normals))


def _fill_small(
    face: np.ndarray,
    nearest: np.ndarray,
    faces: np.ndarray,
    edges: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    side: int,
) -> None:
    """Draw many small triangles at once, like `rasterise`; of equally near ones the first counts.

    face, nearest: (rows, columns), changed.
    faces: their numbers (k,).
    edges: (k, 4, 3), nearness and corner weights of a pixel (x, y, 1).
    low, high: (k, 2), first pixel of each and the one after its last, at most side away.
    """
    x, y = low[:, 0, None, None] + np.arange(side), low[:, 1, None, None] + np.arange(side)[:, None]
    a, b, c = (edges[..., k, None, None] for k in range(3))
    seen = (x < high[:, 0, None, None]) & (y < high[:, 1, None, None])
    for k in range(1, edges.shape[1]):
        seen &= a[:, k] * x + b[:, k] * y + c[:, k] >= 0.0
    here = (a[:, 0] * x + b[:, 0] * y + c[:, 0])[seen]
    pixel, f = (y * face.shape[1] + x)[seen], faces[np.nonzero(seen)[0]]
    flat_face, flat_nearest = face.reshape(-1), nearest.reshape(-1)
    before = flat_nearest[pixel]
    np.maximum.at(flat_nearest, pixel, here)
    wins = (here == flat_nearest[pixel]) & ((here > before) | (f < flat_face[pixel]))
    flat_face[pixel[wins][::-1]] = f[wins][::-1]  # of what is assigned twice the last stays


def _corner_weights(screen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates of triangles (f, 3, 2), [:, k] @ (x, y, 1), and signed areas (f,)."""
    (x1, x2), (y1, y2) = (
        [np.roll(screen[..., axis], -s, axis=1) for s in (1, 2)] for axis in (0, 1)
    )
    rows = np.stack([y1 - y2, x2 - x1, x1 * y2 - x2 * y1], axis=-1)
    area = rows[..., 2].sum(axis=1)
    return rows / np.where(np.abs(area) > 1e-9, area, np.inf)[:, None, None], area


class Shadow:
    """The shadow of a mesh, as a shadow map."""

    def __init__(
        self,
        mesh: Mesh,
        sun: np.ndarray,
        side: int,
        distance: float = 40.0,
        most_reach: float = 2.6,
        bias: float = 0.025,
    ) -> None:
        """Draw the map.

        Args:
            mesh: what casts the shadow.
            sun: direction (3,) towards it.
            side: of the map [pixels].
            distance: of the viewpoint whose picture is the map [m].
            most_reach: around the mesh's middle; what lies farther casts no shadow [m].
            bias: a surface shadows only what lies this far behind it [m].
        """
        low, high = mesh.corners.min(axis=(0, 1)), mesh.corners.max(axis=(0, 1))
        self._middle = middle = 0.5 * (low + high)
        self._reach = min(most_reach, 0.5 * float(np.linalg.norm(high - low)))
        angle = 2.0 * float(np.arctan(self._reach / distance))
        self._from_sun = Viewpoint(tuple(middle + distance * sun), tuple(middle), angle)
        self._shape = (side, side)
        view = rasterise(mesh, self._from_sun, self._shape)
        self._blocked = np.full(self._shape, np.inf)
        self._blocked[view.rows, view.columns] = view.depth + bias

    def may_reach(self, across: np.ndarray) -> np.ndarray:
        """Which points may be in the shadow; across: (k, 2) [m] across the sunlight."""
        middle = self._from_sun.axes[:2] @ self._middle
        return (np.abs(across - middle) < 1.2 * self._reach).all(axis=1)

    def lit(self, points: np.ndarray) -> np.ndarray:
        """Share (k,) of the sunlight that reaches points (k, 3) [m]."""
        column, row, depth = np.moveaxis(self._from_sun.screen(points, self._shape), -1, 0)
        total = np.zeros(len(points))
        for i, j in np.ndindex(3, 3):
            at = tuple(
                np.clip((a + b - 0.5).astype(int), 0, self._shape[0] - 1)
                for a, b in ((row, i), (column, j))
            )
            total += depth < self._blocked[at]
        return total / 9.0


class Layer(NamedTuple):
    """A translucent mesh as it is seen."""

    view: View
    colours: np.ndarray  # (k, 3), lit, of the view's pixels
    opacity: float
    behind: float  # opacity where something solid is in front of it


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with depth."""

    image: np.ndarray  # (rows, columns, 3), each channel in [0, 1]
    depth: np.ndarray  # (rows, columns) [m], inf where nothing solid is
    ghosts: list[np.ndarray] = field(default_factory=list)  # depth of each translucent layer

    def blend(self, layer: Layer, coincide: float = 0.01) -> None:
        """Blend a layer over the picture; if translucent, not within `coincide` [m] of bodies."""
        view = layer.view
        at = view.rows, view.columns
        in_front = view.depth < self.depth[at] - 1e-3
        share = np.where(in_front, layer.opacity, layer.behind)[:, None]
        if layer.opacity < 1.0:
            for depth in (self.depth, *self.ghosts):
                share[np.abs(view.depth - depth[at]) < coincide] = 0.0
            self.ghosts.append(np.full(self.depth.shape, np.inf, np.float32))
            self.ghosts[-1][at] = view.depth
        self.image[at] += share * (layer.colours - self.image[at])

    def eight_bit(self, samples: int) -> np.ndarray:
        """Colours (height, width, 3), 8 bit, the mean of samples x samples pixels each."""
        rows, columns = (side // samples for side in self.image.shape[:2])
        blocks = self.image.reshape(rows, samples, columns, samples, 3)
        return (255.0 * np.clip(blocks.mean(axis=(1, 3)), 0.0, 1.0) + 0.5).astype(np.uint8)


class Stage:
    """A still scene, seen from one viewpoint: drawn once, with its light and shadow."""

    def __init__(
        self,
        still: Sequence[Mesh],
        ground: float | None,
        viewpoint: Viewpoint,
        size: tuple[int, int],
        ground_colour: Colour = (0.88, 0.87, 0.85),
        samples: int = 2,
        most_side: int = 1536,
    ) -> None:
        """Draw the scene.

        Args:
            still: meshes of the scene.
            ground: height of a floor [m], or None.
            viewpoint: from where it is seen.
            size: width and height of pictures [pixels].
            ground_colour: of the floor.
            samples: a pixel of a picture is the mean of samples x samples.
            most_side: of a shadow map [pixels].
        """
        self.viewpoint, self.samples = viewpoint, samples
        self.shape = shape = (samples * size[1], samples * size[0])
        self._side = min(most_side, 2 * max(shape))
        self._shadow: Shadow | None = None
        self._colours = np.ones((*shape, 3), np.float32)
        self._points = np.zeros((*shape, 3), np.float32)
        self._sky, self._sun = np.ones(shape, np.float32), np.zeros(shape, np.float32)
        self._white = np.zeros(shape, np.float32)
        self._depth, self._piece = np.full(shape, np.inf), np.full(shape, -1)
        if still:
            mesh = joined(still)
            self._shadow = Shadow(mesh, viewpoint.sun, self._side)
            view = rasterise(mesh, viewpoint, shape)
            at = view.rows, view.columns
            self._depth[at], self._piece[at] = view.depth, mesh.piece[view.face]
            self._lay(at, view.depth, mesh.colours[view.face], view.normals)
        if ground is not None:
            self._lay_ground(ground, ground_colour)
        self._sunny = np.nonzero(self._sun)
        # two directions across the sunlight
        sun_axes = Viewpoint(tuple(viewpoint.sun), (0.0, 0.0, 0.0)).axes[:2]
        self._across = self._points[self._sunny] @ sun_axes.T.astype(np.float32)

    def layer(self, mesh: Mesh, opacity: float, behind: float = 0.0) -> Layer:
        """A translucent mesh as it is seen from the stage's viewpoint."""
        view = rasterise(mesh, self.viewpoint, self.shape)
        sky, sunlight = self.viewpoint.light(view.normals)
        return Layer(view, mesh.colours[view.face] * (sky + sunlight)[:, None], opacity, behind)

    def image(self, moving: Sequence[Mesh], layers: Sequence[Layer] = ()) -> np.ndarray:
        """Colours (height, width, 3), 8 bit, of scene, moving meshes and layers over both."""
        picture = self.picture(moving)
        for layer in layers:
            picture.blend(layer)
        return picture.eight_bit(self.samples)

    def picture(self, moving: Sequence[Mesh], outline: float = 0.55) -> Picture:
        """The scene with the meshes that move; outline: what is left of the light there."""
        mesh = joined(moving)
        shadow = Shadow(mesh, self.viewpoint.sun, self._side // 2)
        sun, piece, depth = self._sun.copy(), self._piece.copy(), self._depth.copy()
        near = shadow.may_reach(self._across)
        below = self._sunny[0][near], self._sunny[1][near]
        sun[below] *= shadow.lit(self._points[below])
        image = self._colours * (self._sky + sun)[..., None] + self._white[..., None]
        view = rasterise(mesh, self.viewpoint, self.shape)
        nearer = view.depth < depth[view.rows, view.columns]
        at = view.rows[nearer], view.columns[nearer]
        depth[at] = view.depth[nearer]
        piece[at] = mesh.piece[view.face[nearer]] + 1 + self._piece.max()
        rays = self.viewpoint.rays(at[0], at[1], self.shape)
        points = self.viewpoint.eye + depth[at][:, None] * rays
        lit = np.minimum(self._lit(points), shadow.lit(points))
        sky, sunlight = self.viewpoint.light(view.normals[nearer])
        image[at] = mesh.colours[view.face[nearer]] * (sky + lit * sunlight)[:, None]
        edge = np.zeros(piece.shape, dtype=bool)  # pieces that begin right or below
        edge[:, 1:] |= piece[:, 1:] != piece[:, :-1]
        edge[1:] |= piece[1:] != piece[:-1]
        image[edge] *= outline
        return Picture(image, depth)

    def _lit(self, points: np.ndarray) -> np.ndarray:
        """Share (k,) of the sunlight that the scene lets through to points (k, 3)."""
        return np.ones(len(points)) if self._shadow is None else self._shadow.lit(points)

    def _lay(
        self,
        at: tuple[np.ndarray, ...],
        depth: np.ndarray,
        colours: np.ndarray,
        normals: np.ndarray,
    ) -> None:
        """Put a surface of given colours (k, 3) and normals (k, 3) at pixels (rows, columns)."""
        points = self.viewpoint.eye + depth[:, None] * self.viewpoint.rays(at[0], at[1], self.shape)
        sky, sunlight = self.viewpoint.light(normals)
        self._points[at], self._colours[at] = points, colours
        self._sky[at], self._sun[at] = sky, sunlight * self._lit(points)

    def _lay_ground(self, height: float, colour: Colour) -> None:
        """Put the plane z = height [m] at empty pixels; it fades into white with distance."""
        rows, columns = np.nonzero(self._piece < 0)
        rays = self.viewpoint.rays(rows, columns, self.shape)
        depth = (height - self.viewpoint.eye[2]) / np.where(rays[:, 2] == 0.0, np.inf, rays[:, 2])
        points = self.viewpoint.eye + depth[:, None] * rays
        away = np.linalg.norm(points - self.viewpoint.target, axis=1)
        share = np.clip(1.6 - 0.4 * away, 0.0, 1.0) * (depth > 0.0)
        seen = share > 0.0
        at, share = (rows[seen], columns[seen]), share[seen]
        upwards = np.tile([0.0, 0.0, 1.0], (len(share), 1))
        self._lay(at, depth[seen], np.tile(colour, (len(share), 1)), upwards)
        self._colours[at] *= share[:, None]
        self._white[at] = 1.0 - share


def clear_viewpoint(
    parts: Sequence[Mesh],
    scene: Sequence[Mesh],
    size: tuple[int, int],
    azimuths: Sequence[float] = (-132, -165, -95, 160, 125, -60, 90, -25, 55, 15),
    enough: float = 0.8,
    gain: float = 0.05,
    rows: int = 64,
) -> Viewpoint:
    """The viewpoint from which a motion fills the picture and most of each part of it is seen.

    Args:
        parts: of the motion.
        scene: what may be in front of them.
        size: width and height of the picture [pixels].
        azimuths: from the motion to the eye, in the order in which they are tried [deg].
        enough: share of the motion in sight at which no other direction is tried.
        gain: share that another direction must show more to be taken instead.
        rows: of the small pictures in which directions are compared [pixels].
    """
    scene = [joined(scene)] if scene else []
    shape = (rows, round(rows * size[0] / size[1]))
    points = np.concatenate([part.corners.reshape(-1, 3) for part in parts])
    best, best_share = framed(points, size), -1.0
    for azimuth in azimuths:
        viewpoint = framed(points, size, azimuth)
        share = _share_seen(parts, scene, viewpoint, shape)
        if share > best_share + gain:
            best, best_share = viewpoint, share
        if share > enough:
            break
    return best


def framed(
    points: np.ndarray,
    size: tuple[int, int],
    azimuth: float = -132.0,
    elevation: float = 24.0,
    context: float = 1.3,
) -> Viewpoint:
    """The viewpoint whose picture of (width, height) pixels holds points (m, 3) [m].

    It lies at an azimuth and an elevation [deg] above them, `context` times as far away as the one
    whose picture they fill.
    """
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    turn, rise = math.radians(azimuth), math.radians(elevation)
    towards_eye = np.array(
        [math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)]
    )
    near = Viewpoint(tuple(target + towards_eye), tuple(target))
    right, down, ahead = near.axes @ (points - target).T
    tall = math.tan(0.5 * near.height_angle)
    across = np.maximum(np.abs(down) / tall, np.abs(right) * size[1] / (tall * size[0]))
    distance = np.max(across - ahead)
    return Viewpoint(tuple(target + context * distance * towards_eye), tuple(target))


def _share_seen(
    parts: Sequence[Mesh], scene: Sequence[Mesh], viewpoint: Viewpoint, shape: tuple[int, int]
) -> float:
    """Mean over the parts of the share that is not behind the scene or an earlier part."""
    depth, shares = np.full(shape, np.inf), []
    for mesh in (*scene, *parts):
        view = rasterise(mesh, viewpoint, shape)
        nearer = view.depth < depth[view.rows, view.columns]
        depth[view.rows[nearer], view.columns[nearer]] = view.depth[nearer]
        shares.append(float(nearer.mean()) if len(nearer) else 1.0)
    return float(np.mean(shares[len(scene) :]))
