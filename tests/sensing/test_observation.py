"""Input clouds of networks: a cloud in the scene, rendered shapes, or a given cloud."""

from unittest.mock import Mock

import numpy as np
from refusals import refused
from scipy.spatial import cKDTree

from cvqmpt_lab.base import caches as kept
from cvqmpt_lab.base.caches import cached_arrays
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import PointCloud, Sphere
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import Stages
from cvqmpt_lab.sensing import observation
from cvqmpt_lab.sensing.observation import Observer, camera_cloud

POINTS = np.random.default_rng(0).uniform(-0.2, 0.2, (5000, 3))
VOXEL = 0.025
BALL = SceneObject("ball", Sphere(0.1), pose((0.5, 0.4, 0.3)))
SCAN = SceneObject("scan", PointCloud(POINTS, 0.01), pose((0.5, -0.2, 0.4), yaw=0.7))


def seen(*objects):
    return Observer()(Scene("s", objects))


def test_a_cloud_in_the_scene_is_used_unchanged_and_an_empty_scene_gives_two_points():
    cloud = seen(SCAN)
    world = POINTS @ SCAN.T_world_object[:3, :3].T + SCAN.T_world_object[:3, 3]
    assert cloud.shape == (1024, 3) and not cloud.flags.writeable
    assert cKDTree(world).query(cloud)[0].max() < VOXEL
    assert cKDTree(cloud).query(world)[0].mean() < 2 * VOXEL
    nothing = seen()
    assert nothing.shape == (2, 3) and (nothing[:, 2] < -0.5).all()


def test_a_scene_of_shapes_is_rendered_by_cameras():
    cloud = seen(BALL)
    distances = np.linalg.norm(cloud - BALL.T_world_object[:3, 3], axis=1)
    assert len(cloud) == 1024 and np.abs(distances - 0.1).max() < VOXEL


def test_a_given_cloud_replaces_that_of_the_scene_and_needs_a_planner_that_uses_clouds(problem):
    method = Method("looks", lambda robot, weights: Stages(observe=Observer()))
    measured = POINTS + (0.4, 0.0, 0.3)
    cloud = method.with_cloud(measured).stages(problem).observe(Scene("s", (SCAN,)))
    assert cloud.shape == (1024, 3) and cKDTree(measured).query(cloud)[0].max() < VOXEL
    blind = Method.simple("blind").with_cloud(POINTS)
    refused("blind uses no cloud", blind.stages, problem)


def test_a_rendered_cloud_is_kept_on_disk_and_the_same_from_there(tmp_path, monkeypatch, problem):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    rendered = Mock(side_effect=camera_cloud)
    monkeypatch.setattr(observation, "camera_cloud", rendered)
    first, again = Observer()(problem.scene), Observer()(problem.scene)
    np.testing.assert_array_equal(first, again)
    assert rendered.call_count == 1 and not again.flags.writeable
    changed = problem.scene.without(problem.scene.names[0])
    assert len(Observer()(changed)) and len(Observer(seed=1)(problem.scene))
    assert rendered.call_count == 3


def test_the_oldest_cached_arrays_are_deleted_and_without_a_cache_made(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for key in (b"a", b"b", b"c"):
        cached_arrays("things", key, lambda key=key: {"x": np.frombuffer(key, np.uint8)}, most=2)
    assert len(list((tmp_path / "cvqmpt_lab" / "things").iterdir())) == 2
    monkeypatch.setattr(kept, "trusted_cache", lambda folder: None)
    assert cached_arrays("things", b"c", lambda: {"x": POINTS})["x"] is POINTS
