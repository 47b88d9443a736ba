"""Convex solids that rays meet: where they enter, and which way the surface faces there."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Solid(ABC):
    """A convex body; its methods speak of its own frame."""

    T_world_solid: np.ndarray
    """(4, 4) or (3, 4), its pose [m]."""

    @property
    @abstractmethod
    def corners(self) -> np.ndarray:
        """Points (n, 3) [m] whose convex hull holds the solid."""

    @abstractmethod
    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where along each ray (..., 3) from eye (3,) it enters and leaves the solid [rays]; NaN or empty if never."""

    @abstractmethod
    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward unit normals (m, 3) at points (m, 3) [m] of its surface."""


@dataclass(frozen=True, eq=False)
class Cuboid(Solid):
    """Centred on its frame, edges along the axes."""

    half: np.ndarray
    """(3,) half of each edge [m]."""

    @property
    def corners(self) -> np.ndarray:
        """Its eight."""
        return _box_corners(self.half)

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Between three pairs of planes."""
        return _between_planes(eye, rays, self.half)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Along the axis on which a point lies farthest out."""
        along = np.argmax(np.abs(points) - self.half, axis=1)
        rows = np.arange(len(points))
        found = np.zeros_like(points)
        found[rows, along] = np.sign(points[rows, along])
        return found


@dataclass(frozen=True, eq=False)
class Ball(Solid):
    """Centred on its frame."""

    radius: float
    """[m]."""

    @property
    def corners(self) -> np.ndarray:
        """Of the cube around it."""
        return _box_corners(np.full(3, self.radius))

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Within its radius."""
        return _within_radius(eye, rays, self.radius)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Away from the centre."""
        return _unit(points)


@dataclass(frozen=True, eq=False)
class Drum(Solid):
    """A cylinder centred on its frame, axis along z."""

    radius: float
    """[m]."""
    half: float
    """Half of its height [m]."""

    @property
    def corners(self) -> np.ndarray:
        """Of the box around it."""
        return _box_corners(np.array([self.radius, self.radius, self.half]))

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Within its radius and between its ends."""
        side = _within_radius(eye[:2], rays[..., :2], self.radius)
        ends = _between_planes(eye[2:], rays[..., 2:], np.array([self.half]))
        return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Along the axis on its ends, away from the axis on its side."""
        on_end = np.abs(points[:, 2]) - self.half > np.linalg.norm(points[:, :2], axis=1) - self.radius
        found = points * np.where(on_end[:, None], (0.0, 0.0, 1.0), (1.0, 1.0, 0.0))
        return _unit(found)


@dataclass(frozen=True, eq=False)
class Polytope(Solid):
    """Within some planes."""

    planes: np.ndarray
    """(f, 4): outward unit normal n and offset d of each; n x + d <= 0 inside [m]."""
    vertices: np.ndarray
    """(n, 3) [m]."""

    @property
    def corners(self) -> np.ndarray:
        """Its vertices."""
        return self.vertices

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Behind all of its planes, taken one by one: together they would fill the memory."""
        enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
        for normal, height in zip(
            self.planes[:, :3], self.planes[:, :3] @ eye + self.planes[:, 3], strict=True
        ):
            towards = rays @ normal
            cut = -height / towards
            np.maximum(enter, cut, out=enter, where=towards < 0.0)
            np.minimum(leave, cut, out=leave, where=towards > 0.0)
            if height > 0.0:
                leave[towards == 0.0] = -np.inf
        return enter, leave

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Of the plane that a point is nearest to."""
        nearest = np.argmax(points @ self.planes[:, :3].T + self.planes[:, 3], axis=1)
        return self.planes[nearest, :3]


def _box_corners(half: np.ndarray) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return signs * half


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _between_planes(eye: np.ndarray, rays: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interval of each ray (..., d) in which every coordinate lies between -half and half (d,)."""
    enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
    for low, high, along in zip(-half - eye, half - eye, np.moveaxis(rays, -1, 0), strict=True):
        one, other = low / along, high / along
        np.maximum(enter, np.minimum(one, other), out=enter)
        np.minimum(leave, np.maximum(one, other), out=leave)
    return enter, leave


def _within_radius(eye: np.ndarray, rays: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Interval of each ray (..., d) that lies less than radius from the origin of its d coordinates."""
    a, b = np.einsum("...i,...i->...", rays, rays), rays @ eye
    c = eye @ eye - radius * radius
    root = np.sqrt(b * b - a * c)  # NaN for rays that miss, which then compare as false
    parallel = np.where(c <= 0.0, np.inf, np.nan)
    return np.where(a > 0.0, (-b - root) / a, -parallel), np.where(a > 0.0, (root - b) / a, parallel)
