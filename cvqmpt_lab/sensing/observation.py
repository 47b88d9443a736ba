"""Point clouds of scenes, as virtual depth cameras see them: what a learned planner gets."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.caches import LruCache, cached_arrays, sources_digest
from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.errors import InvalidInputError, whole_number
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.base.values import FloatArray, frozen
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
from cvqmpt_lab.sensing.scan import BallCrop, BoxCrop, voxel_means


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Virtual cameras, and how their points become a cloud; by default as published."""

    cameras: tuple[Camera, ...] = cameras_on_sphere(
        Intrinsics.from_fov(), (135.0, -135.0), (40.0, -40.0)
    )
    """Those of the published kitchen clouds."""
    obstacles_only: bool = False  # leave out objects that are no obstacles, such as the floor
    crop: BoxCrop | BallCrop = field(default_factory=BoxCrop)  # which points of all cameras stay
    voxel: float | None = 0.025  # [m] edge of cells in which points are averaged; None: no cells
    noise: float = 0.0  # [m] standard deviation of the noise of every coordinate of the cloud
    errors: DepthNoise | None = None  # of the depths of every camera; None: exact depths
    # size of the cloud: a random choice of its points, repeated if they are too few; None: all
    points: int | None = None

    def __post_init__(self) -> None:
        if self.voxel is not None and not self.voxel > 0.0:
            raise InvalidInputError(f"voxel of {self.voxel} m: give more than 0, or None")
        if self.points is not None and self.points < 1:
            raise InvalidInputError(f"cloud of {self.points} points: give 1 or more, or None")
        if not self.noise >= 0.0:
            raise InvalidInputError(f"noise of {self.noise} m: give 0 or more")

    @classmethod
    def like_training(cls, points: int = 1024, noise: float = 0.003) -> "CameraSettings":
        """Clouds like those of training: cameras on all sides, no floor, obstacles covered evenly.

        Unlike training clouds they lack what no camera sees, such as the inside of closed cabinets.

        Args:
            points: size of the cloud.
            noise: standard deviation of every coordinate [m].
        """
        intrinsics, crop = Intrinsics.from_fov(vertical_fov=70.0, near=0.1), BallCrop()
        cameras = cameras_on_sphere(
            intrinsics, (45.0, 135.0, -45.0, -135.0), (40.0, -40.0), centre=crop.centre
        )
        return cls(cameras=cameras, obstacles_only=True, crop=crop, noise=noise, points=points)


def camera_cloud(scene: Scene, settings: CameraSettings, rng: np.random.Generator) -> FloatArray:
    """Points (m, 3) [m, robot base frame] that the cameras see, in random order; m may be 0.

    InvalidInputError: an object of the scene is a point cloud.
    """
    return thinned(visible_points(scene, settings, rng), settings, rng)


def thinned(points: FloatArray, settings: CameraSettings, rng: np.random.Generator) -> FloatArray:
    """Average points in voxels, shuffle them, choose `settings.points` of them, add noise.

    The order is random because the point encoder takes, of too many neighbours, those of lowest
    index.

    Args:
        points: (p, 3) [m].
        settings: its `voxel`, `points` and `noise` are used.
        rng: of order and noise.

    Returns:
        (m, 3) [m], with m = `settings.points` if that is set and p > 0.
    """
    if settings.voxel is not None:
        points = voxel_means(points, settings.voxel)
    points = points[rng.permutation(len(points))]
    if settings.points is not None and len(points):
        # after the last point comes the first one again
        points = points[np.arange(settings.points) % len(points)]
    if settings.noise > 0.0:
        points = points + settings.noise * rng.standard_normal(points.shape)
    return points


def visible_points(scene: Scene, settings: CameraSettings, rng: np.random.Generator) -> FloatArray:
    """Points (m, 3) [m, robot base frame] of the pixels of all cameras, inside the crop."""
    seen = [view.points for view in views_of(scene, settings, rng)]
    points = np.concatenate([np.empty((0, 3)), *seen])
    return points[settings.crop.contains(points)]


def views_of(scene: Scene, settings: CameraSettings, rng: np.random.Generator) -> list[View]:
    """The depth image of each camera, with measurement errors if `settings.errors` is set.

    Each object has one material, the same in all images.
    """
    solids = solids_of(scene.obstacles if settings.obstacles_only else scene.objects)
    views = [view_of(solids, camera) for camera in settings.cameras]
    if settings.errors is None:
        return views
    materials = drawn_materials(len(solids), rng)
    return [measured(view, solids, materials, settings.errors, rng) for view in views]


def solids_of(objects: Sequence[SceneObject]) -> list[Solid]:
    """Scene objects as solids that cameras see; InvalidInputError names one that is a cloud."""
    return [_solid(item) for item in objects]


def _solid(item: SceneObject) -> Solid:
    T = item.T_world_object
    match item.shape:
        case Box(size):
            return cuboid(T, np.multiply(0.5, size))
        case Sphere(radius):
            return ball(T, radius)
        case Cylinder(radius, height):
            return cylinder(T, radius, 0.5 * height)
        case ConvexMesh(vertices):
            from scipy.spatial import ConvexHull  # a third of a second to import

            # rounded, so that the planes of coplanar triangles become equal
            planes = ConvexHull(vertices).equations.round(12)
            return Solid(T, vertices, np.unique(planes, axis=0))
    raise InvalidInputError(
        f"cameras cannot see object {item.name!r}, a {type(item.shape).__name__}: use its points "
        "as the cloud"
    )


def arm_objects(robot: Robot, q: FloatArray) -> tuple[SceneObject, ...]:
    """Convex hulls of the robot's links at q (n,) [rad or m], as objects that cameras see."""
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
    """Makes the cloud of a scene, the same one every time; by default like training clouds.

    Virtual cameras see the shapes; clouds and occupancy maps are used as they are. Rendering takes
    half a second, so the last `scenes` clouds are cached, and rendered ones also in the user's disk
    cache.
    """

    def __init__(
        self, settings: CameraSettings | None = None, seed: int = 0, scenes: int = 8
    ) -> None:
        whole_number("scenes kept by an observer", scenes, 1)
        whole_number("seed", seed)
        self.settings = CameraSettings.like_training() if settings is None else settings
        self.seed, self._clouds = seed, LruCache[np.ndarray](scenes)

    def __call__(self, scene: Scene) -> np.ndarray:
        """The cloud (m, 3) [m] of a scene, not to be written to."""
        return self._clouds.get(scene, lambda: self._look(scene))

    def of_points(self, points: np.ndarray) -> np.ndarray:
        """Cloud (m, 3) of points (p, 3) [m, base frame]; InvalidInputError: none is in the crop."""
        crop = self.settings.crop
        near = points[crop.contains(points)]
        if len(near) == 0:
            raise InvalidInputError(
                f"none of the cloud's {len(points)} points is in the region that networks know, "
                f"{crop}: give it in metres, in the frame of the robot's base"
            )
        measured = replace(self.settings, noise=0.0)  # it has its own
        cloud = thinned(near, measured, np.random.default_rng(self.seed))
        return frozen(cloud)

    def _look(self, scene: Scene) -> np.ndarray:
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
        # networks need two points: under the base
        if len(cloud) < 2:
            cloud = np.concatenate([cloud, [[0.0, -0.1, -0.8], [0.0, 0.1, -0.8]]])
        return frozen(cloud)


@cache
def _sources() -> str:
    """Digest of what clouds are rendered by."""
    library = Path(__file__).parents[1]
    return f"{sources_digest(library / 'sensing', library / 'scene')} {np.__version__}"
