"""Convex solids that rays meet: where they enter, and which way the surface faces there."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.sensing.camera import DepthCamera, Lens


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


# What a camera sees of solids, without any error: depths, and which solid at every pixel.
NOTHING = -1
"""In the place of a solid's index."""
_AHEAD = 1e-3
"""Corners must lie this far ahead of a camera for their rectangle in the image to be known [m]."""


@dataclass(frozen=True, eq=False)
class View:
    """A picture of solids."""

    camera: DepthCamera
    """From where."""
    lens: Lens
    """With what optics."""
    depth: np.ndarray
    """(height, width) [m], along the camera's axis at the centre of each pixel; inf where it sees nothing."""
    solid: np.ndarray
    """(height, width) int, index of the solid that is seen; `NOTHING` where none is."""

    @property
    def points(self) -> np.ndarray:
        """(m, 3), of all pixels that see something [m]."""
        return points_of(self.depth, self.camera, self.lens)


def points_of(depth: np.ndarray, camera: DepthCamera, lens: Lens) -> np.ndarray:
    """Points (m, 3) [m, world] of the pixels of a depth image (height, width) [m] that see something."""
    hit = np.isfinite(depth)
    return np.array(camera.eye) + depth[hit][:, None] * lens.rays(camera)[hit]


def view_of(solids: Sequence[Solid], camera: DepthCamera, lens: Lens) -> View:
    """Cast a ray through every pixel."""
    rays = lens.rays(camera)
    depth = np.full(rays.shape[:2], np.inf)
    nearest = np.full(rays.shape[:2], NOTHING)
    for index, item in enumerate(solids):
        T = item.T_world_solid
        for window in _windows(item, camera, lens):
            eye = (np.array(camera.eye) - T[:3, 3]) @ T[:3, :3]
            with np.errstate(divide="ignore", invalid="ignore"):
                enter, leave = item.interval(eye, rays[window] @ T[:3, :3])
            seen = (enter <= leave) & (enter >= lens.near) & (enter <= lens.far) & (enter < depth[window])
            depth[window][seen], nearest[window][seen] = enter[seen], index
    return View(camera, lens, depth, nearest)


def incidence(view: View, solids: Sequence[Solid]) -> np.ndarray:
    """Cosine (height, width) of the angle between each pixel's ray and the surface's normal; 0 where nothing is."""
    rays = view.lens.rays(view.camera)
    cosine = np.zeros(view.depth.shape)
    for index in np.unique(view.solid[view.solid != NOTHING]):
        T, here = solids[index].T_world_solid, view.solid == index
        towards = -rays[here]
        points = view.camera.eye - view.depth[here][:, None] * towards
        normals = solids[index].normals((points - T[:3, 3]) @ T[:3, :3]) @ T[:3, :3].T
        cosine[here] = np.einsum("pi,pi->p", normals, towards) / np.linalg.norm(towards, axis=1)
    return np.clip(cosine, 0.0, 1.0)


def _windows(item: Solid, camera: DepthCamera, lens: Lens) -> Iterator[tuple[slice, slice]]:
    """The rectangle of the image that a solid can be seen in, or none."""
    T = item.T_world_solid
    corners = item.corners @ T[:3, :3].T + T[:3, 3]
    right, up, ahead = camera.axes @ (corners - camera.eye).T
    if ahead.max() < lens.near or ahead.min() > lens.far:
        return
    if ahead.min() < _AHEAD:
        yield slice(0, lens.height), slice(0, lens.width)
        return
    wide, tall = lens.extent
    columns = 0.5 * lens.width * (1.0 + right / ahead / wide)
    rows = 0.5 * lens.height * (1.0 - up / ahead / tall)
    window = _pixels(rows, lens.height), _pixels(columns, lens.width)
    if all(span.start < span.stop for span in window):
        yield window


def _pixels(places: np.ndarray, count: int) -> slice:
    """Pixels of `count` in a row whose centres may lie between the least and the largest of some places."""
    return slice(max(0, math.floor(places.min() - 0.5)), min(count, math.ceil(places.max() + 0.5)))
