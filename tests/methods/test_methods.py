"""Learned planners and controls on the shipped weights."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.distributions import Uniform
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.learned import _believed_blocked, _dictionary, _moved, _observer
from cvqmpt_lab.methods.table import CONTROLS, PLANNERS, planner_named
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.result import Budget, PlanStatus
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.prediction.collision_head import free_probability
from cvqmpt_lab.prediction.shipped import load_shipped
from experiments.rows import path_hash
from experiments.suites.place_task import place_problem

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def problem():
    return with_sampled_goals(place_problem(1003))[0]


def plan(problem, name, budget=ENOUGH, seed=0):
    """One run in a fresh space."""
    space = ConstrainedSpace(problem)
    uniform = Uniform(problem.robot.lower, problem.robot.upper)
    rng = np.random.default_rng(seed)
    return planner_named(name).plan(space, problem.start, problem.goals, uniform, budget, rng)


@pytest.mark.parametrize("name", CONTROLS)
def test_controls_solve_repeat_and_give_up(problem, name):
    first, second = plan(problem, name), plan(problem, name)
    assert first.status is PlanStatus.SOLVED and certify(problem, first.path).valid
    assert path_hash(first.path) == path_hash(second.path) and first.counters == second.counters
    assert plan(problem, name, Budget(seconds=1e-9)).status is PlanStatus.TIMEOUT


def test_learned_planners_pay_for_their_networks(problem):
    result = plan(problem, "opt-cvq-mpt")
    assert result.timings.predict > 0 and result.timings.optimize > 0
    assert result.seconds >= result.timings.total


def test_the_head_sees_the_scene(problem):
    """Its verdict agrees with exact checks more often than not, and another cloud changes it."""
    space, nodes = ConstrainedSpace(problem), _dictionary().nodes
    free = space.valid_batch(nodes)
    cloud, checkpoint = _observer()(problem), load_shipped(problem.robot)
    belief = free_probability(checkpoint, problem.robot, cloud, nodes)
    assert belief[free].mean() > belief[~free].mean() + 0.15
    np.testing.assert_array_equal(_believed_blocked(problem), belief < 0.5)
    elsewhere = free_probability(checkpoint, problem.robot, cloud + [0.0, 0.0, 2.0], nodes)
    assert np.abs(elsewhere - belief).max() > 0.2
    with pytest.raises(InvalidInputError, match="no collision head"):
        free_probability(replace(checkpoint, sequence_model=None), problem.robot, cloud, nodes)


def test_the_update_moves_dictionary_codes_to_the_manifold(problem):
    codes = np.arange(0, 1024, 64)
    means, covariances = _moved(problem, codes, np.random.default_rng(0))
    space = ConstrainedSpace(problem)
    before = [np.linalg.norm(space.residual_and_jacobian(q)[0]) for q in _dictionary().nodes[codes]]
    after = [np.linalg.norm(space.residual_and_jacobian(q)[0]) for q in means]
    assert covariances.shape == (len(codes), 7, 7) and np.mean(after) < np.mean(before)


def test_names_are_unique():
    assert not set(PLANNERS) & set(CONTROLS)
    assert all(planner_named(name).name == name for name in (*PLANNERS, *CONTROLS))
