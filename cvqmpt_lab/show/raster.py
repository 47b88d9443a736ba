"""Pictures of triangles without a display: viewpoints, z-buffer, light, shadow and outlines."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry
from cvqmpt_lab.show.meshes import Colour, Mesh, joined, unit


@dataclass(frozen=True)
class Viewpoint:
    """A viewpoint: a pinhole camera, z up."""

    eye: tuple[float, float, float] = (-1.7, -2.0, 1.75)  # [m]
    target: tuple[float, float, float] = (0.4, -0.1, 0.5)  # in the middle of the picture [m]
    height_angle: float = 0.64  # angle of view from the bottom to the top of the picture [rad]
    near: float = 0.05  # triangles closer to the eye than this are left out [m]

    @property
    def axes(self) -> np.ndarray:
        """Directions right, down, forward: rows (3, 3)."""
        forward = unit(np.subtract(self.target, self.eye))
        right = unit(np.cross(forward, (0.0, 0.0, 1.0)))
        return np.array([right, np.cross(forward, right), forward])

    @property
    def sun(self) -> np.ndarray:
        """Direction (3,) towards the sun: behind the viewer, 0.14 rad to the left of the eye."""
        away = np.subtract(self.eye, self.target)
        azimuth, elevation = np.arctan2(away[1], away[0]) - 0.14, 0.722
        across = np.cos(elevation)
        return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])

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


class View(NamedTuple):
    """The k pixels of a picture in which a surface is seen."""

    row: np.ndarray  # (k,)
    column: np.ndarray  # (k,)
    depth: np.ndarray  # (k,) [m] along the picture's axis
    points: np.ndarray  # (k, 3) [m]
    normals: np.ndarray  # (k, 3), length 1
    colours: np.ndarray  # (k, 3)
    piece: np.ndarray  # (k,), see `Mesh`

    @property
    def at(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of its pixels in a picture."""
        return self.row, self.column

    def nearer_than(self, depth: np.ndarray) -> "View":
        """The pixels that are nearer than a depth (rows, columns) [m]."""
        nearer = self.depth < depth[self.at]
        return View(*(part[nearer] for part in self))


def rasterise(mesh: Mesh, viewpoint: Viewpoint, shape: tuple[int, int]) -> View:
    """The pixels of a picture (rows, columns) in which a mesh is seen."""
    screen = viewpoint.screen(mesh.corners, shape)
    nearness = 1.0 / np.maximum(screen[..., 2], viewpoint.near)  # linear on the screen
    # barycentric coordinates of a pixel: weights[:, k] @ (x, y, 1)
    (x1, x2), (y1, y2) = (
        [np.roll(screen[..., axis], -s, axis=1) for s in (1, 2)] for axis in (0, 1)
    )
    weights = np.stack([y1 - y2, x2 - x1, x1 * y2 - x2 * y1], axis=-1)
    area = weights[..., 2].sum(axis=1)
    weights /= np.where(np.abs(area) > 1e-9, area, np.inf)[:, None, None]
    planes = (nearness[..., None] * weights).sum(axis=1)
    low = np.maximum(np.ceil(screen[..., :2].min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(screen[..., :2].max(axis=1)) + 1, shape[::-1]).astype(int)
    drawn = (area < 0.0) & (low < high).all(axis=1) & (screen[..., 2] > viewpoint.near).all(axis=1)
    face, nearest = np.full(shape, -1), np.zeros(shape)
    _fill(face, nearest, np.flatnonzero(drawn), planes, weights, low, high)
    row, column = np.nonzero(face >= 0)
    seen = face[row, column]
    pixel = np.stack([column, row, np.ones(len(seen))], axis=1)
    normals = np.zeros_like(pixel)
    for k in range(3):
        normals += (weights[seen, k] * pixel).sum(axis=1, keepdims=True) * mesh.normals[seen, k]
    depth = 1.0 / nearest[row, column]
    points = viewpoint.eye + depth[:, None] * viewpoint.rays(row, column, shape)
    colours, piece = mesh.colours[seen], mesh.piece[seen]
    return View(row, column, depth, points, unit(normals), colours, piece)


@entry
def _fill(
    face: Annotated[np.ndarray, "int64 rows columns"],
    nearest: Annotated[np.ndarray, "rows columns"],
    drawn: Annotated[np.ndarray, "int64 d"],
    planes: Annotated[np.ndarray, "f 3"],
    weights: Annotated[np.ndarray, "f 3 3"],
    low: Annotated[np.ndarray, "int64 f 2"],
    high: Annotated[np.ndarray, "int64 f 2"],
):
    """Write the nearest triangle of each pixel; of equally near ones the first stays.

    face, nearest: number and nearness [1/m] of the triangle seen, changed.
    drawn: numbers of the triangles that are drawn.
    planes, weights: nearness and corner weights of a pixel (x, y, 1) on each triangle.
    low, high: first pixel (x, y) of each and the one after its last.
    """
    for f in drawn:
        for y in range(low[f, 1], high[f, 1]):
            for x in range(low[f, 0], high[f, 0]):
                here = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2]
                seen = here > nearest[y, x]
                for k in range(3):
                    weight = weights[f, k, 0] * x + weights[f, k, 1] * y + weights[f, k, 2]
                    seen = seen and weight >= 0.0
                if seen:
                    face[y, x], nearest[y, x] = f, here


