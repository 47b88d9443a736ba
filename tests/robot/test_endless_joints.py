"""Continuous joints: goals by the nearest turn, readings beyond it, limits that are rounded."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.certificate.certificate import FaultKind, certify
from cvqmpt_lab.features.motion.limit_use import Ends
from cvqmpt_lab.features.motion.motion_check import dry_run
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import load_robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget, JointPath

TWIST = '<joint name="twist" type="{}">'


@pytest.fixture
def arm(edited):
    """The slider arm with a last joint that turns without end."""
    return load_robot(edited((TWIST.format("revolute"), TWIST.format("continuous"))), "tool")


def problem_of(robot, start, goal):
    q = np.array([0.0, 0.1, 0.2, start])
    goals = np.array([[0.0, 0.1, 0.2, goal]])
    return PlanningProblem("turn", robot, Scene("empty", ()), start=q, goals=goals)


@pytest.mark.parametrize("goal", [-2.967, 3.316, 3.316 - 4 * np.pi, 2.967 + 20 * np.pi + 0.349])
def test_a_goal_is_taken_by_the_nearest_turn(arm, goal):
    """-2.967 and 3.316 rad are one place, 0.35 rad from the start; the way was 5.93 rad long."""
    problem = problem_of(arm, 2.967, goal)
    assert problem.goals[0, -1] == pytest.approx(2.967 + 0.349, abs=1e-3)
    found = solve(problem, "birrt", Budget(iterations=2000), seed=0)
    assert found.solved and found.path.length == pytest.approx(0.349, abs=1e-3)


def test_a_path_to_another_turn_of_a_goal_is_certified(arm):
    """It ends at the same place; problem files and paths of before are still right."""
    problem = problem_of(arm, 2.967, -2.967)
    ways = np.linspace(0.0, 1.0, 100)[:, None]
    long_way = problem.start + ways * (np.array([0.0, 0.0, 0.0, -2.967 - 2.967]))
    # the tool touches the elbow on the long way, but the end is right
    kinds = {fault.kind for fault in certify(problem, JointPath(long_way)).faults}
    assert kinds == {FaultKind.COLLISION}
    short = problem.start + ways * (problem.goals[0] - problem.start)
    assert certify(problem, JointPath(short)).valid
    other = replace(problem, start=problem.start - [0.0, 0.0, 0.0, 2.0 * np.pi])
    assert certify(other, JointPath(short)).valid
    motion = Motion(arm.joint_names, short)
    current = problem.start + [0.0, 0.0, 0.0, 4.0 * np.pi]
    assert dry_run(problem, motion, Ends(current)).certificate.valid
    assert not dry_run(problem, motion, Ends(current + 0.1)).certificate.valid


def test_where_the_way_to_the_nearest_turn_is_blocked_another_turn_is_taken(arm):
    """The tool touches the elbow between -0.3 and -1.7 rad, not on the longer way."""
    problem = problem_of(arm, -0.3, -1.7)
    assert len(problem.goals) == 1 and problem.goals[0, -1] == -1.7
    for planner in ("birrt", "roadmap"):
        found = solve(problem, planner, Budget(iterations=20_000), seed=0)
        assert found.solved and found.path.states[-1, -1] == pytest.approx(-1.7 + 2.0 * np.pi)
    assert certify(problem, found.path).valid


def test_a_reading_of_several_turns_is_taken_with_a_warning(arm, caplog):
    problem = problem_of(arm, 15.0, 14.5)
    np.testing.assert_allclose(problem.start[-1], 15.0 - 4.0 * np.pi)
    np.testing.assert_allclose(problem.goals[0, -1], 14.5 - 4.0 * np.pi)
    assert caplog.text.count("start: joint twist turns without end; 15 rad are taken as 2.434") == 1
    caplog.clear()
    assert replace(problem, name="again").start[-1] == problem.start[-1] and not caplog.text
    refused("start is outside the limits: twist by .*degrees", problem_of, arm, 170.0, 0.0)


def test_turns_of_a_revolute_joint_are_different_places(edited):
    wide = ('lower="-3" upper="3"', 'lower="-6.28" upper="6.28"')
    robot = load_robot(edited(wide), "tool")
    assert not robot.endless.any()
    assert problem_of(robot, 2.967, -2.967).goals[0, -1] == -2.967
    refused("outside the limits: twist", problem_of, robot, 15.0, 0.0)


def test_a_start_that_rounding_moved_outside_a_limit_is_on_the_limit(slider_arm):
    """Limits of 3.14159 rad and readings in single precision; it was refused at 1e-8."""
    for outside in (1e-8, 9e-7):
        upper = float(slider_arm.upper[-1])
        problem = problem_of(slider_arm, upper + outside, -upper - outside)
        assert problem.start[-1] == upper and problem.goals[0, -1] == slider_arm.lower[-1]
    refused("twist by 2e-06; move it inside", problem_of, slider_arm, upper + 2e-6, 0.0)
