"""Triangles to pixels: a viewpoint and a z-buffer, in numpy alone."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.show.meshes import Mesh, unit

NEAR = 0.05  # [m] triangles closer to the camera than this are left out
SUN_LEFT, SUN_ELEVATION = 0.14, 0.722  # [rad] where the sun stands, seen from the target: left of the eye


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

    @property
    def sun(self) -> np.ndarray:
        """Direction (3,) towards the sun, which stands behind the viewer."""
        azimuth = np.arctan2(self.eye[1] - self.target[1], self.eye[0] - self.target[0]) - SUN_LEFT
        across = np.cos(SUN_ELEVATION)
        return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(SUN_ELEVATION)])

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
    row, column = np.arange(shape[0])[:, None], np.arange(shape[1])
    for f in np.flatnonzero(drawn):
        block = slice(low[f, 1], high[f, 1]), slice(low[f, 0], high[f, 0])
        y, x = row[block[0]], column[block[1]]
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
