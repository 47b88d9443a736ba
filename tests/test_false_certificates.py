"""Motions that no certificate may call valid: what is compared, at which sign, with which play."""

from dataclasses import replace

import numpy as np
import pytest
from small_arms import beside_a_half_turn, carried, gantry, pendulum, problem_of, turned

from cvqmpt_lab.certificate.certificate import Verdict, certify
from cvqmpt_lab.features.motion.motion_check import dry_run
from cvqmpt_lab.features.motion.record import record, report_of
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace


def straight(start, end, step=0.1):
    """States (m, n) on the straight motion between two."""
    count = 2 + int(np.linalg.norm(np.subtract(end, start)) / step)
    return np.linspace(start, end, count)


def lines(problem, states):
    """The certificate's report."""
    motion = Motion(problem.robot.joint_names, states)
    found = dry_run(problem, motion)
    return str(report_of(found, record(problem, motion, found)))


def rods(hands):
    """A rod of 0.9 m in each of two hands, across the rails."""
    first = carried("first rod", (0.02, 0.9, 0.02), (0.0, -0.45, 0.0), hands[0])
    return first, carried("second rod", (0.02, 0.9, 0.02), (0.0, 0.45, 0.0), hands[1])


def test_what_two_hands_carry_is_compared(tmp_path):
    """Rods on two carriages that pass each other overlap; without the second one they do not."""
    hands, states = ("left", "right"), straight((-0.5, 0.3), (0.8, 0.3))
    free = problem_of(tmp_path, gantry(), states, hands, rods(hands)[:1])
    assert certify(free, JointPath(states)).valid
    problem = problem_of(tmp_path, gantry(), states, hands, rods(hands))
    found = certify(problem, JointPath(states))
    assert found.verdict is Verdict.REFUSED
    assert "first rod and second rod" in found.reasons[0]
    space = ConstrainedSpace.of(problem)
    assert space.valid(states[0]) and not space.valid(np.array([0.3, 0.3]))


def test_what_two_frames_of_one_arm_carry_is_compared(tmp_path):
    hands = ("left", "wrist")
    things = (
        carried("post", (0.02, 0.02, 0.5), (0.3, 0.0, 0.0), "left"),
        carried("pointer", (0.6, 0.02, 0.02), (0.35, 0.0, 0.0), "wrist"),
    )
    states = straight((0.0, 1.5), (0.0, -1.5))
    for count, valid in ((1, True), (2, False)):
        problem = problem_of(tmp_path, gantry(), states, hands, things[:count])
        assert certify(problem, JointPath(states)).valid == valid
    # two things in one hand do not move against each other
    both = (things[0], carried("other post", (0.02, 0.02, 0.5), (0.3, 0.0, 0.0), "left"))
    problem = problem_of(tmp_path, gantry(), states, hands, both)
    assert certify(problem, JointPath(states)).valid
    motion = Motion(problem.robot.joint_names, states)
    left = record(problem, motion, dry_run(problem, motion))["compared"]["left_out"]
    pair = {"first": "post", "second": "other post", "reason": "fixed to each other"}
    assert pair in left


@pytest.mark.parametrize("play", [None, 0.0, 0.009, 0.5])
def test_a_hand_holds_only_what_a_region_keeps_at_it(tmp_path, play):
    """Without a region, or with much play, the second hand may not go through the plate."""
    hands = ("left", "right")
    plate = carried("plate", (0.1, 1.2, 0.01), (0.0, -0.5, 0.0), "left", "right")
    at = np.eye(4)
    at[:3, 3] = (0.0, -1.0, 0.0)
    bounds = [[-1e-3 if play is None else -play, 1e-3 if play is None else play], *[[0.0, 0.0]] * 5]
    region = {"base": "left", "end_effector": "right", "T0_w": at.tolist()}
    regions = [{**region, "Tw_e": np.eye(4).tolist(), "Bw": bounds}]
    states = straight((0.0, 0.0), (0.3, 0.3))
    problem = problem_of(
        tmp_path, gantry(), states, hands, [plate], regions if play is not None else ()
    )
    found = certify(problem, JointPath(states))
    holds = play in (0.0, 0.009)
    assert found.valid == holds
    assert any("right_0 and plate" in text for text in found.reasons) == (not holds)
    assert ("1 also held by" in lines(problem, states)) == holds


@pytest.mark.parametrize("cosine", [-1e-4, 2e-3])
def test_a_rotation_vector_that_changes_its_sign_between_states_leaves_bounds(tmp_path, cosine):
    """Bounds of one sign: past a half turn the rotation has the opposite vector, far outside."""
    ends = beside_a_half_turn(cosine)
    first = turned(ends)[0] * np.pi
    row = int(np.abs(first[1:]).argmax())
    bounds = [[None, None] for _ in range(6)]
    bounds[3 + row] = sorted((0.5 * first[1 + row], 1.1 * first[1 + row]))
    region = {"T0_w": np.eye(4).tolist(), "Tw_e": np.eye(4).tolist(), "Bw": bounds}
    problem = problem_of(tmp_path, pendulum(), ends, ("part_2",), constraint=[region])
    found = certify(problem, JointPath(ends))
    assert found.valid == (cosine > 0.0), found.reasons


