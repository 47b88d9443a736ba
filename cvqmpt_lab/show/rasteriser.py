"""Triangles to pixels: a z-buffer with sun, shadows and outlines, in numpy alone."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.show.meshes import Mesh, colour_of, unit

NEAR = 0.05  # [m] triangles closer to the camera than this are left out
LIGHT = np.array([-0.62, -0.42, 0.66])  # direction towards the sun, length 1
SUN_DISTANCE, SUN_ANGLE = 40.0, 0.13  # [m], [rad]: a far camera whose view is the shadow map
SHADOW_PIXELS = 1536  # side of the largest shadow map
SHADOW_BIAS = 0.025  # [m] a surface shadows only what lies this far behind it


@dataclass(frozen=True)
class Viewpoint:
    """Where a picture is taken from: a pinhole, z up."""

    eye: tuple[float, float, float] = (-1.7, -2.0, 1.75)
    """[m]."""
    target: tuple[float, float, float] = (0.4, -0.1, 0.5)
    """In the middle of the picture [m]."""
    height_angle: float = 0.64
    """Angle of view from the bottom to the top of the picture [rad]."""

    @property
    def axes(self) -> np.ndarray:
        """Directions right, down, forward: rows (3, 3)."""
        forward = unit(np.subtract(self.target, self.eye))
        right = unit(np.cross(forward, (0.0, 0.0, 1.0)))
        return np.array([right, np.cross(forward, right), forward])

    def screen(self, points: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Points (..., 3) [m] as (column, row [pixels], depth [m]) in a picture of (rows, columns)."""
        right, down, depth = np.moveaxis((points - self.eye) @ self.axes.T, -1, 0)
        scale = 0.5 * shape[0] / np.tan(0.5 * self.height_angle) / np.maximum(depth, NEAR)
        return np.stack([scale * right + 0.5 * shape[1], scale * down + 0.5 * shape[0], depth], axis=-1)

    def rays(self, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Directions (k, 3) through pixels; a point at depth d is eye + d * ray."""
        scale = 2.0 * np.tan(0.5 * self.height_angle) / shape[0]
        seen = [scale * (columns - 0.5 * shape[1]), scale * (rows - 0.5 * shape[0]), np.ones(len(rows))]
        return np.stack(seen, axis=1) @ self.axes


@dataclass(frozen=True, eq=False)
class View:
    """The pixels in which a mesh is seen."""

    rows: np.ndarray
    """(k,)."""
    columns: np.ndarray
    """(k,)."""
    face: np.ndarray
    """(k,), the triangle seen."""
    depth: np.ndarray
    """(k,) [m] along the picture's axis."""
    normals: np.ndarray
    """(k, 3), length 1."""


def rasterise(mesh: Mesh, viewpoint: Viewpoint, shape: tuple[int, int]) -> View:
    """What a camera sees of a mesh in a picture of (rows, columns): the nearest outside at each pixel."""
    screen = viewpoint.screen(mesh.corners, shape)
    nearness = 1.0 / np.maximum(screen[..., 2], NEAR)  # linear across a triangle on the screen, unlike depth
    weights, area = _corner_weights(screen[..., :2])
    planes = (nearness[..., None] * weights).sum(axis=1)
    low = np.maximum(np.ceil(screen[..., :2].min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(screen[..., :2].max(axis=1)) + 1, shape[::-1]).astype(int)
    drawn = (area < 0.0) & (low < high).all(axis=1) & (screen[..., 2] > NEAR).all(axis=1)
    face, nearest = np.full(shape, -1), np.zeros(shape)
    for f in np.flatnonzero(drawn):
        block = slice(low[f, 1], high[f, 1]), slice(low[f, 0], high[f, 0])
        y, x = np.ogrid[block]
        here = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2]
        inside = here > nearest[block]
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


def _corner_weights(screen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates of triangles (f, 3, 2): corner k's is [:, k] @ (x, y, 1); signed areas (f,)."""
    (x1, x2), (y1, y2) = ([np.roll(screen[..., axis], -s, axis=1) for s in (1, 2)] for axis in (0, 1))
    rows = np.stack([y1 - y2, x2 - x1, x1 * y2 - x2 * y1], axis=-1)
    area = rows[..., 2].sum(axis=1)
    return rows / np.where(np.abs(area) > 1e-9, area, np.inf)[:, None, None], area


def solid_image(
    mesh: Mesh, ground: float | None, viewpoint: Viewpoint, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (rows, columns, 3) and depth [m] of the mesh with shadows and outlines, over the ground."""
    lit = _shadows(mesh, min(SHADOW_PIXELS, 2 * max(shape)))
    view = rasterise(mesh, viewpoint, shape)
    at = view.rows, view.columns
    image, depth, piece = np.ones((*shape, 3)), np.full(shape, np.inf), np.full(shape, -1)
    depth[at], piece[at] = view.depth, mesh.piece[view.face]
    points = viewpoint.eye + view.depth[:, None] * viewpoint.rays(*at, shape)
    image[at] = shaded(mesh.colours[view.face], view.normals, lit(points))
    if ground is not None:
        _fill_ground(image, np.nonzero(piece < 0), ground, viewpoint, lit)
    outline = np.zeros(shape, dtype=bool)
    outline[:, 1:] |= piece[:, 1:] != piece[:, :-1]
    outline[1:] |= piece[1:] != piece[:-1]
    image[outline] *= 0.55
    return image, depth


def _fill_ground(
    image: np.ndarray,
    empty: tuple[np.ndarray, ...],
    ground: float,
    viewpoint: Viewpoint,
    lit: Callable[[np.ndarray], np.ndarray],
) -> None:
    """Paint the plane z = ground [m] at empty pixels (rows, columns); it fades into white with distance."""
    rows, columns = empty
    rays = viewpoint.rays(rows, columns, image.shape[:2])
    distance = (ground - viewpoint.eye[2]) / np.where(rays[:, 2] == 0.0, np.inf, rays[:, 2])
    points = viewpoint.eye + distance[:, None] * rays
    share = np.clip(1.6 - 0.4 * np.linalg.norm(points - viewpoint.target, axis=1), 0.0, 1.0) * (
        distance > 0.0
    )
    colours = shaded(np.array([colour_of("floor")]), np.array([[0.0, 0.0, 1.0]]), lit(points))
    image[rows, columns] += share[:, None] * (colours - 1.0)


def _shadows(mesh: Mesh, side: int) -> Callable[[np.ndarray], np.ndarray]:
    """A function from points (k, 3) to the share (k,) of sunlight that a mesh lets through; side: map size."""
    middle = 0.5 * (mesh.corners.min(axis=(0, 1)) + mesh.corners.max(axis=(0, 1)))
    sun = Viewpoint(tuple(middle + SUN_DISTANCE * LIGHT), tuple(middle), SUN_ANGLE)
    shape = (side, side)
    view = rasterise(mesh, sun, shape)
    blocked = np.full(shape, np.inf)
    blocked[view.rows, view.columns] = view.depth + SHADOW_BIAS

    def lit(points: np.ndarray) -> np.ndarray:
        column, row, depth = np.moveaxis(sun.screen(points, shape), -1, 0)
        total = np.zeros(len(points))
        for i, j in np.ndindex(3, 3):
            at = tuple(np.clip((a + b - 0.5).astype(int), 0, side - 1) for a, b in ((row, i), (column, j)))
            total += depth < blocked[at]
        return total / 9.0

    return lit


def shaded(colours: np.ndarray, normals: np.ndarray, lit: np.ndarray | float = 1.0) -> np.ndarray:
    """Colours (k, 3) under light from the sky and, to the share lit (k,), from the sun."""
    strength = 0.58 + 0.1 * normals[:, 2] + 0.46 * lit * np.maximum(normals @ LIGHT, 0.0)
    return colours * strength[:, None]
