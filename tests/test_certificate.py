"""The certificate accepts a planned path and rejects every kind of invalid path."""

import time
from dataclasses import replace

import numpy as np
import pytest
from command_line import python
from hypothesis import given, settings
from hypothesis import strategies as st

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.base.values import bound_text
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.certificate.certificate import Deviation, FaultKind, Verdict, certify
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Sphere
from cvqmpt_lab.search.result import Budget, JointPath


@pytest.fixture
def states(solution):
    return solution.path.states.copy()


def reasons(problem, states):
    return certify(problem, JointPath(states)).reasons


def touching(problem, states, gap):
    """Return a path of two states, with a ball `gap` [m] behind the moving links at the first."""
    (a, b), scene = (problem.robot.pose(q)[:3, 3] for q in states[:2]), problem.scene
    ball = SceneObject("ball", Sphere(1e-3), pose(a + 0.2 * (a - b) / np.linalg.norm(a - b)))
    room = replace(problem, scene=scene.with_objects(ball)).collision_checker().nearest(states[0])
    assert room.pair.second == "ball"
    scene = scene.with_objects(replace(ball, shape=Sphere(1e-3 + room.distance - gap)))
    return replace(problem, scene=scene, goals=states[1:2])


def test_a_path_that_begins_too_close_to_an_obstacle_for_a_proof_is_not_proven(problem, states):
    """A gap of 0.5 um is below the rounding error of coal's distances; 10 um is proven."""
    # the first joint alone turns: the hand keeps its tilt, and the ball lies behind it
    states = states[0] + np.outer((0.0, 0.02), np.eye(7)[0])
    certificate = certify(touching(problem, states, 5e-7), JointPath(states[:2]))
    assert certificate.verdict is Verdict.NOT_PROVEN and not certificate.valid
    (fault,) = certificate.faults
    assert fault.kind is FaultKind.NOT_PROVEN and "ball" in fault.text and 0.0 <= fault.at < 1.0
    assert certificate.unproven_rad > 0.0 and 0.0 < certificate.unproven_m < 1e-3
    assert certify(touching(problem, states, 1e-5), JointPath(states[:2])).verdict is Verdict.VALID


@pytest.mark.parametrize("far", [1e5, 1e160, 1e300])
def test_states_far_apart_are_refused_at_once(problem, states, far):
    for wild in (np.array([states[0], states[0] + far]), np.full((2, 7), far), far * np.eye(7)):
        began = time.process_time()
        found = certify(problem, JointPath(wild))
        assert time.process_time() - began < 1.0
        assert found.verdict is Verdict.REFUSED
        assert {fault.kind for fault in found.faults} <= {FaultKind.STEP, FaultKind.LIMITS}


def test_any_goal_will_do_and_so_will_the_goal_region(problem, states):
    others = problem.goals[np.abs(problem.goals - states[-1]).max(axis=1) > 0.0]
    assert len(others) == len(problem.goals) - 1
    assert reasons(problem.changed(goals=others), states) == ()  # the end lies in the region
    elsewhere = replace(problem, goals=others, goal_region=None)
    assert reasons(elsewhere, states) == ("does not end at a goal",)


@pytest.mark.parametrize("shape", [(0, 7), (3, 6), (7,)])
def test_paths_of_another_shape_are_rejected(problem, shape):
    assert not certify(problem, JointPath(np.zeros(shape))).valid


AFTER_OTHERS = """
import sys
import numpy as np
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.benchmarks.place_task import place_problem
problem, rng = place_problem(2), np.random.default_rng(1)
for _ in range(int(sys.argv[1])):
    certify(problem, JointPath(problem.robot.random_configurations(rng, 4)))
print(certify(problem, JointPath(np.load(sys.argv[2]))))
"""


def test_a_certificate_does_not_depend_on_what_its_process_did_before(tmp_path):
    """Results are bitwise equal: GJK does not start from an earlier result, boxes do not grow."""
    found = solve(place_problem(2), "birrt", Budget(iterations=20_000), seed=0)
    np.save(tmp_path / "states.npy", found.path.states)
    printed = [python(AFTER_OTHERS, count, tmp_path / "states.npy") for count in (0, 1, 40)]
    assert "min_clearance" in printed[0] and printed == 3 * printed[:1]


def test_bounds_of_a_motion_hold_for_the_curve_that_straight_pieces_stand_for(problem, states):
    """The curve may be a margin of the checker away from the pieces; the bound was the pieces'."""
    apart = 1e-4
    pieces = certify(problem, JointPath(states), exact_clearance=True)
    curve = certify(problem, JointPath(states), problem.collision_checker(apart), True)
    for one, other in (
        (pieces.obstacle_clearance, curve.obstacle_clearance),
        (pieces.self_clearance, curve.self_clearance),
    ):
        assert other.at_least_m <= one.distance_m - apart


def test_what_the_proof_shows_is_never_more_than_the_exact_clearances(problem, states):
    shown = certify(problem, JointPath(states))
    exact = certify(problem, JointPath(states), exact_clearance=True)
    assert shown.verdict is exact.verdict and shown.tolerated is None and shown.closest is None
    for bound, found in (
        (shown.obstacle_clearance, exact.obstacle_clearance),
        (shown.self_clearance, exact.self_clearance),
    ):
        assert not bound.measured and 0.0 < bound.at_least_m <= found.distance_m


@settings(max_examples=300)
@given(st.floats(1e-12, 1e12), st.integers(1, 5))
def test_printed_bounds_are_bounds(bound, digits):
    """Rounded to nearest, a half of them was on the wrong side."""
    low, high = (bound_text(bound, up, digits) for up in (False, True))
    assert float(low) <= bound <= float(high)
    step = 10.0 ** (1 - digits)
    assert float(high) - float(low) <= 1.01 * step * bound
    assert bound_text(float(f"{bound:.{digits}g}"), True, digits) == f"{bound:.{digits}g}"


def test_bounds_without_digits_are_printed():
    assert [bound_text(x, up=True) for x in (0.0, float("inf"), -0.0451)] == ["0", "inf", "-0.045"]
    assert str(Deviation(0.0129, 0.0999, 0.00999)) == (
        "points 12 mm off, a hand turned by 0.099 rad; joints 0.0099 rad off"
    )
