"""Point clouds of scenes from virtual depth cameras: the input of learned planners."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np

from cvqmpt_lab.base.caches import LruCache, cached_arrays, sources_digest
from cvqmpt_lab.base.codec import Checked, to_plain
from cvqmpt_lab.base.errors import InvalidInputError, whole_number
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.base.values import Condition, FloatArray, Length, Padding, frozen
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cells import seen_points
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Measured, Sphere
from cvqmpt_lab.sensing.camera import (
    Camera,
    DepthNoise,
    Intrinsics,
    Solid,
    View,
    ball,
    cameras_on_sphere,
    cuboid,
    cylinder,
    drawn_materials,
    measured,
    view_of,
)
from cvqmpt_lab.sensing.crop import Crop, voxel_means


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraSettings(Checked):
    """Virtual cameras, and how their points become a cloud; defaults: as published."""

    cameras: tuple[Camera, ...] = cameras_on_sphere(
        Intrinsics.from_fov(), (135.0, -135.0), (40.0, -40.0)
    )
    """Default: cameras of the published kitchen clouds."""
    obstacles_only: bool = False  # leave out objects that are not obstacles, such as the floor
    crop: Crop = field(default_factory=lambda: Crop(kind="box"))  # region of the points that stay
    voxel: Length | None = 0.025  # edge of cells in which points are averaged [m]; None: no cells
    noise: Padding = 0.0  # standard deviation of noise added to every coordinate of the cloud [m]
    errors: DepthNoise | None = None  # errors of the depth images; None: exact depths
    # number of points, chosen at random and repeated if there are too few; None: all points
    points: Annotated[int, Condition(int, {"minimum": 1}, "1 or more")] | None = None

    @classmethod
    def like_training(cls, points: int = 1024, noise: float = 0.003) -> "CameraSettings":
        """Return settings for clouds as in training: cameras on all sides, no floor.

        Unlike training clouds they lack surfaces that no camera sees, e.g. inside closed cabinets.

        Args:
            points: number of points of the cloud.
            noise: standard deviation of noise added to every coordinate [m].
        """
        intrinsics = Intrinsics.from_fov(vertical_fov=70.0, near=0.1)
        crop = Crop()
        cameras = cameras_on_sphere(
            intrinsics, (45.0, 135.0, -45.0, -135.0), (40.0, -40.0), centre=crop.centre
        )
        return cls(cameras=cameras, obstacles_only=True, crop=crop, noise=noise, points=points)


def camera_cloud(scene: Scene, settings: CameraSettings, rng: np.random.Generator) -> FloatArray:
    """Return points (m, 3) [m, robot base frame] that the cameras see, in random order, m >= 0.

    InvalidInputError: an object of the scene is a point cloud.
    """
    return thinned(visible_points(scene, settings, rng), settings, rng)


def thinned(points: FloatArray, settings: CameraSettings, rng: np.random.Generator) -> FloatArray:
    """Average points in voxels, shuffle them, choose `settings.points` of them, add noise.

    The order is random because the point encoder uses the neighbours of lowest index if there are
    too many.

    Args:
        points: (p, 3) [m].
        settings: its `voxel`, `points` and `noise` are used.
        rng: random numbers for order and noise.

    Returns:
        (m, 3) [m], with m = `settings.points` if that is set and p > 0.
    """
    if settings.voxel is not None:
        points = voxel_means(points, settings.voxel)
    points = points[rng.permutation(len(points))]
    if settings.points is not None and len(points):
        # points are repeated from the first one
        points = points[np.arange(settings.points) % len(points)]
    if settings.noise > 0.0:
        points = points + settings.noise * rng.standard_normal(points.shape)
    return points


def visible_points(scene: Scene, settings: CameraSettings, rng: np.random.Generator) -> FloatArray:
    """Return points (m, 3) [m, robot base frame] of all cameras' pixels inside the crop."""
    seen = [view.points for view in views_of(scene, settings, rng)]
    points = np.concatenate([np.empty((0, 3)), *seen])
    return points[settings.crop.contains(points)]


def views_of(scene: Scene, settings: CameraSettings, rng: np.random.Generator) -> list[View]:
    """Return the depth image of each camera, with measurement errors if `settings.errors` is set.

    An object has the same material in all images.
    """
    solids = solids_of(scene.obstacles if settings.obstacles_only else scene.objects)
    views = [view_of(solids, camera) for camera in settings.cameras]
    if settings.errors is None:
        return views
    materials = drawn_materials(len(solids), rng)
    return [measured(view, solids, materials, settings.errors, rng) for view in views]


