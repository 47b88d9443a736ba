"""What is paid before the clock starts changes nothing of what is computed after."""

import pytest

from cvqmpt_lab import warm_up
from cvqmpt_lab.benchmarks.door_task import door_problem
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.planners import PLANNERS, planner_named


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_can_be_warmed_up_on_problems_it_serves(name):
    for problem in (place_problem(1003), door_problem(0)):
        method = planner_named(name)
        if not method.incompatibility(problem):
            warm_up.warm_up(problem, method, "compiled")
