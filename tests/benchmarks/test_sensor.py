"""Scanned scenes: valid starts and goals, free cameras, same maps, verdicts in map and truth."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.item import SensedProblem, UnsolvableProblem
from cvqmpt_lab.benchmarks.results.row import FailReason
from cvqmpt_lab.benchmarks.sensor_task import scanned_scene, sensor_problem
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.experiments.experiment import Experiment
from cvqmpt_lab.experiments.run import outcome_of
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Sphere
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.sensing.observation import solids_of

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def sensed():
    return sensor_problem(1)


@pytest.mark.parametrize("number", [0, 5])
def test_starts_and_goals_have_room_and_cameras_stand_in_the_open(number):
    (truth, cameras), (again, same) = scanned_scene(number), scanned_scene(number)
    np.testing.assert_array_equal(truth.start, again.start)
    np.testing.assert_array_equal(*([camera.eye for camera in each] for each in (cameras, same)))
    assert len(cameras) == 2
    for q in (truth.start, truth.goals[0]):
        assert not truth.collision_checker(0.06 - 1e-4).in_collision(q)
        np.testing.assert_allclose(truth.manifold.residual(q), 0.0, atol=1e-3)
    for camera in cameras:
        for solid in solids_of(truth.scene.obstacles):
            T = solid.T_world_solid
            away = (np.array(camera.eye) - T[:3, 3]) @ T[:3, :3]
            assert (np.abs(away) > np.abs(solid.corners).max(axis=0)).any()


def test_a_path_is_judged_in_the_map_and_in_truth(sensed):
    """A ball that no camera saw blocks the path: certified in the map, not free in truth."""
    run = Experiment("sensor", (1,), ("birrt",), (0,), ENOUGH).runs[0]
    (row,) = outcome_of(run, sensed).rows
    assert row.solved and row.true_free and row.true_clearance_m > 0.0
    assert row.t_whole_s > row.t_sense_s == sensed.seconds
    path = suite_named("sensor").solvable(1)
    hand = path.robot.pose(path.goals[0])[:3, 3]
    ball = SceneObject("unseen", Sphere(0.05), pose(hand))
    truth = Scene("t", (*sensed.truth.objects, ball))
    (row,) = outcome_of(run, replace(sensed, truth=truth)).rows
    assert row.solved and row.true_free is False and row.true_clearance_m < 0.0


def test_a_goal_that_the_map_takes_for_occupied_is_a_failure_that_says_so():
    found = [sensor_problem(7, padding) for padding in (0.04, 0.3)]
    assert isinstance(found[0], SensedProblem) and isinstance(found[1], UnsolvableProblem)
    run = Experiment("sensor", (7,), ("birrt",), (0,), ENOUGH).runs[0]
    (row,) = outcome_of(run, found[1]).rows
    assert row.fail_reason in (FailReason.INVALID_START, FailReason.INVALID_GOAL)
    assert "in the map" in row.detail
