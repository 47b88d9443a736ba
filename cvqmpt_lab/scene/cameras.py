"""Virtual depth cameras: point clouds of scenes by casting rays at shapes, in numpy.

Surfaces are seen from outside only. What a camera stands in, and what lies nearer than its near plane, it looks
through, as a renderer that leaves out back faces does: the two lower cameras of the published set-up stand
below the floor and see the kitchen all the same.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.rays import ray_interval, seen_corners
from cvqmpt_lab.scene.scene import Scene, SceneObject

_AHEAD = 1e-3
"""Corners must lie this far ahead of a camera for their rectangle in the image to be known [m]."""


@dataclass(frozen=True)
class BoxCrop:
    """Keeps points between two corners [m]; the published crop by default."""

    lower: tuple[float, float, float] = (-0.88, -0.88, -0.4)
    upper: tuple[float, float, float] = (0.88, 0.88, 1.2)

    def contains(self, points: FloatArray) -> np.ndarray:
        """Whether each of the points (m, 3) is kept."""
        return np.all((points >= self.lower) & (points <= self.upper), axis=1)


@dataclass(frozen=True)
class BallCrop:
    """Keeps points in a ball [m]; by default the one that training clouds are cut to."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.33)
    radius: float = 1.2

    def contains(self, points: FloatArray) -> np.ndarray:
        """Whether each of the points (m, 3) is kept."""
        return np.square(points - self.centre).sum(axis=1) <= self.radius**2


@dataclass(frozen=True)
class DepthCamera:
    """A virtual depth camera, upright."""

    eye: tuple[float, float, float]
    """Where it stands [m]."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What it looks at [m]; another point than `eye`."""

    def __post_init__(self) -> None:
        if not np.isfinite([*self.eye, *self.target]).all() or np.allclose(self.eye, self.target):
            raise InvalidInputError(f"camera at {self.eye} cannot look at {self.target}; give two points")

    @cached_property
    def axes(self) -> FloatArray:
        """(3, 3), rows: to the right, up, ahead."""
        ahead = np.subtract(self.target, self.eye)
        ahead = ahead / np.linalg.norm(ahead)
        upright = (0.0, 0.0, 1.0) if abs(ahead[2]) < 1.0 - 1e-9 else (1.0, 0.0, 0.0)
        right = np.cross(ahead, upright)
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(right, ahead), ahead])


def cameras_on_sphere(
    azimuths: tuple[float, ...],
    elevations: tuple[float, ...],
    radius: float = 2.0,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[DepthCamera, ...]:
    """Cameras at every pair of azimuth and elevation [deg], `radius` [m] from the point they look at."""
    cameras = []
    for elevation in np.radians(elevations):
        for azimuth in np.radians(azimuths):
            direction = (
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            )
            x, y, z = (float(c + radius * d) for c, d in zip(centre, direction, strict=True))
            cameras.append(DepthCamera((x, y, z), centre))
    return tuple(cameras)


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Where cameras stand and what becomes of what they see; defaults are the published kitchen's."""

    cameras: tuple[DepthCamera, ...] = field(
        default_factory=lambda: cameras_on_sphere((135.0, -135.0), (40.0, -40.0))
    )
    width: int = 224
    """Of each image [pixels]."""
    height: int = 224
    """Of each image [pixels]."""
    vertical_fov: float = 45.0
    """Angle of view from the bottom to the top of an image [deg]."""
    near: float = 1.0
    """Nearer surfaces are looked through [m]."""
    far: float = 5.1
    """Farther surfaces are not seen [m]."""
    obstacles_only: bool = False
    """Leave out what is no obstacle, such as the floor."""
    crop: BoxCrop | BallCrop = field(default_factory=BoxCrop)
    """What is kept of the merged points."""
    voxel: float | None = 0.025
    """Edge of the grid in whose cells points are averaged [m]; None to keep all."""
    noise: float = 0.0
    """Standard deviation added to every coordinate [m]."""
    points: int | None = None
    """Size of the cloud, drawn at random, repeated when there are fewer; None for what there is.

    Models that take the neighbours of lowest index need points in random order, which they always are.
    """

    def __post_init__(self) -> None:
        if min(self.width, self.height) < 1 or not 0.0 < self.vertical_fov < 180.0:
            raise InvalidInputError(
                f"image of {self.width} x {self.height} pixels, {self.vertical_fov} deg: give 1 or more pixels, "
                "an angle between 0 and 180"
            )
        if not 0.0 < self.near < self.far:
            raise InvalidInputError(f"camera depths {self.near} to {self.far} m: give 0 < near < far")
        if self.voxel is not None and not self.voxel > 0.0:
            raise InvalidInputError(f"voxel of {self.voxel} m: give more than 0, or None")
        if self.points is not None and self.points < 1:
            raise InvalidInputError(f"cloud of {self.points} points: give 1 or more, or None")
        if not self.noise >= 0.0:
            raise InvalidInputError(f"noise of {self.noise} m: give 0 or more")

    @classmethod
    def like_training(cls, points: int = 1024, noise: float = 0.003) -> "CameraSettings":
        """Clouds as like those of training as cameras can make them: what a trained model should be given.

        Training clouds cover surfaces evenly, on all sides of obstacles. So these cameras stand all around, see
        the whole ball of the crop, and no floor. What none of them sees (inside closed cabinets) stays unseen;
        training clouds show it.
        """
        crop = BallCrop()
        return cls(
            cameras=cameras_on_sphere((45.0, 135.0, -45.0, -135.0), (40.0, -40.0), centre=crop.centre),
            vertical_fov=70.0,
            near=0.1,
            obstacles_only=True,
            crop=crop,
            noise=noise,
            points=points,
        )


def camera_cloud(scene: Scene, settings: CameraSettings, rng: np.random.Generator) -> FloatArray:
    """Points (m, 3) [m, robot base frame] that the cameras see of a scene, in random order.

    Empty when they see nothing.

    Raises
    ------
    InvalidInputError
        If the scene has an object that is a point cloud already.
    """
    return thinned(visible_points(scene, settings), settings, rng)


def thinned(points: FloatArray, settings: CameraSettings, rng: np.random.Generator) -> FloatArray:
    """Of points (p, 3), voxel means, in random order, as many as the settings say, with their noise (m, 3)."""
    if settings.voxel is not None:
        points = voxel_means(points, settings.voxel)
    points = points[rng.permutation(len(points))]
    if settings.points is not None and len(points):
        points = points[np.arange(settings.points) % len(points)]
    if settings.noise > 0.0:
        points = points + settings.noise * rng.standard_normal(points.shape)
    return points


def visible_points(scene: Scene, settings: CameraSettings) -> FloatArray:
    """Points (m, 3) [m] of all pixels of all cameras inside the crop."""
    seen = []
    for camera in settings.cameras:
        depth = depth_image(scene, camera, settings)
        hit = np.isfinite(depth)
        seen.append(np.array(camera.eye) + depth[hit][:, None] * _rays(camera, settings)[hit])
    points = np.concatenate(seen) if seen else np.empty((0, 3))
    return points[settings.crop.contains(points)]


def voxel_means(points: FloatArray, voxel: float) -> FloatArray:
    """Mean (m, 3) of the points (p, 3) in each cell of a grid, in order of the cells.

    The least coordinates lie in the middle of their cells.
    """
    if len(points) == 0:
        return points
    cells = np.floor((points - points.min(axis=0)) / voxel + 0.5).astype(np.int64)
    key = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    _, cell, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, weights=axis, minlength=len(count)) for axis in points.T]
    return np.stack(sums, axis=1) / count[:, None]


