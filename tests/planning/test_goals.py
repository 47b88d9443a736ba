"""Goals drawn in compiled code: those that inverse kinematics with coal draws, in the same order."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.planning.goals import sample_goals
from experiments.suites.place_task import place_problem


@pytest.mark.parametrize("environment", [0, 1, 15, 1000])
def test_goals_are_those_of_the_exact_draw(environment):
    problem = place_problem(environment)
    checker = problem.collision_checker(SAMPLE_MARGIN)
    expected = sample_region(problem.robot, problem.goal_region, checker, np.random.default_rng(3), 20)
    found = sample_goals(problem, np.random.default_rng(3), 20)
    np.testing.assert_array_equal(found.configurations, expected.configurations)
    assert (found.poses_tried, found.unreachable, found.colliding) == (
        expected.poses_tried,
        expected.unreachable,
        expected.colliding,
    )


def test_every_goal_keeps_the_margin_and_lies_in_the_region(problem):
    goals = sample_goals(problem, np.random.default_rng(0), 10).configurations
    assert len(goals) == 10
    assert not problem.collision_checker(0.99 * SAMPLE_MARGIN).in_collision_batch(goals).any()
    region = replace(problem, constraint=(problem.goal_region,)).manifold
    assert np.linalg.norm(region.residual(goals), axis=1).max() < 1e-5


def test_what_cannot_be_had_is_counted(problem):
    """A region out of reach, and one inside the arm's own base."""
    far, base = np.eye(4), np.eye(4)
    far[:3, 3], base[:3, 3] = (5.0, 0.0, 0.0), (0.0, 0.0, 0.3)
    bounds = np.array([(-0.01, 0.01)] * 3 + [(-0.1, 0.1)] * 3)
    beyond = replace(problem, goals=np.empty((0, 7)), goal_region=TaskSpaceRegion(far, np.eye(4), bounds))
    sample = sample_goals(beyond, np.random.default_rng(0), 5, max_poses=30)
    assert (len(sample.configurations), sample.poses_tried, sample.unreachable) == (0, 30, 30)
    inside = replace(beyond, goal_region=TaskSpaceRegion(base, np.eye(4), bounds))
    sample = sample_goals(inside, np.random.default_rng(0), 5, max_poses=30)
    assert len(sample.configurations) == 0 and sample.unreachable + sample.colliding == 30
