"""Noise-free depth images of convex solids by ray casting: depth and solid of every pixel.

Only outer sides of surfaces are visible, as with back-face culling: solids around the camera or
nearer than the near plane are not seen. The two lower cameras of the published set-up stand below
the floor and still see the kitchen.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.sensing.camera import Camera

NOTHING = -1  # in the place of a solid's index
AHEAD = 1e-3  # [m] least depth of corners that are projected to the image


@dataclass(frozen=True, eq=False)
class Solid(ABC):
    """A convex body; points, rays and normals are in its own frame."""

    T_world_solid: np.ndarray  # (4, 4) or (3, 4), its pose [m]

    @property
    @abstractmethod
    def corners(self) -> np.ndarray:
        """Points (n, 3) [m] whose convex hull holds the solid."""

    @abstractmethod
    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays (..., 3) from eye (3,) enter and leave [rays]; NaN or empty if they miss."""

    @abstractmethod
    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward unit normals (m, 3) at points (m, 3) [m] of its surface."""


@dataclass(frozen=True, eq=False)
class Cuboid(Solid):
    """A box centred on its frame, edges along the axes."""

    half: np.ndarray  # (3,) half of each edge [m]

    @property
    def corners(self) -> np.ndarray:
        """The eight corners."""
        return _box_corners(self.half)

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interval between its three pairs of planes."""
        return _between_planes(eye, rays, self.half)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Along the axis on which a point is farthest out."""
        along = np.argmax(np.abs(points) - self.half, axis=1)
        rows = np.arange(len(points))
        found = np.zeros_like(points)
        found[rows, along] = np.sign(points[rows, along])
        return found


@dataclass(frozen=True, eq=False)
class Ball(Solid):
    """A ball centred on its frame."""

    radius: float  # [m]

    @property
    def corners(self) -> np.ndarray:
        """Corners of the cube around it."""
        return _box_corners(np.full(3, self.radius))

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interval within its radius."""
        return _within_radius(eye, rays, self.radius)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Directions away from the centre."""
        return _unit(points)


@dataclass(frozen=True, eq=False)
class SolidCylinder(Solid):
    """A cylinder centred on its frame, axis along z."""

    radius: float  # [m]
    half: float  # half of its height [m]

    @property
    def corners(self) -> np.ndarray:
        """Corners of the box around it."""
        return _box_corners(np.array([self.radius, self.radius, self.half]))

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interval within its radius and between its ends."""
        side = _within_radius(eye[:2], rays[..., :2], self.radius)
        ends = _between_planes(eye[2:], rays[..., 2:], np.array([self.half]))
        return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Along the axis on its ends, away from the axis on its side."""
        on_end = (
            np.abs(points[:, 2]) - self.half > np.linalg.norm(points[:, :2], axis=1) - self.radius
        )
        return _unit(points * np.where(on_end[:, None], (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)))


@dataclass(frozen=True, eq=False)
class Polytope(Solid):
    """The points x with n x + d <= 0 for the unit normal n and offset d of every plane."""

    planes: np.ndarray  # (f, 4), n and d of each [m]
    vertices: np.ndarray  # (n, 3) [m]

    @property
    def corners(self) -> np.ndarray:
        """Its vertices."""
        return self.vertices

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interval behind all planes; one by one, since all together would fill the memory."""
        enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
        heights = self.planes[:, :3] @ eye + self.planes[:, 3]
        for normal, height in zip(self.planes[:, :3], heights, strict=True):
            towards = rays @ normal
            cut = -height / towards
            np.maximum(enter, cut, out=enter, where=towards < 0.0)
            np.minimum(leave, cut, out=leave, where=towards > 0.0)
            if height > 0.0:
                leave[towards == 0.0] = -np.inf
        return enter, leave

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Normal of the plane that a point is nearest to."""
        nearest = np.argmax(points @ self.planes[:, :3].T + self.planes[:, 3], axis=1)
        return self.planes[nearest, :3]


@dataclass(frozen=True, eq=False)
class View:
    """A depth image of solids."""

    camera: Camera
    depth: np.ndarray  # (height, width) [m], along the camera's axis; inf: nothing
    solid: np.ndarray  # (height, width) int, index of the solid seen, or `NOTHING`

    @property
    def points(self) -> np.ndarray:
        """Points (m, 3) [m, world] of all pixels that see something."""
        hit = np.isfinite(self.depth)
        return self.camera.eye + self.depth[hit][:, None] * self.camera.rays()[hit]


def view_of(solids: Sequence[Solid], camera: Camera) -> View:
    """Cast a ray through every pixel."""
    rays, lens = camera.rays(), camera.intrinsics
    depth = np.full(rays.shape[:2], np.inf)
    nearest = np.full(rays.shape[:2], NOTHING)
    for index, item in enumerate(solids):
        window = _window(item, camera)
        if window is None:
            continue
        T = item.T_world_solid
        eye = (camera.eye - T[:3, 3]) @ T[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            enter, leave = item.interval(eye, rays[window] @ T[:3, :3])
        seen = (
            (enter <= leave) & (enter >= lens.near) & (enter <= lens.far) & (enter < depth[window])
        )
        depth[window][seen], nearest[window][seen] = enter[seen], index
    return View(camera, depth, nearest)


def incidence(view: View, solids: Sequence[Solid]) -> np.ndarray:
    """Cosine (height, width) between each pixel's ray and the surface normal; 0 without surface."""
    rays = view.camera.rays()
    cosine = np.zeros(view.depth.shape)
    for index in np.unique(view.solid[view.solid != NOTHING]):
        T, here = solids[index].T_world_solid, view.solid == index
        towards = -rays[here]
        points = view.camera.eye - view.depth[here][:, None] * towards
        normals = solids[index].normals((points - T[:3, 3]) @ T[:3, :3]) @ T[:3, :3].T
        cosine[here] = np.einsum("pi,pi->p", normals, towards) / np.linalg.norm(towards, axis=1)
    return np.clip(cosine, 0.0, 1.0)


