"""Goals by compiled code: free, counted, and as diverse as by inverse kinematics in Python."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.family_task import other_robot_problem
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.constraints.by_name.distance import distance
from cvqmpt_lab.constraints.by_name.on_sphere import on_sphere
from cvqmpt_lab.constraints.goals import (
    SAMPLE_MARGIN_M,
    goals_in_any_posture,
    goals_of,
    near_goals,
    sample_goals,
    sample_region,
)
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget


def apart(goals):
    """Return the typical distance between goals [rad]."""
    return np.median(np.linalg.norm(goals[:, None] - goals[None], axis=2))


@pytest.mark.parametrize("environment", [0, 1, 15, 1000])
def test_goals_are_as_many_and_as_diverse_as_those_of_unhurried_inverse_kinematics(environment):
    problem = place_problem(environment)
    checker = problem.collision_checker(SAMPLE_MARGIN_M)
    slow = sample_region(problem.robot, problem.goal_region, checker, np.random.default_rng(3), 20)
    fast = sample_goals(problem, np.random.default_rng(3), 20)
    assert len(fast.configurations) == len(slow.configurations) == 20
    assert apart(fast.configurations) > 0.7 * apart(slow.configurations)
    roomy = problem.collision_checker(0.99 * SAMPLE_MARGIN_M)
    assert not roomy.in_collision_batch(fast.configurations).any()
    assert_inside(problem, fast.configurations)


def assert_inside(problem, goals):
    """Assert that goals lie in the goal region."""
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
    """A goal region out of reach, and one inside the arm's base."""
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
    """Return a problem of an arm with five joints: upright within 0.3 rad, one goal."""
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
    """Poses drawn from the region are hardly ever reachable by five joints: no goal was found."""
    T, there = five_joints.robot.pose(five_joints.goals[0]), np.eye(4)
    there[:3, 3], T[:3, 3] = T[:3, 3], 0.0
    region = TaskSpaceRegion(there, T, bounds([0.005] * 3 + turns))
    asked = replace(five_joints, goals=np.empty((0, 5)), goal_region=region)
    asked = asked if constrained else replace(asked, constraint=())
    solution = solve(asked, "birrt", Budget(iterations=20_000), seed=0)
    assert solution.solved and len(solution.goals) == 20
    assert_inside(asked, solution.goals)
    drawn = asked.changed(start=np.empty(0), start_region=region)
    start = PlanningProblem.from_dict(drawn.to_dict()).start
    assert_inside(asked, start[None])


def test_goals_of_a_region_of_all_turns_are_turned_as_the_constraint_asks(problem):
    """No drawn pose satisfied the constraint: "'goal_region' leaves the constraint"."""
    place = pose(problem.robot.pose(problem.goals[0])[:3, 3])
    region = TaskSpaceRegion(place, np.eye(4), bounds([0.0] * 3 + [np.inf] * 3))
    asked = replace(problem, goals=np.empty((0, 7)), goal_region=region)
    assert solve(asked, "birrt", Budget(iterations=20_000), seed=0).solved


