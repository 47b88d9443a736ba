"""Planners by name: weights work only for the robot of their training; warm-up of each planner."""

import math

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.place_task import door_problem, place_problem
from cvqmpt_lab.planning import warm_up
from cvqmpt_lab.planning.by_name import declared
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.planners import PLANNERS, planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.result import Budget

NAMES = (*PLANNERS, *declared("control"))
NEEDY = [name for name in NAMES if planner_named(name).weights is not None]


@pytest.fixture(scope="module", params=["ur5", "xarm7"])
def other(request):
    """Return an unconstrained problem of an arm with six joints, or with seven like the Panda."""
    robot = robot_from_source({"name": request.param})
    start = np.clip(np.zeros(robot.dof), robot.lower + 0.1, robot.upper - 0.1)
    return PlanningProblem("elsewhere", robot, Scene("empty", ()), start, start[None] + 0.2)


@pytest.mark.parametrize("name", NEEDY)
def test_weights_of_the_panda_are_refused_for_another_arm(other, name):
    """Formerly a UR5 crashed the process, and an xArm7 was "solved" with the Panda's weights."""
    told = "weights are for robot 'panda', not"
    line = refused(told, solve, other, name, Budget(iterations=10), seed=0)
    others = [name for name, method in PLANNERS.items() if method.weights is None]
    assert len(others) >= 8 and line.endswith(f"planners that can: {', '.join(others)}")


@pytest.mark.parametrize(
    ("name", "reach", "same"),
    [
        ("birrt", math.inf, "birrt-printed"),
        ("birrt-printed", 1.0, "birrt"),
        ("cvq:transformer+decoded+reach=2", 0.5, "cvq:transformer+decoded+reach=0.5"),
    ],
)
def test_another_reach_is_the_planner_that_has_it(name, reach, same):
    def counted(method):
        return vars(solve(place_problem(1003), method, Budget(iterations=2000), seed=1).plan)

    one, other = counted(planner_named(name, reach=reach)), counted(planner_named(same))
    assert one["vertices"] == other["vertices"] != counted(planner_named(name))["vertices"]
    assert vars(one["counters"]) == vars(other["counters"])


@pytest.mark.parametrize("name", PLANNERS)
def test_every_planner_can_be_warmed_up_on_problems_it_serves(name):
    for problem in (place_problem(1003), door_problem(0)):
        method = planner_named(name)
        if not method.incompatibility(problem):
            warm_up.warm_up(problem, method, "compiled")