def test_what_is_tolerated_of_points_and_hand_holds_through_a_lever(tmp_path):
    """A point 0.5 m away from the hand stays within 2 cm; the hand turns about any axis."""
    states = straight((0.0, 0.0, 0.0), (0.001, 0.0, 0.0))
    Tw_e = np.eye(4)
    Tw_e[:3, 3] = (0.0, 0.0, -0.5)
    bounds = [[-0.02, 0.02]] * 3 + [[None, None]] * 3
    region = {"T0_w": np.eye(4).tolist(), "Tw_e": Tw_e.tolist(), "Bw": bounds}
    region["T0_w"][2][3] = 0.5
    problem = problem_of(tmp_path, pendulum(), states, ("part_2",), constraint=[region])
    found = certify(problem, JointPath(states), exact_clearance=True).tolerated
    # points of a narrow hand that are off by little turn it by much, see test_tolerated
    assert 0.0 < found.points_m < 0.011 and 0.018 < found.hand_rad < 0.022
    assert found.points_m + 0.5 * found.hand_rad <= 0.02


def test_what_is_tolerated_of_a_chain_holds_for_both_hands(tmp_path):
    """Both hands may be off by it, in opposite directions."""
    states = straight((0.0, 0.0), (0.05, 0.05))
    at = np.eye(4)
    at[:3, 3] = (0.0, -1.0, 0.0)
    bounds = [[-0.02, 0.02]] * 3 + [[-0.3, 0.3]] * 3
    region = {"base": "left", "end_effector": "right", "T0_w": at.tolist()}
    region |= {"Tw_e": np.eye(4).tolist(), "Bw": bounds}
    problem = problem_of(tmp_path, gantry(), states, ("left", "right"), constraint=[region])
    found = certify(problem, JointPath(states), exact_clearance=True).tolerated
    between = 1.0  # [m] from hand to hand
    assert found.points_m > 0.0 and 2.0 * found.points_m + between * found.hand_rad <= 0.02
    assert 2.0 * found.hand_rad <= 0.3
    assert 2.0 * found.joints <= 0.02


def cubic(jerk, ends=0.0, stated=True):
    """Rest to rest along rails in four cubics of 0.25 s with accelerations that are continuous.

    Args:
        jerk: of the pieces, +, -, -, + [m/s^3].
        ends: acceleration where it begins and ends [m/s^2].
        stated: whether the file has accelerations.
    """
    t = 0.25
    q, v, a = [0.0], [0.0], [ends]
    for sign in (1.0, -1.0, -1.0, 1.0):
        j = sign * jerk
        q.append(q[-1] + v[-1] * t + a[-1] * t**2 / 2 + j * t**3 / 6)
        v.append(v[-1] + a[-1] * t + j * t**2 / 2)
        a.append(a[-1] + j * t)
    rows = (np.outer(values, (1.0, 0.0)) for values in (q, v, a))
    positions, velocities, accelerations = rows
    times = t * np.arange(5.0)
    return Motion(None, positions, times, velocities, accelerations if stated else None)


@pytest.mark.parametrize(
    ("jerk", "ends", "stated", "kinds"),
    [
        (4.0, 0.0, True, []),
        (16.0, 0.0, True, ["jerk"]),
        (16.0, 0.0, False, []),
        (0.0, 0.0, True, []),
    ],
)
def test_jerk_of_exact_cubics_is_judged(tmp_path, jerk, ends, stated, kinds):
    """Stated accelerations can make each quintic a cubic, whose jerk is as large as any other."""
    motion = cubic(jerk, ends, stated)
    problem = problem_of(tmp_path, gantry(), motion.positions, ("left", "right"))
    limited = {"acceleration_limits": 10.0, "jerk_limits": 8.0}
    source = {**problem.robot.source, **limited}
    problem = problem.changed(robot=robot_from_source(source))
    found = dry_run(problem, motion)
    assert [str(fault.kind) for fault in found.certificate.faults] == kinds
    contents = record(problem, motion, found)
    assert contents["jerk"].startswith("judged" if stated else "not judged: without accel")
    said = "jerk        not judged" in str(report_of(found, contents))
    assert said == (not stated)
    if stated and jerk:
        jumps = replace(motion, accelerations=motion.accelerations.copy())
        jumps.accelerations[[0, -1], 0] = 1.0
        texts = dry_run(problem, jumps).certificate.reasons
        assert sum("at once by 1 m/s^2 where the motion" in text for text in texts) == 2
