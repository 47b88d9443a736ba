"""Problems of two arms that carry one object: repeatable, consistent and solved."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.two_arms import hold, two_arms_problem
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE


@pytest.mark.parametrize("index", [0, 60])
def test_a_problem_is_a_function_of_its_index(index):
    """A problem made without caches is the same; other indices give other problems."""
    one = two_arms_problem(index)
    hold.cache_clear()
    assert two_arms_problem(index).to_dict() == one.to_dict()
    other = two_arms_problem(index + 1).to_dict()
    assert other["name"] != one.name and other["start"] != one.to_dict()["start"]


@pytest.mark.parametrize("index", [0, 30, 60])
def test_both_hands_hold_the_thing_at_the_start_and_it_is_level(index):
    """By pinocchio's poses; the second hand may touch the object because both hands hold it."""
    problem = two_arms_problem(index)
    assert np.linalg.norm(problem.manifold.residual(problem.start)) <= PROJECTION_TOLERANCE
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


def test_one_hand_is_refused(panda):
    refused("robot panda has 1 end effectors: name two", hold, panda, "tray-over-table")