@pytest.mark.parametrize("method", ["birrt", "roadmap-cvq"])
def test_ten_thousand_goals_are_planned_for(problem, method):
    many = replace(problem, goals=np.tile(problem.goals, (10_000 // len(problem.goals), 1)))
    solution = solve(many, method, Budget(iterations=20_000), seed=0)
    assert solution.solved and len(solution.goals) == 10_000


EMPTY = Scene("empty", ())


def raised(name, number):
    """Return a free start of an arm, and the pose 1 cm above its hand."""
    robot, rng = robot_from_source({"name": name}), np.random.default_rng([number, 7])
    while True:
        low, high = np.maximum(robot.lower, -3.0), np.minimum(robot.upper, 3.0)
        start = np.clip(0.8 * rng.uniform(low, high), robot.lower + 0.1, robot.upper - 0.1)
        T = pose((0.0, 0.0, 0.01)) @ robot.pose(start)
        higher = TaskSpaceRegion(T, np.eye(4), bounds([0.0] * 6))
        problem = PlanningProblem("raised", robot, EMPTY, start, goal_region=higher)
        if not problem.collision_checker(SAMPLE_MARGIN_M).in_collision(start):
            near = near_goals(problem)
            if len(near):
                return problem, np.linalg.norm(near[0] - start)


@pytest.mark.parametrize("name", ["ur5", "panda", "xarm7", "kinova", "ur10", "z1"])
def test_a_hand_that_rises_by_a_centimetre_moves_the_arm_hardly(name):
    """With goals from random seeds only, a UR5 turned by 4.4 rad, an xArm7 by 2.9 rad."""
    ratios, nearest = [], []
    for number in range(5):
        problem, distance = raised(name, number)
        solution = solve(problem, "roadmap", Budget(iterations=20_000), seed=0)
        ratios.append(solution.path.length / distance)
        nearest.append(distance)
        assert solution.solved
    assert np.median(ratios) < 1.2 and np.median(nearest) < 0.3


def test_the_nearest_goal_is_where_local_inverse_kinematics_ends(panda):
    """The reference is Newton's method in numpy, from the start."""
    start = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    T = panda.pose(start) @ pose((0.0, 0.02, 0.0))
    q = start.copy()
    for _ in range(50):
        error = T[:3, 3] - panda.pose(q)[:3, 3]
        R = T[:3, :3] @ panda.pose(q)[:3, :3].T
        turn = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        error = np.concatenate([error, 0.5 * np.array(turn)])
        J = np.zeros((6, 7))
        for j, step in enumerate(1e-6 * np.eye(7)):
            moved = panda.pose(q + step)
            turn = moved[:3, :3] @ panda.pose(q)[:3, :3].T
            J[:3, j] = (moved - panda.pose(q))[:3, 3] / 1e-6
            J[3:, j] = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / 1e-6
        q = q + np.linalg.pinv(J) @ error
    there = TaskSpaceRegion(T, np.eye(4), bounds([0.0] * 6))
    problem = PlanningProblem("near", panda, EMPTY, start, goal_region=there)
    goal = goals_of(problem).configurations[0]
    assert np.linalg.norm(goal - start) < 1.01 * np.linalg.norm(q - start)


@pytest.mark.parametrize("width", [0.0, 0.1])
def test_a_start_in_the_goal_region_is_the_goal_and_the_path_is_empty(panda, width):
    start = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    here = TaskSpaceRegion(panda.pose(start), np.eye(4), bounds([width] * 6))
    problem = PlanningProblem("stay", panda, EMPTY, start, goal_region=here)
    for planner in ("birrt", "ompl-projected", "opt-cvq-mpt"):
        solution = solve(problem, planner, Budget(iterations=100), seed=0)
        assert solution.solved and solution.path.length == 0.0
        assert solution.plan.detail == "the start is a goal: the path is empty"
        assert solution.plan.counters.state_checks == 0


def test_goals_of_a_distance_are_projections_of_random_configurations(problem):
    sphere = on_sphere((0.5, 0.0, 0.4), 0.3)
    asked = replace(problem, goals=np.empty((0, 7)), goal_region=sphere)
    goals = goals_in_any_posture(asked).configurations
    assert len(goals) >= 15 and apart(goals) > 0.1
    off = problem.robot.poses(goals)[:, :3, 3] - [0.5, 0.0, 0.4]
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), 0.3, atol=1e-4)
    far = distance((3.0, 4.0))
    failed = solve(replace(asked, goal_region=far), "birrt", Budget(iterations=1), seed=0)
    assert "region: it cannot be kept: the best of" in str(failed.report("birrt"))


def test_goals_near_the_start_leave_room_for_other_postures(problem):
    """At most four of twenty goals are near; all are free, in the region and on the manifold."""
    asked = replace(problem, goals=np.empty((0, 7)), scene=EMPTY)
    goals = goals_of(asked)
    near = near_goals(asked)
    assert goals.drawn and len(goals.configurations) == 20 and 0 < len(near) <= 4
    np.testing.assert_array_equal(goals.configurations[: len(near)], near)
    roomy = asked.collision_checker(0.99 * SAMPLE_MARGIN_M)
    assert not roomy.in_collision_batch(goals.configurations).any()
    assert_inside(problem, goals.configurations)
    assert np.linalg.norm(problem.manifold.residual(goals.configurations), axis=1).max() < 1e-4
    assert goals_of(problem).configurations is problem.goals
