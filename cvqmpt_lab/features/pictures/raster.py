"""Rendering of triangles without a display: viewpoints, z-buffer, light, shadow and outlines."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry
from cvqmpt_lab.features.pictures.meshes import Colour, Mesh, joined, unit


@dataclass(frozen=True)
class Viewpoint:
    """A pinhole camera whose picture has the z-axis upwards."""

    eye: tuple[float, float, float] = (-1.7, -2.0, 1.75)  # [m]
    target: tuple[float, float, float] = (0.4, -0.1, 0.5)  # point in the picture's centre [m]
    height_angle: float = 0.64  # vertical angle of view [rad]
    near: float = 0.05  # triangles closer to the eye are not drawn [m]

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors right, down and forward, the rows of (3, 3)."""
        forward = unit(np.subtract(self.target, self.eye))
        right = unit(np.cross(forward, (0.0, 0.0, 1.0)))
        return np.array([right, np.cross(forward, right), forward])

    @property
    def sun(self) -> np.ndarray:
        """Unit vector (3,) towards the sun, which is behind the viewer and 0.14 rad to the left."""
        away = np.subtract(self.eye, self.target)
        azimuth, elevation = np.arctan2(away[1], away[0]) - 0.14, 0.722
        across = np.cos(elevation)
        return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])

    def screen(self, points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Column and row [pixels] and depth [m], (..., 3), of points (..., 3) [m] in a picture."""
        right, down, depth = np.moveaxis((points - self.eye) @ self.axes.T, -1, 0)
        scale = 0.5 * shape[0] / np.tan(0.5 * self.height_angle) / np.maximum(depth, self.near)
        return np.stack(
            [scale * right + 0.5 * shape[1], scale * down + 0.5 * shape[0], depth], axis=-1
        )

    def rays(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Rays (k, 3) through pixels (k,); the point at depth d [m] is eye + d * ray."""
        scale = 2.0 * np.tan(0.5 * self.height_angle) / shape[0]
        right, down = scale * (columns - 0.5 * shape[1]), scale * (rows - 0.5 * shape[0])
        return np.stack([right, down, np.ones(len(rows))], axis=1) @ self.axes

    def light(
        self, normals: np.ndarray, sky: float = 0.58, steep: float = 0.1, sun: float = 0.46
    ) -> tuple[np.ndarray, np.ndarray]:
        """Brightness of surfaces: `sky + steep n_z`, and `sun max(n . s, 0)` where the sun shines.

        Args:
            normals: unit normals n (k, 3).
            sky: brightness of a vertical surface without sun.
            steep: additional brightness of a horizontal surface.
            sun: brightness that the sun adds to a surface that faces it; s is its direction.
        """
        return sky + steep * normals[:, 2], sun * np.maximum(normals @ self.sun, 0.0)


class Fragments(NamedTuple):
    """The k pixels of a picture in which a surface is visible."""

    row: np.ndarray  # (k,)
    column: np.ndarray  # (k,)
    depth: np.ndarray  # (k,) along the camera's axis [m]
    points: np.ndarray  # (k, 3) [m]
    normals: np.ndarray  # (k, 3), length 1
    colours: np.ndarray  # (k, 3)
    piece: np.ndarray  # (k,), see `Mesh`

    @property
    def at(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the pixels in a picture."""
        return self.row, self.column

    def nearer_than(self, depth: np.ndarray) -> "Fragments":
        """The fragments that are nearer than a depth buffer (rows, columns) [m]."""
        nearer = self.depth < depth[self.at]
        return Fragments(*(part[nearer] for part in self))


def rasterise(mesh: Mesh, viewpoint: Viewpoint, shape: tuple[int, int]) -> Fragments:
    """Visible fragments of a mesh in a picture of shape (rows, columns)."""
    screen = viewpoint.screen(mesh.corners, shape)
    nearness = 1.0 / np.maximum(screen[..., 2], viewpoint.near)  # linear on the screen
    # barycentric coordinates of a pixel: weights[:, k] @ (x, y, 1)
    first, second = np.roll(screen, -1, axis=1), np.roll(screen, -2, axis=1)  # next corners
    x1, y1 = first[..., 0], first[..., 1]
    x2, y2 = second[..., 0], second[..., 1]
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
    return Fragments(row, column, depth, points, unit(normals), colours, piece)


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
    """Write the index of the nearest triangle of each pixel; of equally near ones the first.

    face, nearest: index and inverse depth [1/m] of the visible triangle; modified.
    drawn: indices of the triangles to draw.
    planes, weights: coefficients of inverse depth and corner weights over a pixel's (x, y, 1).
    low, high: first pixel (x, y) of each triangle, and the pixel after its last.
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
    """Shadow map of a mesh."""

    def __init__(
        self, mesh: Mesh, sun: np.ndarray, side: int, distance: float = 40.0, bias: float = 0.025
    ) -> None:
        """Render the shadow map.

        Args:
            mesh: the mesh that casts the shadow.
            sun: unit vector (3,) towards the sun.
            side: width and height of the map [pixels].
            distance: distance of the map's camera from the mesh [m].
            bias: smallest distance of a shadowed point behind the surface that shadows it [m].
        """
        corners = mesh.corners if len(mesh.corners) else np.zeros((1, 3, 3))
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        self._middle = middle = 0.5 * (low + high)
        # parts farther than 2.6 m from the middle cast no shadow
        self._radius = float(np.clip(0.5 * np.linalg.norm(high - low), 1e-3, 2.6))
        angle = 2.0 * float(np.arctan(self._radius / distance))
        self._from_sun = Viewpoint(tuple(middle + distance * sun), tuple(middle), angle)
        view = rasterise(mesh, self._from_sun, (side, side))
        self._blocked = np.full((side, side), np.inf)
        self._blocked[view.at] = view.depth + bias

    def lit(self, points: np.ndarray) -> np.ndarray:
        """Share (k,) of the sunlight that reaches points (k, 3) [m]."""
        shape, share = self._blocked.shape, np.ones(len(points))
        across = np.abs((points - self._middle) @ self._from_sun.axes[:2].T)
        near = np.flatnonzero((across < 1.2 * self._radius).all(axis=1))
        column, row, depth = self._from_sun.screen(points[near], shape).T
        total = np.zeros(len(near))
        for i, j in np.ndindex(3, 3):  # the mean over 3 x 3 pixels softens the edges
            rows = np.clip((row + i - 0.5).astype(int), 0, shape[0] - 1)
            columns = np.clip((column + j - 0.5).astype(int), 0, shape[0] - 1)
            total += depth < self._blocked[rows, columns]
        share[near] = total / 9.0
        return share


class Layer(NamedTuple):
    """A translucent surface with its shaded colours."""

    view: Fragments
    opacity: float
    behind: float  # opacity where a solid surface is in front of it


class Renderer:
    """Renders pictures of a static scene from one viewpoint; the scene is rendered only once."""

    def __init__(
        self,
        still: Mesh,
        ground: float | None,
        viewpoint: Viewpoint,
        size: tuple[int, int],
        samples: int = 2,
    ) -> None:
        """Render the scene.

        Args:
            still: the static scene.
            ground: height of a floor [m]; None: no floor.
            viewpoint: the camera.
            size: width and height of pictures [pixels].
            samples: a pixel of a picture is the mean of samples x samples subpixels.
        """
        self.viewpoint, self._samples = viewpoint, samples
        self._shape = shape = (samples * size[1], samples * size[0])
        self._side = min(1536, 2 * max(shape))
        self._shadow = Shadow(still, viewpoint.sun, self._side)
        self._depth, self._piece = np.full(shape, np.inf), np.full(shape, -1)
        self._points = np.zeros((*shape, 3), np.float32)
        # colours without sun, and the colours that the sun adds
        self._shade = np.ones((*shape, 3), np.float32)
        self._sunny = np.zeros((*shape, 3), np.float32)
        view = rasterise(still, viewpoint, shape)
        self._depth[view.at], self._piece[view.at] = view.depth, view.piece
        self._lay(view)
        if ground is not None:
            self._lay_ground(ground)

    def layer(self, mesh: Mesh, opacity: float, behind: float = 0.0) -> Layer:
        """Layer of a translucent mesh.

        Args:
            mesh: the mesh.
            opacity: opacity in [0, 1].
            behind: opacity where a solid surface is in front of it.
        """
        view = rasterise(mesh, self.viewpoint, self._shape)
        return Layer(view._replace(colours=np.add(*self._lit(view))), opacity, behind)

    def image(
        self, moving: Mesh, layers: Sequence[Layer] = (), outline: float = 0.55
    ) -> np.ndarray:
        """Image (height, width, 3), 8 bit, of scene and moving mesh, with layers over both.

        Args:
            moving: mesh of the moving bodies.
            layers: translucent layers, blended in this order.
            outline: factor on the brightness at outlines of pieces.
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
        depths = [depth]  # of solid surfaces, then of translucent layers
        for layer in layers:
            _blend(image, depths, layer)
        rows, columns = (side // self._samples for side in self._shape)
        blocks = image.reshape(rows, self._samples, columns, self._samples, 3)
        return (255.0 * np.clip(blocks.mean(axis=(1, 3)), 0.0, 1.0) + 0.5).astype(np.uint8)

    def _lit(self, view: Fragments, *shadows: Shadow) -> tuple[np.ndarray, np.ndarray]:
        """Colours (k, 3) of a surface without sun, and the colours that the sun adds."""
        sky, sun = self.viewpoint.light(view.normals)
        sun = np.min([sun, *(sun * shadow.lit(view.points) for shadow in shadows)], axis=0)
        return sky[:, None] * view.colours, sun[:, None] * view.colours

    def _lay(self, view: Fragments) -> None:
        """Store the shaded fragments of a static surface."""
        self._points[view.at] = view.points
        self._shade[view.at], self._sunny[view.at] = self._lit(view, self._shadow)

    def _lay_ground(self, height: float, colour: Colour = (0.88, 0.87, 0.85)) -> None:
        """Fill empty pixels with the plane z = height [m], which fades into white with distance."""
        row, column = np.nonzero(self._piece < 0)
        rays = self.viewpoint.rays(row, column, self._shape)
        depth = (height - self.viewpoint.eye[2]) / np.where(rays[:, 2] == 0.0, np.inf, rays[:, 2])
        points = self.viewpoint.eye + depth[:, None] * rays
        away = np.linalg.norm(points - self.viewpoint.target, axis=1)
        distance = np.linalg.norm(np.subtract(self.viewpoint.eye, self.viewpoint.target))
        share = np.clip(1.6 - 1.2 * away / distance, 0.0, 1.0) * (depth > 0.0)
        upwards, colours = np.tile([0.0, 0.0, 1.0], (len(row), 1)), np.outer(share, colour)
        self._lay(Fragments(row, column, depth, points, upwards, colours, row))
        self._shade[row, column] += (1.0 - share)[:, None]


def _blend(
    image: np.ndarray, depths: list[np.ndarray], layer: Layer, coincide: float = 0.01
) -> None:
    """Blend a layer over an image.

    A translucent layer is left out where it coincides with a solid surface or an earlier layer.

    Args:
        image: (rows, columns, 3), modified.
        depths: depths (rows, columns) [m] of solid surfaces and earlier layers; the depth of a
            translucent layer is appended.
        layer: the layer.
        coincide: surfaces coincide up to this depth difference [m].
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
    """Choose a viewpoint from which a motion fills the picture and its parts are visible.

    Args:
        parts: meshes of the parts of the motion.
        scene: mesh that may hide them.
        size: width and height of the picture [pixels].
        inside: further meshes that must be within the picture, even if they are hidden.
        torso: mesh of a torso with two arms; if it is not empty, views from its front come first.
        azimuths: directions from the motion to the eye, in the order of trial [deg].
        enough: directions are tried until this share of the motion is visible.
        gain: smallest increase of the visible share for which another direction is taken.
        rows: height of the small pictures in which directions are compared [pixels].
    """
    shape = (rows, round(rows * size[0] / size[1]))
    points = np.concatenate([part.corners.reshape(-1, 3) for part in (*parts, *inside)])
    tried, elevation = list(azimuths), 24.0
    still = [scene]
    if torso is not None and len(torso.corners):
        tried, elevation = [35.0, -35.0, *tried], 35.0
        still = [scene, torso]
    best, best_share = framed(points, size), -1.0
    for azimuth in tried:
        viewpoint = framed(points, size, azimuth, elevation)
        # visible share of each part, in front of the scene and of earlier parts
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
    """Viewpoint whose picture contains given points.

    Args:
        points: (m, 3) [m].
        size: width and height of the picture [pixels].
        azimuth: direction from the points to the eye about z [deg].
        elevation: angle of the eye above the horizontal plane [deg].
        context: distance of the eye, as a multiple of the one where they fill the picture.
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
