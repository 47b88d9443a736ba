"""Plots say what the certificate says."""

import numpy as np
import pytest

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.show.curves import bound_plots, clearance_plot


def test_tilt_beyond_its_bounds_is_the_certificates_violation(problem):
    states = problem.robot.random_configurations(np.random.default_rng(0), 5)
    plots = bound_plots(problem, states)
    assert [plot.title for plot in plots] == [
        f"rotation about {axis} against its bounds [rad]" for axis in "yz"
    ]
    outside = np.zeros(len(states))
    for axis, plot in zip("yz", plots, strict=True):
        tilt, low, high = (
            plot.curves[name].values for name in (f"rotation about {axis}", "lower bound", "upper bound")
        )
        outside = np.maximum(outside, np.maximum(low - tilt, tilt - high))
    for q, excess in zip(states, outside, strict=True):
        assert excess == pytest.approx(
            certify(problem, JointPath(np.stack([q, q])), clearance=False).max_violation_rad, abs=1e-9
        )


def test_clearance_is_the_certificates(solution):
    states = solution.simplified.path.states[::20]
    for q, clearance in zip(
        states, clearance_plot(solution.problem, states).curves["clearance"].values, strict=True
    ):
        expected = certify(solution.problem, JointPath(np.stack([q, q]))).min_clearance_m
        assert clearance == pytest.approx(1e3 * expected)
