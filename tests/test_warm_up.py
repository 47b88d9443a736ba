"""What is paid before the clock starts changes nothing of what is computed after."""

import numpy as np
import pytest

from cvqmpt_lab import warm_up
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planners import PLANNERS, planner_named
from cvqmpt_lab.search.result import Budget
from experiments.suites.door_task import door_problem
from experiments.suites.place_task import place_problem

ENOUGH = Budget(iterations=20_000)


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_can_be_warmed_up_on_problems_it_serves(name):
    for problem in (place_problem(1003), door_problem(0)):
        method = planner_named(name)
        if not method.incompatibility(problem):
            warm_up.warm_up(problem, method, "compiled")


def test_warming_up_changes_no_path():
    problem, method = place_problem(1004), planner_named("opt-cvq-mpt")
    before = solve(problem, method, ENOUGH, seed=3, clearance=False)
    warm_up.warm_up(problem, method, "compiled")
    after = solve(problem, method, ENOUGH, seed=3, clearance=False)
    assert after.plan.counters == before.plan.counters
    np.testing.assert_array_equal(after.simplified.path.states, before.simplified.path.states)
