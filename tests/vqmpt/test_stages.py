"""Learned planners and controls on the shipped weights."""

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.certificate import certify
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planners import CONTROLS
from cvqmpt_lab.search.result import Budget, PlanStatus

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def problem():
    return with_sampled_goals(place_problem(1003))[0]


def plan(problem, name, budget=ENOUGH, seed=0):
    """What the search of a method finds."""
    return solve(problem, name, budget, seed, clearance=False).plan


@pytest.mark.parametrize("name", CONTROLS)
def test_controls_solve_repeat_and_give_up(problem, name):
    first, second = plan(problem, name), plan(problem, name)
    assert first.status is PlanStatus.SOLVED and certify(problem, first.path).valid
    np.testing.assert_array_equal(first.path.states, second.path.states)
    assert first.counters == second.counters
    assert plan(problem, name, Budget(seconds=1e-9)).status is PlanStatus.TIMEOUT


@pytest.mark.parametrize(("method", "shown_another"), [("roadmap-cvq", "roadmap-wrong-scene")])
def test_a_roadmap_needs_its_own_scene(method, shown_another):
    """With another scene's a planner works harder, over a few problems together."""
    ratios = []
    for environment in (1003, 1007, 1017, 1020, 1030):
        problem = with_sampled_goals(place_problem(environment))[0]
        own, wrong = (plan(problem, name).counters for name in (method, shown_another))
        work = [counters.projections + counters.state_checks for counters in (own, wrong)]
        ratios.append(np.log(work[1] / work[0]))
    assert np.exp(np.mean(ratios)) > 1.3
