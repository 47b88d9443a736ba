"""Problems of two arms that carry one thing: they repeat, fit together, and are solved."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.suite import SUITES
from cvqmpt_lab.benchmarks.templates import problem_template
from cvqmpt_lab.benchmarks.two_arms import LAYOUTS, PROBLEMS, ROBOTS, hold, two_arms_problem
from cvqmpt_lab.certificate import certify
from cvqmpt_lab.constraints.task_space_region import TOLERANCE
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.problem import PlanningProblem, check_problem
from cvqmpt_lab.search.result import Budget, JointPath

BUDGET = Budget(iterations=2000)


@pytest.mark.parametrize("index", [0, 60])
def test_a_problem_is_a_function_of_its_index(index):
    """Made again with nothing remembered; other indices give other ones."""
    one = two_arms_problem(index)
    hold.cache_clear()
    assert two_arms_problem(index).to_dict() == one.to_dict()
    other = two_arms_problem(index + 1).to_dict()
    assert other["name"] != one.name and other["start"] != one.to_dict()["start"]


def test_indices_go_through_robots_and_kinds():
    assert len(SUITES["two-arms"].problems) == PROBLEMS * len(ROBOTS) * len(LAYOUTS)
    for number, kind in enumerate(LAYOUTS):
        problem = two_arms_problem(number * PROBLEMS)
        assert problem.robot.name == "baxter" and kind in problem.name


@pytest.mark.parametrize("index", [0, 30, 60])
def test_both_hands_hold_the_thing_at_the_start_and_it_is_level(index):
    """By pinocchio's poses; only because both hold it does the second hand touch it."""
    problem = two_arms_problem(index)
    assert np.linalg.norm(problem.manifold.residual(problem.start)) <= TOLERANCE
    checker = problem.collision_checker()
    assert not checker.in_collision(problem.start)
    (item,), robot = problem.attachments, problem.robot
    left, right = robot.end_effectors
    T_item = robot.pose(problem.start, left) @ item.T_hand_object
    assert T_item[2, 2] >= np.cos(0.1) - 1e-6
    at = np.linalg.inv(T_item) @ robot.pose(problem.start, right)
    assert abs(abs(at[1, 3]) - 0.5 * item.shape.size[1]) < 0.15  # the hand's frame, not its tip
    alone = replace(problem, attachments=(item.changed(also_held_by=()),))
    assert alone.collision_checker().in_collision(alone.start)


def test_the_template_of_baxter_is_solved_and_certified():
    problem = PlanningProblem.from_dict(problem_template({"name": "baxter"}))
    solution = solve(problem, "birrt", BUDGET, seed=1)
    assert solution.solved and solution.certificate.valid
    # one hand that lets go is no path of this problem
    path = solution.path.states.copy()
    path[len(path) // 2, -1] += 0.01
    tampered = certify(solution.problem, JointPath(path))
    assert not tampered.valid and "MANIFOLD" in {fault.kind.name for fault in tampered.faults}


def test_one_hand_is_refused(panda):
    refused("robot panda has 1 end effectors: name two", hold, panda, "tray-over-table")


@pytest.mark.parametrize("name", ["opt-cvq-mpt", "mpnet"])
def test_samplers_of_one_arm_are_refused_by_name(name):
    problem = two_arms_problem(0)
    check_problem(problem)
    told = f"^{name}: weights are for robot 'panda', not 'baxter'"
    refused(told, solve, problem, planner_named(name), BUDGET, 0)