def _window(item: Solid, camera: Camera) -> tuple[slice, slice] | None:
    """The rectangle of the image in which a solid can be seen, if any."""
    T, lens = item.T_world_solid, camera.intrinsics
    corners = item.corners @ T[:3, :3].T + T[:3, 3]
    x, y, z = camera.T_world_camera[:3, :3].T @ (corners - camera.eye).T
    if z.max() < lens.near or z.min() > lens.far:
        return None
    if z.min() < AHEAD:
        return slice(0, lens.height), slice(0, lens.width)
    rows = _pixels(lens.cy + lens.fy * y / z, lens.height)
    columns = _pixels(lens.cx + lens.fx * x / z, lens.width)
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


def _pixels(places: np.ndarray, count: int) -> slice:
    """Those of `count` pixels in a row whose centres may lie between extremes of `places`."""
    return slice(max(0, math.floor(places.min())), min(count, math.ceil(places.max()) + 1))


def _box_corners(half: np.ndarray) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return signs * half


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _between_planes(
    eye: np.ndarray, rays: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Interval of each ray (..., d) in which every coordinate lies between -half and half (d,)."""
    enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
    for low, high, along in zip(-half - eye, half - eye, np.moveaxis(rays, -1, 0), strict=True):
        one, other = low / along, high / along
        np.maximum(enter, np.minimum(one, other), out=enter)
        np.minimum(leave, np.maximum(one, other), out=leave)
    return enter, leave


def _within_radius(
    eye: np.ndarray, rays: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Interval of each ray (..., d) that lies less than `radius` from the origin."""
    a, b = np.einsum("...i,...i->...", rays, rays), rays @ eye
    c = eye @ eye - radius * radius
    root = np.sqrt(b * b - a * c)  # NaN for rays that miss, which then compare as false
    parallel = np.where(c <= 0.0, np.inf, np.nan)
    return np.where(a > 0.0, (-b - root) / a, -parallel), np.where(
        a > 0.0, (root - b) / a, parallel
    )