class Shadow:
    """The shadow of a mesh, as a shadow map."""

    def __init__(
        self, mesh: Mesh, sun: np.ndarray, side: int, distance: float = 40.0, bias: float = 0.025
    ) -> None:
        """Draw the map.

        Args:
            mesh: what casts the shadow.
            sun: direction (3,) towards it.
            side: of the map [pixels].
            distance: of the viewpoint whose picture is the map [m].
            bias: a surface shadows only what lies this far behind it [m].
        """
        corners = mesh.corners if len(mesh.corners) else np.zeros((1, 3, 3))
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        self._middle = middle = 0.5 * (low + high)
        # what lies farther from the middle than 2.6 m casts no shadow
        self._reach = float(np.clip(0.5 * np.linalg.norm(high - low), 1e-3, 2.6))
        angle = 2.0 * float(np.arctan(self._reach / distance))
        self._from_sun = Viewpoint(tuple(middle + distance * sun), tuple(middle), angle)
        view = rasterise(mesh, self._from_sun, (side, side))
        self._blocked = np.full((side, side), np.inf)
        self._blocked[view.at] = view.depth + bias

    def lit(self, points: np.ndarray) -> np.ndarray:
        """Share (k,) of the sunlight that reaches points (k, 3) [m]."""
        shape, share = self._blocked.shape, np.ones(len(points))
        across = np.abs((points - self._middle) @ self._from_sun.axes[:2].T)
        near = np.flatnonzero((across < 1.2 * self._reach).all(axis=1))
        column, row, depth = self._from_sun.screen(points[near], shape).T
        total = np.zeros(len(near))
        for i, j in np.ndindex(3, 3):
            at = tuple(
                np.clip((a + b - 0.5).astype(int), 0, shape[0] - 1)
                for a, b in ((row, i), (column, j))
            )
            total += depth < self._blocked[at]
        share[near] = total / 9.0
        return share


class Layer(NamedTuple):
    """A translucent surface, with its lit colours."""

    view: View
    opacity: float
    behind: float  # opacity where something solid is in front of it


