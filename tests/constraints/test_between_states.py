"""Bounds on violations between path states; the share of its bounds that a path uses."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.constraints.between_states import evenly_spaced, largest_violation
from cvqmpt_lab.constraints.report import bound_usage, displacements
from cvqmpt_lab.constraints.task_space_region import (
    RegionConstraint,
    TaskSpaceRegion,
    symmetric_region,
    upright,
    upright_box,
)
from cvqmpt_lab.poses import pose

HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def dense(robot, region, states, spacing=5e-4):
    """The largest distance outside a region at very many states."""
    x = displacements(robot, region, evenly_spaced(states, spacing))
    lower, upper = region.bounds.T
    return float(np.maximum(lower - x, x - upper)[:, region.bounded_rows].max())


@pytest.mark.parametrize("tolerance", [1e-3, 0.1])
@pytest.mark.parametrize("kind", ["upright", "upright-box", "pose", "slider"])
def test_the_bound_holds_and_is_close(panda, slider_arm, kind, tolerance):
    robot = slider_arm if kind == "slider" else panda
    rng = np.random.default_rng(0)
    for _ in range(25):
        steps = rng.normal(0.0, 0.03, (4, robot.dof))
        states = robot.random_configurations(rng, 1) + np.cumsum(steps, axis=0)
        region = upright_box() if kind == "upright-box" else upright()
        if not kind.startswith("upright"):
            region = symmetric_region(robot.pose(states[0]), np.eye(4), [0.02] * 6)
        found = largest_violation(robot, (region,), states, 0.04, tolerance)
        truth = dense(robot, region, states)
        assert truth <= found.largest + 1e-9
        assert max(found.radians, found.metres) <= max(truth, 0.0) + 2e-3
        if truth <= 0.5 * tolerance:
            assert found.largest <= tolerance


def test_a_kink_between_two_good_states_is_found(panda):
    """Only the middle of a motion is tilted; both its ends keep upright to 1e-4."""
    manifold = RegionConstraint(panda, (upright(0.0),))
    a, b = (manifold.project(HOME + (0.0, d, 0.0, 0.0, 0.0, d, 0.0)) for d in (-0.05, 0.05))
    bent = np.array([a, 0.5 * (a + b) + 2e-3 * np.eye(7)[5], b])
    assert largest_violation(panda, (upright(1e-4),), bent[[0, 2]], 1.0, 1e-3).largest <= 1e-3
    assert largest_violation(panda, (upright(1e-4),), bent, 1.0, 1e-3).largest > 1e-3


def test_flips_at_angle_pi_are_no_violation_of_symmetric_bounds(panda):
    """In a frame turned by pi about the vertical, the arm's rotation vector changes sign."""
    half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    region = replace(upright_box(0.02), T0_w=upright_box().T0_w @ half_turn)
    manifold = RegionConstraint(panda, (region,))
    states = [manifold.project(np.array([-0.8, 0.3, 0.0, -2.0, 0.0, 2.0, 0.8]))]
    for _ in range(40):
        states.append(manifold.project(states[-1] + 0.04 * np.eye(7)[0]))
    states = np.array(states)
    x = displacements(panda, region, states)
    assert np.abs(np.diff(x[:, 3])).max() > 6.0, "no flip, nothing tested"
    wider = replace(region, Bw=upright_box(0.021).Bw)
    assert largest_violation(panda, (wider,), states, 0.04, 1e-3).largest <= 1e-3


def test_a_stretch_through_half_a_turn_near_the_bound_is_shown_to_be_inside(panda):
    """Path of place problem 29: tilt 0.4 mrad inside the bounds where the rotation vector flips."""
    first = np.array([-1.14812, 0.38627, -0.63918, -1.13516, -1.36829, 1.75537, 2.18154])
    last = np.array([-1.19274, 0.36491, -0.61858, -1.12574, -1.38658, 1.74428, 2.15945])
    states = np.array([first, last])
    region = (upright_box(),)
    assert largest_violation(panda, region, evenly_spaced(states, 1e-4), 1.0, 1.0).radians == 0.0
    assert largest_violation(panda, region, states, 0.11, 5e-4).largest <= 5e-4
    # without regions there is none
    found = largest_violation(panda, (), np.array([HOME, HOME + 0.1]), 0.04, 1e-3)
    assert (found.radians, found.metres, found.largest, found.at) == (0.0, 0.0, 0.0, None)


def test_the_largest_tilt_of_a_path_is_found_against_its_bound(solution):
    problem, states = solution.problem, solution.path.states
    uses = bound_usage(problem.robot, problem.constraint, states)
    assert [(use.region, use.row, use.unit) for use in uses] == [(0, 4, "rad"), (0, 5, "rad")]
    tilts = np.abs(displacements(problem.robot, problem.constraint[0], states)[:, 4:6])
    assert [abs(use.value) for use in uses] == pytest.approx(tilts.max(axis=0))
    assert str(uses[0]) == f"rotation about y {tilts[:, 0].max():.3g} of 0.1 rad"


def test_a_bound_on_one_side_names_the_state_closest_to_it(panda):
    """Hand heights from above a table: the lowest one counts, however high the others are."""
    states = panda.random_configurations(np.random.default_rng(0), 20)
    Bw = np.array([[-np.inf, np.inf]] * 6)
    Bw[2, 0] = 0.0
    table = TaskSpaceRegion(pose((0.0, 0.0, -0.5)), np.eye(4), Bw)
    (use,) = bound_usage(panda, (upright(np.pi), table), states)
    lowest = min(panda.pose(q)[2, 3] for q in states) + 0.5
    assert use.value == pytest.approx(lowest) and (use.lower, use.upper) == (0.0, np.inf)
    assert str(use) == f"position z {lowest:.3g} of 0 to inf m"
    beside = TaskSpaceRegion(panda.pose(HOME) @ pose((0.1, 0.0, 0.0)), np.eye(4), np.zeros((6, 2)))
    found = displacements(panda, beside, HOME[None])[0]
    np.testing.assert_allclose(found, [-0.1, 0, 0, 0, 0, 0, 0], atol=1e-12)
