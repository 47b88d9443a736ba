"""Noise-free depth images of convex solids by ray casting: depth and seen solid of every pixel.

Only outer sides of surfaces are visible, as with back-face culling: a ray ignores a solid that
contains the camera, or that the ray enters before the near plane. So the two lower cameras of the
published set-up see the kitchen although they stand below the floor.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.sensing.camera import Camera

NOTHING = -1  # index of pixels that see no solid

# (...,) each: t at which rays eye + t ray enter and leave a solid
Interval = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body between planes, in a ball or in an endless cylinder, or several of these.

    It holds the points x of its frame with n x + d <= 0 for the unit normal n and offset d of every
    plane, whose first `round_axes` coordinates are within `radius` of the origin.
    """

    T_world_solid: np.ndarray  # (4, 4) or (3, 4), its pose [m]
    corners: np.ndarray  # (n, 3), points whose convex hull contains it [m]
    planes: np.ndarray  # (f, 4), n and d [m] of each
    radius: float = np.inf  # [m]
    round_axes: int = 0  # 3 for a ball, 2 for a cylinder along z, 0: it is not round

    def interval(self, eye: np.ndarray, rays: np.ndarray) -> Interval:
        """Interval of rays (..., 3) from an eye (3,) [m]; those that miss: enter > leave or NaN."""
        enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
        if self.round_axes:
            enter, leave = self._within_radius(eye[: self.round_axes], rays[..., : self.round_axes])
        # plane by plane, since an array for all planes at once could exceed the memory
        heights = self.planes[:, :3] @ eye + self.planes[:, 3]
        for normal, height in zip(self.planes[:, :3], heights, strict=True):
            towards = rays @ normal
            cut = -height / towards  # t at which the ray crosses the plane
            np.maximum(enter, cut, out=enter, where=towards < 0.0)
            np.minimum(leave, cut, out=leave, where=towards > 0.0)
            if height > 0.0:
                # these rays are parallel to the plane and stay on its outer side
                leave[towards == 0.0] = -np.inf
        return enter, leave

    def _within_radius(self, eye: np.ndarray, rays: np.ndarray) -> Interval:
        """Interval of rays (..., d) from eye (d,) within the radius.

        |eye + t ray|^2 = radius^2 is a t^2 + 2 b t + c = 0.
        """
        a, b = np.einsum("...i,...i->...", rays, rays), rays @ eye
        c = eye @ eye - self.radius * self.radius
        root = np.sqrt(b * b - a * c)  # NaN for rays that miss: comparisons with NaN are false
        # a = 0: the ray is parallel to a cylinder's axis, all of it inside (c <= 0) or none of it
        parallel = np.where(c <= 0.0, np.inf, np.nan)
        leave = np.where(a > 0.0, (root - b) / a, parallel)
        return np.where(a > 0.0, (-b - root) / a, -parallel), leave

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Outward normals (m, 3), of length 1, of the faces nearest to points (m, 3) [m] on it."""
        heights = points @ self.planes[:, :3].T + self.planes[:, 3]
        radial = points * (np.arange(3) < self.round_axes)
        away = np.linalg.norm(radial, axis=1, keepdims=True)
        nearest = np.argmax(np.hstack([heights, away - self.radius]), axis=1)
        directions = np.vstack([self.planes[:, :3], np.zeros(3)])[nearest]
        return np.where(
            (nearest == len(self.planes))[:, None], radial / np.maximum(away, 1e-12), directions
        )


def cuboid(T: np.ndarray, half: np.ndarray) -> Solid:
    """A box centred at pose T (4, 4); half (3,): half of each edge [m]."""
    planes = np.c_[np.vstack([np.eye(3), -np.eye(3)]), -np.tile(half, 2)]
    return Solid(T, _box_corners(half), planes)


def ball(T: np.ndarray, radius: float) -> Solid:
    """A ball of a radius [m] centred at pose T (4, 4)."""
    return Solid(T, _box_corners(np.full(3, radius)), np.empty((0, 4)), radius, 3)


def cylinder(T: np.ndarray, radius: float, half: float) -> Solid:
    """A cylinder centred at pose T (4, 4), axis along z; its radius and half its height [m]."""
    planes = np.array([[0.0, 0.0, 1.0, -half], [0.0, 0.0, -1.0, -half]])
    return Solid(T, _box_corners(np.array([radius, radius, half])), planes, radius, 2)


@dataclass(frozen=True, eq=False)
class View:
    """A depth image of solids."""

    camera: Camera
    depth: np.ndarray  # (height, width) [m], along the optical axis; inf where no solid is seen
    solid: np.ndarray  # (height, width) int, index of the solid seen, or `NOTHING`

    @property
    def points(self) -> np.ndarray:
        """Points (m, 3) [m, world] of all pixels that see a solid."""
        hit = np.isfinite(self.depth)
        return self.camera.eye + self.depth[hit][:, None] * self.camera.rays()[hit]


def view_of(solids: Sequence[Solid], camera: Camera) -> View:
    """Cast a ray through every pixel; seen is the nearest solid between the near and far plane."""
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
    """Cosine (height, width) between surface normal and direction to the camera; 0: no solid."""
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
    """Rows and columns of the pixels that may see a solid; None if the solid is out of view."""
    T, lens = item.T_world_solid, camera.intrinsics
    corners = item.corners @ T[:3, :3].T + T[:3, 3]
    x, y, z = camera.T_world_camera[:3, :3].T @ (corners - camera.eye).T
    if z.max() < lens.near or z.min() > lens.far:
        return None
    # corners beside or behind the camera have no projection, so all pixels are taken
    if z.min() < 1e-3:
        return slice(0, lens.height), slice(0, lens.width)
    rows = _pixels(lens.cy + lens.fy * y / z, lens.height)
    columns = _pixels(lens.cx + lens.fx * x / z, lens.width)
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


def _pixels(places: np.ndarray, count: int) -> slice:
    """The pixels, of 0 to count - 1, from the least to the greatest of `places` [pixels]."""
    return slice(max(0, math.floor(places.min())), min(count, math.ceil(places.max()) + 1))


def _box_corners(half: np.ndarray) -> np.ndarray:
    signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    return signs * half
