"""The linear program of timing: HiGHS by its own interface against cvxpy as the referee."""

import json

import numpy as np
import pytest
import scipy.sparse as sparse
from command_line import python
from refusals import refused

from cvqmpt_lab.features.motion import squared_speeds as speeds
from cvqmpt_lab.features.motion.linear_program import greatest
from cvqmpt_lab.features.motion.timing import TimingSettings, time_path
from cvqmpt_lab.robot.dynamics import Dynamics
from cvqmpt_lab.robot.robot import JointLimits

LIMITS = JointLimits(("first", "second"), np.array([2.0, 1.0]), np.array([4.0, 5.0]))


def path(seed, count=8):
    """Return random waypoints (count, 2) [rad]."""
    return np.cumsum(np.random.default_rng(seed).normal(scale=0.3, size=(count, 2)), axis=0)


def of_all(curve, *args, **settings):
    """Return the squared speeds along a curve by solver."""
    return {
        solver: speeds.squared_speeds(curve, *args, **settings, solver=solver)
        for solver in ("highs", "cvxpy", "cvxpy:clarabel")
    }


@pytest.mark.parametrize("seed", range(4))
def test_all_solvers_find_the_same_speeds_and_highs_equal_bits(seed):
    """Both at rest at the ends and with given speeds there."""
    curve = speeds.smooth_curve(path(seed), 1e-3)
    for ends in [(speeds.HeldSpeed(),) * 2, (speeds.HeldSpeed(0.05, 0.001), speeds.HeldSpeed())]:
        found = of_all(curve, LIMITS, ends=ends)
        assert np.array_equal(found["highs"], found["cvxpy"])
        assert found["highs"].sum() == pytest.approx(found["cvxpy:clarabel"].sum(), rel=1e-5)


def test_efforts_give_equal_bits_too(panda):
    limits, dynamics = panda.joint_limits, Dynamics.of(panda)
    middle = 0.5 * (panda.lower + panda.upper)
    states = np.linspace(middle, middle + 0.3, 4)
    found = of_all(speeds.smooth_curve(states, 1e-3), limits, dynamics)
    assert np.array_equal(found["highs"], found["cvxpy"])


def test_a_program_without_a_solution_has_none():
    rows = sparse.csr_matrix(np.array([[2.0, 0.0]]))
    one = np.ones(2)
    for solver in ("highs", "cvxpy", "cvxpy:clarabel"):
        assert greatest(rows, one, one, solver) is None
    assert np.array_equal(greatest(rows, one, 0.0 * one), [0.5, 1.0])


def test_a_motion_is_timed_by_another_solver():
    times = [
        time_path(path(7), LIMITS, TimingSettings(1.0, solver=solver)).times
        for solver in ("highs", "cvxpy", "cvxpy:CLARABEL")
    ]
    assert np.array_equal(times[0], times[1])
    assert times[2][-1] == pytest.approx(times[0][-1], rel=1e-3)


@pytest.mark.parametrize(
    ("solver", "words"),
    [
        ("cvxopt", "'cvxopt'.*cvxpy:NAME"),
        ("cvxpy:none", "'NONE'.*CLARABEL"),
        ("highs:x", "highs:x"),
    ],
)
def test_unknown_solvers_are_refused_before_planning(solver, words):
    refused(words, TimingSettings, solver=solver)


def test_timing_imports_highs_and_not_cvxpy():
    code = (
        "import json, sys, numpy as np; from cvqmpt_lab import time_path; "
        "from cvqmpt_lab.robot.robot import JointLimits; "
        "time_path([[0, 0], [1, 0], [1, 1]], JointLimits('ab', np.ones(2), np.ones(2))); "
        "print(json.dumps([name in sys.modules for name in ('highspy', 'cvxpy', 'scipy.stats')]))"
    )
    assert json.loads(python(code)) == [True, False, False]
