"""One call from a problem to a certified motion, and what it refuses."""

import numpy as np
import pytest
from refusals import refused

import cvqmpt_lab
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.plan import Request, plan
from cvqmpt_lab.planning.margins import NO_MARGIN, Margin
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.search.result import Budget

ENOUGH = Budget(iterations=20_000)


def test_a_plan_without_margin_is_the_plain_solution_and_has_no_motion_unless_asked(problem):
    planned = plan(problem, Request("birrt", ENOUGH, 3, NO_MARGIN))
    plain = solve(problem, "birrt", ENOUGH, 3)
    np.testing.assert_array_equal(planned.path.states, plain.path.states)
    assert planned.motion is None and repr(planned).endswith("margin      none requested")
    timed = plan(problem, Request("birrt", ENOUGH, 3, NO_MARGIN, timing=TimingSettings(0.5)))
    np.testing.assert_allclose(timed.motion.positions[0], problem.start, atol=1e-12)
    assert timed.motion is timed.motion


def test_a_wrong_request_is_refused_in_one_line(problem):
    for told, fields in (
        ("planner is a int, 3; it must be a Method: or the name of a planner", {"planner": 3}),
        ("budget is a int, 3; .*: give Budget", {"budget": 3}),
        ("optimize is a int, 3; .*: give Budget", {"optimize": 3}),
        ("seed .*: give a whole number", {"seed": -1}),
        ("margin is a float, 0.002; .*: give Margin", {"margin": 0.002}),
        ("margin 0.3: give a number from 0 to 0.1 m", {"margin": Margin(0.3)}),
    ):
        refused(told, Request, **fields)
    refused("problem is a str.*PlanningProblem.load", plan, "mine.json")
    refused("request is a str.*give Request", plan, problem, "birrt")
    timing = TimingSettings(start_velocity=(0.1, 0.2))
    told = "the start velocity has 2 numbers; give 7, one each for panda_joint1"
    with pytest.raises(InvalidInputError, match=told):
        plan(problem, Request(timing=timing))


def test_a_removed_name_says_what_to_call():
    with pytest.raises(AttributeError, match=r"solve_with_margin was removed: call plan\(problem"):
        _ = cvqmpt_lab.solve_with_margin
