"""Noise-free depth images of convex solids by ray casting: depth and solid of every pixel.

Only outer sides of surfaces are visible, as with back-face culling: solids around the camera or
nearer than the near plane are not seen. The two lower cameras of the published set-up stand below
the floor and still see the kitchen.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from cvqmpt_lab.sensing.camera import Camera

NOTHING = -1  # in the place of a solid's index


Interval = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body; points, rays and normals are in its own frame."""

    T_world_solid: np.ndarray  # (4, 4) or (3, 4), its pose [m]
    corners: np.ndarray  # (n, 3), points whose convex hull holds it [m]
    # where rays (..., 3) from an eye (3,) enter and leave it [rays]; NaN or empty if they miss
    interval: Callable[[np.ndarray, np.ndarray], Interval]
    normals: Callable[[np.ndarray], np.ndarray]  # outward, of length 1, at points (m, 3) [m] on it


def cuboid(T: np.ndarray, half: np.ndarray) -> Solid:
    """A box at a pose, centred on its frame; half (3,) of each edge [m]."""

    def normals(points: np.ndarray) -> np.ndarray:
        # along the axis on which a point is farthest out
        along = np.argmax(np.abs(points) - half, axis=1)
        rows = np.arange(len(points))
        found = np.zeros_like(points)
        found[rows, along] = np.sign(points[rows, along])
        return found

    return Solid(T, _box_corners(half), partial(_between_planes, half), normals)


def ball(T: np.ndarray, radius: float) -> Solid:
    """A ball [m] at a pose."""
    return Solid(T, _box_corners(np.full(3, radius)), partial(_within_radius, radius), _unit)


def cylinder(T: np.ndarray, radius: float, half: float) -> Solid:
    """A cylinder at a pose, centred on its frame, axis along z; half of its height [m]."""

    def interval(eye: np.ndarray, rays: np.ndarray) -> Interval:
        side = _within_radius(radius, eye[:2], rays[..., :2])
        ends = _between_planes(np.array([half]), eye[2:], rays[..., 2:])
        return np.maximum(side[0], ends[0]), np.minimum(side[1], ends[1])

    def normals(points: np.ndarray) -> np.ndarray:
        # along the axis on the ends, away from the axis on the side
        on_end = np.abs(points[:, 2]) - half > np.linalg.norm(points[:, :2], axis=1) - radius
        return _unit(points * np.where(on_end[:, None], (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)))

    return Solid(T, _box_corners(np.array([radius, radius, half])), interval, normals)


def polytope(T: np.ndarray, planes: np.ndarray, vertices: np.ndarray) -> Solid:
    """The points x with n x + d <= 0 for the unit normal n and offset d of every plane.

    Args:
        T: (4, 4), its pose [m].
        planes: (f, 4), n and d of each [m].
        vertices: (n, 3) [m].
    """

    def interval(eye: np.ndarray, rays: np.ndarray) -> Interval:
        # one plane after the other, since all together would fill the memory
        enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
        heights = planes[:, :3] @ eye + planes[:, 3]
        for normal, height in zip(planes[:, :3], heights, strict=True):
            towards = rays @ normal
            cut = -height / towards
            np.maximum(enter, cut, out=enter, where=towards < 0.0)
            np.minimum(leave, cut, out=leave, where=towards > 0.0)
            if height > 0.0:
                leave[towards == 0.0] = -np.inf
        return enter, leave

    def normals(points: np.ndarray) -> np.ndarray:
        # of the plane that a point is nearest to
        return planes[np.argmax(points @ planes[:, :3].T + planes[:, 3], axis=1), :3]

    return Solid(T, vertices, interval, normals)


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
    # corners beside or behind the camera have no place in the image
    if z.min() < 1e-3:
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


def _between_planes(half: np.ndarray, eye: np.ndarray, rays: np.ndarray) -> Interval:
    """Interval of each ray (..., d) in which every coordinate lies between -half and half (d,)."""
    enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
    for low, high, along in zip(-half - eye, half - eye, np.moveaxis(rays, -1, 0), strict=True):
        one, other = low / along, high / along
        np.maximum(enter, np.minimum(one, other), out=enter)
        np.minimum(leave, np.maximum(one, other), out=leave)
    return enter, leave


def _within_radius(radius: float, eye: np.ndarray, rays: np.ndarray) -> Interval:
    """Interval of each ray (..., d) that lies less than `radius` from the origin."""
    a, b = np.einsum("...i,...i->...", rays, rays), rays @ eye
    c = eye @ eye - radius * radius
    root = np.sqrt(b * b - a * c)  # NaN for rays that miss, which then compare as false
    parallel = np.where(c <= 0.0, np.inf, np.nan)
    return np.where(a > 0.0, (-b - root) / a, -parallel), np.where(
        a > 0.0, (root - b) / a, parallel
    )