def depth_image(scene: Scene, camera: DepthCamera, settings: CameraSettings) -> FloatArray:
    """Depth (height, width) [m] along the camera's axis at the centre of each pixel, inf where it sees nothing."""
    rays = _rays(camera, settings)
    depth = np.full(rays.shape[:2], np.inf)
    for item in scene.obstacles if settings.obstacles_only else scene.objects:
        for window in _windows(item, camera, settings):
            T = item.T_world_object
            eye = (np.array(camera.eye) - T[:3, 3]) @ T[:3, :3]
            with np.errstate(divide="ignore", invalid="ignore"):
                enter, leave = ray_interval(item.shape, eye, rays[window] @ T[:3, :3])
            seen = (enter <= leave) & (enter >= settings.near) & (enter <= settings.far)
            np.minimum(depth[window], np.where(seen, enter, np.inf), out=depth[window])
    return depth


def _rays(camera: DepthCamera, settings: CameraSettings) -> FloatArray:
    """Rays (height, width, 3) through the pixels' centres, of depth 1 m."""
    tall = math.tan(0.5 * math.radians(settings.vertical_fov))
    wide = tall * settings.width / settings.height
    x = wide * ((np.arange(settings.width) + 0.5) * 2.0 / settings.width - 1.0)
    y = tall * (1.0 - (np.arange(settings.height) + 0.5) * 2.0 / settings.height)
    right, up, ahead = camera.axes
    return ahead + y[:, None, None] * up + x[:, None] * right


def _windows(
    item: SceneObject, camera: DepthCamera, settings: CameraSettings
) -> Iterator[tuple[slice, slice]]:
    """The rectangle of the image that an object can be seen in, or none."""
    T = item.T_world_object
    corners = seen_corners(item.shape, item.name) @ T[:3, :3].T + T[:3, 3]
    right, up, ahead = camera.axes @ (corners - camera.eye).T
    if ahead.max() < settings.near or ahead.min() > settings.far:
        return
    if ahead.min() < _AHEAD:
        yield slice(0, settings.height), slice(0, settings.width)
        return
    tall = math.tan(0.5 * math.radians(settings.vertical_fov))
    wide = tall * settings.width / settings.height
    columns = 0.5 * settings.width * (1.0 + right / ahead / wide)
    rows = 0.5 * settings.height * (1.0 - up / ahead / tall)
    window = _pixels(rows, settings.height), _pixels(columns, settings.width)
    if all(span.start < span.stop for span in window):
        yield window


def _pixels(places: FloatArray, count: int) -> slice:
    """Pixels of `count` in a row whose centres may lie between the least and the largest of some places."""
    return slice(max(0, math.floor(places.min() - 0.5)), min(count, math.ceil(places.max() + 0.5)))