class Stage:
    """A still scene, seen from one viewpoint: drawn once, with its light and shadow."""

    def __init__(
        self,
        still: Mesh,
        ground: float | None,
        viewpoint: Viewpoint,
        size: tuple[int, int],
        samples: int = 2,
    ) -> None:
        """Draw the scene.

        Args:
            still: the scene.
            ground: height of a floor [m], or None.
            viewpoint: from where it is seen.
            size: width and height of pictures [pixels].
            samples: a pixel of a picture is the mean of samples x samples.
        """
        self.viewpoint, self._samples = viewpoint, samples
        self._shape = shape = (samples * size[1], samples * size[0])
        self._side = min(1536, 2 * max(shape))
        self._shadow = Shadow(still, viewpoint.sun, self._side)
        self._depth, self._piece = np.full(shape, np.inf), np.full(shape, -1)
        self._points = np.zeros((*shape, 3), np.float32)
        # colours where the sun does not shine, and what the sun adds
        self._shade = np.ones((*shape, 3), np.float32)
        self._sunny = np.zeros((*shape, 3), np.float32)
        view = rasterise(still, viewpoint, shape)
        self._depth[view.at], self._piece[view.at] = view.depth, view.piece
        self._lay(view)
        if ground is not None:
            self._lay_ground(ground)

    def layer(self, mesh: Mesh, opacity: float, behind: float = 0.0) -> Layer:
        """A translucent mesh as it is seen from the stage's viewpoint."""
        view = rasterise(mesh, self.viewpoint, self._shape)
        return Layer(view._replace(colours=np.add(*self._lit(view))), opacity, behind)

    def image(
        self, moving: Mesh, layers: Sequence[Layer] = (), outline: float = 0.55
    ) -> np.ndarray:
        """Colours (height, width, 3), 8 bit, of scene, moving mesh and layers over both.

        outline: what is left of the light at outlines of pieces.
        """
        shadow = Shadow(moving, self.viewpoint.sun, self._side // 2)
        share = shadow.lit(self._points.reshape(-1, 3)).astype(np.float32)
        image = self._shade + self._sunny * share.reshape(*self._shape, 1)
        depth, piece = self._depth.copy(), self._piece.copy()
        view = rasterise(moving, self.viewpoint, self._shape).nearer_than(depth)
        image[view.at] = np.add(*self._lit(view, self._shadow, shadow))
        depth[view.at], piece[view.at] = view.depth, view.piece + 1 + self._piece.max()
        edge = np.zeros(piece.shape, dtype=bool)  # pieces that begin right or below
        edge[:, 1:] |= piece[:, 1:] != piece[:, :-1]
        edge[1:] |= piece[1:] != piece[:-1]
        image[edge] *= outline
        depths = [depth]  # of what is solid and of translucent layers
        for layer in layers:
            _blend(image, depths, layer)
        rows, columns = (side // self._samples for side in self._shape)
        blocks = image.reshape(rows, self._samples, columns, self._samples, 3)
        return (255.0 * np.clip(blocks.mean(axis=(1, 3)), 0.0, 1.0) + 0.5).astype(np.uint8)

    def _lit(self, view: View, *shadows: Shadow) -> tuple[np.ndarray, np.ndarray]:
        """Colours (k, 3) of a surface where the sun does not shine, and what the sun adds."""
        sky, sun = self.viewpoint.light(view.normals)
        sun = np.min([sun, *(sun * shadow.lit(view.points) for shadow in shadows)], axis=0)
        return sky[:, None] * view.colours, sun[:, None] * view.colours

    def _lay(self, view: View) -> None:
        """Put a still surface at its pixels."""
        self._points[view.at] = view.points
        self._shade[view.at], self._sunny[view.at] = self._lit(view, self._shadow)

    def _lay_ground(self, height: float, colour: Colour = (0.88, 0.87, 0.85)) -> None:
        """Put the plane z = height [m] at empty pixels; it fades into white with distance."""
        row, column = np.nonzero(self._piece < 0)
        rays = self.viewpoint.rays(row, column, self._shape)
        depth = (height - self.viewpoint.eye[2]) / np.where(rays[:, 2] == 0.0, np.inf, rays[:, 2])
        points = self.viewpoint.eye + depth[:, None] * rays
        away = np.linalg.norm(points - self.viewpoint.target, axis=1)
        share = np.clip(1.6 - 0.4 * away, 0.0, 1.0) * (depth > 0.0)
        upwards, colours = np.tile([0.0, 0.0, 1.0], (len(row), 1)), np.outer(share, colour)
        self._lay(View(row, column, depth, points, upwards, colours, row))
        self._shade[row, column] += (1.0 - share)[:, None]


def _blend(
    image: np.ndarray, depths: list[np.ndarray], layer: Layer, coincide: float = 0.01
) -> None:
    """Blend a layer over an image; if translucent, not within `coincide` [m] of others.

    image: (rows, columns, 3), changed.
    depths: (rows, columns) [m] of what is solid and of earlier layers; that of the layer is added.
    """
    view, at = layer.view, layer.view.at
    in_front = view.depth < depths[0][at] - 1e-3
    share = np.where(in_front, layer.opacity, layer.behind)
    if layer.opacity < 1.0:
        for depth in depths:
            share[np.abs(view.depth - depth[at]) < coincide] = 0.0
        depths.append(np.full(image.shape[:2], np.inf, np.float32))
        depths[-1][at] = view.depth
    image[at] += share[:, None] * (view.colours - image[at])


def clear_viewpoint(
    parts: Sequence[Mesh],
    scene: Mesh,
    size: tuple[int, int],
    inside: Sequence[Mesh] = (),
    torso: Mesh | None = None,
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
        inside: what the picture holds too, even where the scene hides it.
        torso: that carries several arms, which are seen from in front of it, if it has any corners.
        azimuths: from the motion to the eye, in the order in which they are tried [deg].
        enough: share of the motion in sight at which no other direction is tried.
        gain: share that another direction must show more to be taken instead.
        rows: of the small pictures in which directions are compared [pixels].
    """
    shape = (rows, round(rows * size[0] / size[1]))
    points = np.concatenate([part.corners.reshape(-1, 3) for part in (*parts, *inside)])
    ways, elevation, still = list(azimuths), 24.0, [scene]
    if torso is not None and len(torso.corners):
        ways, elevation, still = [35.0, -35.0, *ways], 35.0, [scene, torso]
    best, best_share = framed(points, size), -1.0
    for azimuth in ways:
        viewpoint = framed(points, size, azimuth, elevation)
        # shares of the parts that are not behind the scene or an earlier part
        depth, shares = np.full(shape, np.inf), []
        for mesh in (joined(still), *parts):
            view = rasterise(mesh, viewpoint, shape)
            nearer = view.nearer_than(depth)
            depth[nearer.at] = nearer.depth
            shares.append(len(nearer.depth) / len(view.depth) if len(view.depth) else 1.0)
        share = float(np.mean(shares[1:]))
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
