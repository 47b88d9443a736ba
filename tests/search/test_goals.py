"""Goals from compiled code: as diverse as by plain inverse kinematics, free, counted."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.family_task import other_robot_problem
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.goals import sample_goals
from cvqmpt_lab.search.result import Budget


def apart(goals):
    """Typical distance of goals from each other [rad]."""
    return np.median(np.linalg.norm(goals[:, None] - goals[None], axis=2))


@pytest.mark.parametrize("environment", [0, 1, 15, 1000])
def test_goals_are_as_many_and_as_diverse_as_those_of_unhurried_inverse_kinematics(environment):
    problem = place_problem(environment)
    checker = problem.collision_checker(SAMPLE_MARGIN)
    slow = sample_region(problem.robot, problem.goal_region, checker, np.random.default_rng(3), 20)
    fast = sample_goals(problem, np.random.default_rng(3), 20)
    assert len(fast.configurations) == len(slow.configurations) == 20
    assert apart(fast.configurations) > 0.7 * apart(slow.configurations)
    roomy = problem.collision_checker(0.99 * SAMPLE_MARGIN)
    assert not roomy.in_collision_batch(fast.configurations).any()
    assert_inside(problem, fast.configurations)


def assert_inside(problem, goals):
    """Goals lie in the goal region."""
    region = replace(problem, constraint=(problem.goal_region,)).manifold
    assert np.linalg.norm(region.residual(goals), axis=1).max() < 1e-5


def test_a_single_pose_is_reached_in_many_postures_and_near_a_configuration_in_its(problem):
    there = TaskSpaceRegion(problem.robot.pose(problem.start), np.eye(4), np.zeros((6, 2)))
    at_start = replace(problem, goal_region=there)
    goals = sample_goals(at_start, np.random.default_rng(0), 20).configurations
    assert len(goals) == 20 and len(np.unique(goals.round(2), axis=0)) >= 15
    goals = sample_goals(problem, np.random.default_rng(0), 5, near=problem.goals[0]).configurations
    assert len(goals) == 5
    assert np.linalg.norm(goals - problem.goals[0], axis=1).max() < 2.0


def test_what_cannot_be_had_is_counted(problem):
    """A region out of reach, and one inside the arm's base."""
    for place, least in (((5.0, 0.0, 0.0), 30), ((0.0, 0.0, 0.3), 0)):
        region = TaskSpaceRegion(pose(place), np.eye(4), bounds([0.01] * 3 + [0.1] * 3))
        asked = replace(problem, goals=np.empty((0, 7)), goal_region=region)
        sample = sample_goals(asked, np.random.default_rng(0), 5, max_poses=30)
        assert len(sample.configurations) == 0 and sample.poses_tried == 30
        assert sample.unreachable >= least and sample.unreachable + sample.colliding == 30


def test_half_of_the_goals_of_joints_with_more_than_a_turn_are_at_most_half_a_turn_away():
    problem = other_robot_problem("ur5", 0)
    assert isinstance(problem, PlanningProblem)
    goals = sample_goals(problem, np.random.default_rng(0), 20).configurations
    away = np.abs(goals - problem.start).max(axis=1)
    assert away[::2].max() <= np.pi < away[1::2].max()
    assert_inside(problem, goals)
    assert ((goals >= problem.robot.lower) & (goals <= problem.robot.upper)).all()


YAW_FREE, POSITION_ONLY = [0.05, 0.05, np.pi], [np.inf] * 3


@pytest.fixture(scope="module")
def five_joints():
    """An arm of five joints between two configurations on a manifold, the second one's pose."""
    arm = robot_from_source({"name": "so-arm101"})
    start, end = np.array([[0.0, -0.8, 0.6, 0.2, 0.0], [0.8, -0.2, 0.4, 0.0, 0.5]])
    kept = (TaskSpaceRegion(np.eye(4), arm.pose(start), bounds([np.inf] * 3 + [0.3, 0.3, np.inf])),)
    problem = PlanningProblem("five", arm, Scene("empty", ()), start, end[None], kept)
    return replace(problem, goals=problem.manifold.project(end)[None])


def bounds(most):
    return np.stack([np.negative(most), most], axis=1)


@pytest.mark.parametrize("turns", [YAW_FREE, POSITION_ONLY])
@pytest.mark.parametrize("constrained", [False, True])
def test_an_arm_of_five_joints_gets_goals_in_a_region_with_freedom(five_joints, turns, constrained):
    """Whole poses are drawn from the region, hardly any within its reach: there was no goal."""
    T, there = five_joints.robot.pose(five_joints.goals[0]), np.eye(4)
    there[:3, 3], T[:3, 3] = T[:3, 3], 0.0
    region = TaskSpaceRegion(there, T, bounds([0.005] * 3 + turns))
    asked = replace(five_joints, goals=np.empty((0, 5)), goal_region=region)
    asked = asked if constrained else replace(asked, constraint=())
    solution = solve(asked, "birrt", Budget(iterations=20_000), seed=0)
    assert solution.solved and len(solution.problem.goals) == 20
    assert_inside(asked, solution.problem.goals)
    drawn = asked.changed(start=np.empty(0), start_region=region)
    start = PlanningProblem.from_dict(drawn.to_dict()).start
    assert_inside(asked, start[None])


def test_goals_of_a_region_of_all_turns_are_turned_as_the_constraint_asks(problem):
    """None of the poses that were drawn kept it: "'goal_region' leaves the constraint"."""
    place = pose(problem.robot.pose(problem.goals[0])[:3, 3])
    region = TaskSpaceRegion(place, np.eye(4), bounds([0.0] * 3 + [np.inf] * 3))
    asked = replace(problem, goals=np.empty((0, 7)), goal_region=region)
    assert solve(asked, "birrt", Budget(iterations=20_000), seed=0).solved


@pytest.mark.parametrize("method", ["birrt", "roadmap-cvq"])
def test_ten_thousand_goals_are_planned_for(problem, method):
    many = replace(problem, goals=np.tile(problem.goals, (10_000 // len(problem.goals), 1)))
    solution = solve(many, method, Budget(iterations=20_000), seed=0, clearance=False)
    assert solution.solved and len(solution.problem.goals) == 10_000