def solids_of(objects: Sequence[SceneObject]) -> list[Solid]:
    """Return scene objects as solids for cameras; InvalidInputError names a measured object."""
    return [_solid(item) for item in objects]


def _solid(item: SceneObject) -> Solid:
    T = item.T_world_object
    match item.shape:
        case Box():
            return cuboid(T, item.shape.half)
        case Sphere(radius):
            return ball(T, radius)
        case Cylinder(radius, height):
            return cylinder(T, radius, 0.5 * height)
        case ConvexMesh(vertices):
            from scipy.spatial import ConvexHull  # a third of a second to import

            # rounding makes the planes of coplanar triangles equal
            planes = ConvexHull(vertices).equations.round(12)
            return Solid(T, vertices, np.unique(planes, axis=0))
    raise InvalidInputError(
        f"cameras cannot see object {item.name!r}, a {type(item.shape).__name__}: use its points "
        "as the cloud"
    )


def arm_objects(robot: Robot, q: FloatArray) -> tuple[SceneObject, ...]:
    """Return the convex hulls of the robot's links at q (n,) [rad or m] as scene objects."""
    rotations, translations = link_poses(
        robot.kinematics, np.ascontiguousarray(q, dtype=float)[None]
    )
    T_world_link = [rigid(R, t) for R, t in zip(rotations[0], translations[0], strict=True)]
    return tuple(
        SceneObject(
            f"robot/{piece.name}",
            ConvexMesh(piece.vertices),
            T_world_link[piece.link] @ piece.T_link_geometry,
        )
        for piece in robot.links
    )


class Observer:
    """Function from a scene to its cloud, deterministic; by default like training clouds.

    Virtual cameras render the shapes; clouds and occupancy maps are used unchanged. Rendering takes
    half a second, so the last `scenes` clouds are kept in memory and rendered clouds also in the
    user's cache on disk.
    """

    def __init__(
        self, settings: CameraSettings | None = None, seed: int = 0, scenes: int = 8
    ) -> None:
        whole_number("scenes kept by an observer", scenes, 1)
        whole_number("seed", seed)
        self.settings = CameraSettings.like_training() if settings is None else settings
        self.seed = seed
        self._clouds = LruCache[np.ndarray](scenes)

    def __call__(self, scene: Scene) -> np.ndarray:
        """Return the cloud (m, 3) [m] of a scene, read-only."""
        return self._clouds.get(scene, lambda: self._observe(scene))

    def of_points(self, points: np.ndarray) -> np.ndarray:
        """Return the cloud (m, 3) of points (p, 3) [m, base frame]; the crop must contain some."""
        crop = self.settings.crop
        near = points[crop.contains(points)]
        if len(near) == 0:
            raise InvalidInputError(
                f"none of the cloud's {len(points)} points is in the region of the training "
                f"clouds, {crop}: give the cloud in metres, in the frame of the robot's base"
            )
        # measured points are noisy already
        without_noise = replace(self.settings, noise=0.0)
        cloud = thinned(near, without_noise, np.random.default_rng(self.seed))
        return frozen(cloud)

    def _observe(self, scene: Scene) -> np.ndarray:
        clouds = [item for item in scene.objects if isinstance(item.shape, Measured)]
        if clouds:
            rest = scene.without(*(item.name for item in clouds))
            seen = visible_points(rest, self.settings, np.random.default_rng(self.seed))
            world = [
                seen_points(item.shape) @ item.T_world_object[:3, :3].T + item.T_world_object[:3, 3]
                for item in clouds
                if isinstance(item.shape, Measured)
            ]
            return self.of_points(np.concatenate([*world, seen]))
        rng = np.random.default_rng(self.seed)
        cameras = [
            (each.intrinsics, each.T_world_camera.tolist()) for each in self.settings.cameras
        ]
        settings = replace(self.settings, cameras=())
        made_of = f"{_sources()} {cameras} {settings} {self.seed} {json.dumps(to_plain(scene))}"
        cloud = cached_arrays(
            "clouds", made_of.encode(), lambda: {"cloud": camera_cloud(scene, self.settings, rng)}
        )["cloud"]
        # networks need two points: these are below the base
        if len(cloud) < 2:
            cloud = np.concatenate([cloud, [[0.0, -0.1, -0.8], [0.0, 0.1, -0.8]]])
        return frozen(cloud)


@cache
def _sources() -> str:
    """Return a digest of the source code that renders clouds."""
    library = Path(__file__).parents[1]
    return f"{sources_digest(library / 'sensing', library / 'scene')} {np.__version__}"
