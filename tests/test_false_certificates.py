"""Motions that no certificate may call valid: what is compared, at which sign, with which play."""

import numpy as np
import pytest
from small_arms import carried, gantry, problem_of

from cvqmpt_lab.certificate.certificate import Verdict, certify
from cvqmpt_lab.certificate.motion_check import dry_run
from cvqmpt_lab.certificate.record import record, report_lines
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.trajectory.trajectory import Motion


def straight(start, end, step=0.1):
    """States (m, n) on the straight motion between two."""
    count = 2 + int(np.linalg.norm(np.subtract(end, start)) / step)
    return np.linspace(start, end, count)


def lines(problem, states):
    """The certificate's report."""
    motion = Motion(problem.robot.joint_names, states)
    found = dry_run(problem, motion)
    return "\n".join(report_lines(found, record(problem, motion, found)))


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
