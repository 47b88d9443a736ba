"""Noise-free depth images of convex solids by ray casting: depth and seen solid of every pixel.

Only outer sides of surfaces are visible, as with back-face culling: a ray ignores a solid that
contains the camera, or that the ray enters before the near plane. So the two lower cameras of the
published set-up see the kitchen although they stand below the floor.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from cvqmpt_lab.sensing.camera import Camera

NOTHING = -1  # index of pixels that see no solid

# (...,) each: t at which rays eye + t ray enter and leave a solid
Interval = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body; points, rays and normals are in its own frame."""

    T_world_solid: np.ndarray  # (4, 4) or (3, 4), its pose [m]
    corners: np.ndarray  # (n, 3), points whose convex hull contains it [m]
    # of an eye (3,) [m] and rays (..., 3); rays that miss have enter > leave or NaN
    interval: Callable[[np.ndarray, np.ndarray], Interval]
    normals: Callable[[np.ndarray], np.ndarray]  # outward, of length 1, at points (m, 3) [m] on it


def cuboid(T: np.ndarray, half: np.ndarray) -> Solid:
    """A box centred at pose T (4, 4); half (3,): half of each edge [m]."""

    def normals(points: np.ndarray) -> np.ndarray:
        # the axis of the face that the point is on
        along = np.argmax(np.abs(points) - half, axis=1)
        rows = np.arange(len(points))
        found = np.zeros_like(points)
        found[rows, along] = np.sign(points[rows, along])
        return found

    return Solid(T, _box_corners(half), partial(_between_planes, half), normals)


def ball(T: np.ndarray, radius: float) -> Solid:
    """A ball of a radius [m] centred at pose T (4, 4)."""
    return Solid(T, _box_corners(np.full(3, radius)), partial(_within_radius, radius), _unit)


def cylinder(T: np.ndarray, radius: float, half: float) -> Solid:
    """A cylinder centred at pose T (4, 4), axis along z; its radius and half its height [m]."""

    def interval(eye: np.ndarray, rays: np.ndarray) -> Interval:
        side = _within_radius(radius, eye[:2], rays[..., :2])
        ends = _between_planes(np.array([half]), eye[2:], rays[..., 2:])
        return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])

    def normals(points: np.ndarray) -> np.ndarray:
        # parallel to the cylinder's axis on its flat ends, radial on its side
        on_end = np.abs(points[:, 2]) - half > np.linalg.norm(points[:, :2], axis=1) - radius
        return _unit(points * np.where(on_end[:, None], (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)))

    return Solid(T, _box_corners(np.array([radius, radius, half])), interval, normals)


def polytope(T: np.ndarray, planes: np.ndarray, vertices: np.ndarray) -> Solid:
    """The points x with n x + d <= 0 for the unit normal n and offset d of every plane.

    Args:
        T: (4, 4), its pose [m].
        planes: (f, 4), n and d [m] of each.
        vertices: (v, 3), its corners [m].
    """

    def interval(eye: np.ndarray, rays: np.ndarray) -> Interval:
        # plane by plane, since an array for all planes at once could exceed the memory
        enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
        heights = planes[:, :3] @ eye + planes[:, 3]
        for normal, height in zip(planes[:, :3], heights, strict=True):
            towards = rays @ normal
            cut = -height / towards  # t at which the ray crosses the plane
            np.maximum(enter, cut, out=enter, where=towards < 0.0)
            np.minimum(leave, cut, out=leave, where=towards > 0.0)
            if height > 0.0:
                # these rays are parallel to the plane and stay on its outer side
                leave[towards == 0.0] = -np.inf
        return enter, leave

    def normals(points: np.ndarray) -> np.ndarray:
        # normal of the plane that is nearest to each point
        return planes[np.argmax(points @ planes[:, :3].T + planes[:, 3], axis=1), :3]

    return Solid(T, vertices, interval, normals)


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


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _between_planes(half: np.ndarray, eye: np.ndarray, rays: np.ndarray) -> Interval:
    """Interval of rays (..., d) from eye (d,) with all coordinates between -half and half (d,)."""
    enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
    for low, high, along in zip(-half - eye, half - eye, np.moveaxis(rays, -1, 0), strict=True):
        one, other = low / along, high / along
        np.maximum(enter, np.minimum(one, other), out=enter)
        np.minimum(leave, np.maximum(one, other), out=leave)
    return enter, leave


def _within_radius(radius: float, eye: np.ndarray, rays: np.ndarray) -> Interval:
    """Interval of rays (..., d) from eye (d,) within `radius` of the origin.

    |eye + t ray|^2 = radius^2 is a t^2 + 2 b t + c = 0.
    """
    a, b = np.einsum("...i,...i->...", rays, rays), rays @ eye
    c = eye @ eye - radius * radius
    root = np.sqrt(b * b - a * c)  # NaN for rays that miss: comparisons with NaN are false
    # a = 0: the ray is parallel to a cylinder's axis, all of it inside (c <= 0) or none of it
    parallel = np.where(c <= 0.0, np.inf, np.nan)
    return np.where(a > 0.0, (-b - root) / a, -parallel), np.where(
        a > 0.0, (root - b) / a, parallel
    )
