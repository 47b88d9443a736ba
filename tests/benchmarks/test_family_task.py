"""Problems in scenes of the training families, for the Panda and for arms without weights."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.benchmarks import family_task
from cvqmpt_lab.benchmarks.family_task import (
    ROBOTS,
    family_problem,
    held_out_problem,
    other_robot_problem,
)
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.problem import check_problem
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace


@pytest.mark.parametrize(
    ("robot", "joints", "sliders"), [("ur5", 6, 0), ("xarm7", 7, 0), ("tiago", 8, 1)]
)
def test_an_arm_moves_upright_between_two_hand_poses(robot, joints, sliders):
    suite, index = suite_named("robots"), 20 * list(ROBOTS).index(robot) + 6
    problem, again = suite.solvable(index), suite.solvable(index)
    assert problem.name == f"{index}/{index // 20 + 1}-{robot}"
    np.testing.assert_array_equal(problem.start, again.start)
    assert problem.robot.dof == joints and problem.robot.kinematics.prismatic.sum() == sliders
    check_problem(problem)
    solution = solve(problem, "birrt", Budget(iterations=20_000), seed=0)
    assert solution.solved and solution.certificate.reasons == ()
    ends = solution.simplified.path.states[[0, -1]]
    np.testing.assert_array_equal(ends[0], problem.start)
    np.testing.assert_allclose(problem.robot.pose(ends[1]), problem.goal_region.T0_w, atol=1e-4)
    upright = [problem.robot.pose(q)[2, 0] for q in solution.simplified.path.states]
    assert min(upright) > np.cos(0.2)


@pytest.mark.parametrize(
    ("robot", "index", "family", "number"),
    [("panda", 1, "table", 2001), ("z1", 5, "table", 2105), ("panda", 19, "kitchen-like", 2039)],
)
def test_a_robot_gets_the_first_scene_of_its_family_that_holds_a_problem(
    robot, index, family, number
):
    source, problem = ROBOTS[robot], other_robot_problem(robot, index)
    expected = family_problem(family, number, source)
    assert problem.scene.name.endswith(f"_{number}")
    np.testing.assert_array_equal(problem.start, expected.start)
    np.testing.assert_array_equal(problem.goal_region.T0_w, problem.robot.pose(expected.goals[0]))
    assert not any(map(holds_problem(family, source), range(2000 + index, number, 20)))


@pytest.mark.parametrize(("index", "number"), [(0, 0), (1, 8001), (34, 8084)])
def test_a_family_problem_is_of_its_own_scene_or_of_the_first_spare_one_that_holds_one(
    index, number
):
    expected = family_problem("kitchen-like", number)
    assert held_out_problem("kitchen-like", index) == replace(expected, name=str(index))
    earlier = [k for k in (index, *range(8000 + index, number, 50)) if k != number]
    assert not any(map(holds_problem("kitchen-like"), earlier))


def holds_problem(family, *source):
    return lambda k: not isinstance(family_problem(family, k, *source), UnsolvableProblem)


def test_a_robot_without_a_problem_in_all_scenes_is_reported_in_one_line(monkeypatch):
    tried = []

    def none(family, number, robot_source):
        tried.append(number)
        return UnsolvableProblem(str(number), f"nothing in {family} {number}")

    monkeypatch.setattr(family_task, "family_problem", none)
    found = other_robot_problem("ur5", 3)
    assert found == UnsolvableProblem("3", "nothing in kitchen-like 2383, the last of 20 scenes")
    assert tried == list(range(2003, 2400, 20))


@pytest.mark.parametrize("family", ["cubes-spheres", "shelves"])
def test_family_problems_start_and_end_upright_and_free(family):
    for number in (0, 1001):
        problem = family_problem(family, number)
        check_problem(problem)
        space = ConstrainedSpace(problem)
        assert not motion_free(space.arrays, problem.start, problem.goals[0])
