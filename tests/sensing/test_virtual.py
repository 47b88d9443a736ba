"""Clouds of scenes by virtual cameras: the published cameras, those of training, wrong settings."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.families import random_scene
from cvqmpt_lab.benchmarks.place_task import CAN
from cvqmpt_lab.features.scan.scan import MapSettings, ScanSettings, occupancy_map, scan
from cvqmpt_lab.scene.cloud_files import Cloud
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import PointCloud, Sphere
from cvqmpt_lab.sensing.camera import Intrinsics, look_at
from cvqmpt_lab.sensing.crop import Crop, voxel_means
from cvqmpt_lab.sensing.observation import (
    CameraSettings,
    Observer,
    camera_cloud,
    visible_points,
)


def test_the_published_kitchen_cloud(open_kitchen):
    """Another renderer gave about 79 800 points in the crop and 8 500 voxels."""
    scene = open_kitchen.with_objects(CAN.at_com("can", (0.5646, 0.1152, 0.271)))
    settings = CameraSettings()
    eyes = np.array([camera.eye for camera in settings.cameras])
    np.testing.assert_allclose(np.abs(eyes), [[1.0834, 1.0834, 1.2856]] * 4, atol=1e-4)
    points = visible_points(scene, settings, np.random.default_rng(0))
    assert 79_000 < len(points) < 80_600 and Crop(kind="box").contains(points).all()
    cloud = camera_cloud(scene, settings, np.random.default_rng(0))
    assert 8_000 < len(cloud) < 9_200


def test_clouds_depend_on_the_seed_alone_and_have_the_given_number_of_points():
    scene = random_scene(5)
    settings = CameraSettings.like_training()
    one, same, other = (camera_cloud(scene, settings, np.random.default_rng(s)) for s in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert one.shape == other.shape == (1024, 3) and (one != other).any()
    steps = np.linalg.norm(np.diff(one, axis=0), axis=1)
    assert np.median(steps) > 0.4, "random order: models take the neighbours of lowest index"
    small = Scene("dot", (SceneObject("dot", Sphere(0.05), pose((0.3, 0.0, 0.3))),))
    repeated = camera_cloud(small, CameraSettings(points=700), np.random.default_rng(0))
    assert repeated.shape == (700, 3) and 5 < len(np.unique(repeated, axis=0)) < 100
    assert camera_cloud(Scene("empty", ()), settings, np.random.default_rng(0)).shape == (0, 3)


RNG = np.random.default_rng(0)
NOTHING = np.empty((0, 3))
CLOUD = Scene("s", (SceneObject("scan", PointCloud(np.eye(3), 0.01), np.eye(4)),))
ROOM = MapSettings(unknown="occupied", lower=(-0.5, -0.5, 0.0), upper=(1.0, 0.5, 0.8))
HUGE = replace(ROOM, resolution=1e-3, upper=(50.0, 50.0, 50.0))
CAPTURE = Cloud(np.ones((1, 3)), T_world_camera=np.eye(4))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (partial(CameraSettings, voxel=0.0), "voxel is 0.0; it must be a positive length"),
        (partial(CameraSettings, points=0), "points is 0; it must be 1 or more"),
        (partial(CameraSettings, noise=-0.1), "noise is -0.1; it must be a length of 0 or more"),
        (partial(Observer, scenes=0), "of 1 or more"),
        (partial(Observer().of_points, np.full((50, 3), 9.0)), "none of the cloud's 50 points"),
        (partial(camera_cloud, CLOUD, CameraSettings(), RNG), "'scan', a PointCloud"),
        (partial(look_at, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), "cannot look at"),
        (partial(Intrinsics.from_fov, width=0), "width is 0"),
        (partial(Intrinsics.from_fov, height=0), "height is 0"),
        (partial(Intrinsics.from_fov, vertical_fov=180.0), "give one between 0 and 180"),
        (partial(Intrinsics.from_fov, near=2.0, far=1.0), "give 0 <= near < far"),
        (partial(ScanSettings, voxel=float("nan")), "voxel is nan; it must be a finite float"),
        (
            partial(ScanSettings, robot_margin=-0.1),
            "robot_margin is -0.1; it must be a length of 0",
        ),
        (partial(ScanSettings, neighbours=-1), "neighbours is -1; it cannot be negative"),
        (partial(scan, 2 * [CAPTURE], ScanSettings(level=True), RNG), "2 captures cannot be lev"),
        (partial(voxel_means, np.array([[-900.0] * 3, [900.0] * 3]), 1e-7), "1e-07 m is too small"),
        (partial(replace, ROOM, upper=ROOM.lower), "lower corner below"),
        (partial(MapSettings, resolution=1e-9), r"resolution is 1e-09 m; give 0\.001 m or more"),
        (partial(occupancy_map, NOTHING, MapSettings(), [CAPTURE]), "no point is left"),
        (partial(occupancy_map, NOTHING, ROOM, []), "captures with their cameras"),
        (partial(occupancy_map, NOTHING, HUGE, [CAPTURE]), "smaller box or larger"),
    ],
)
def test_settings_and_scenes_are_checked(make, message):
    refused(message, make)
