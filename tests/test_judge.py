"""Judgements of whole motions and of parts that begin on the move."""

import numpy as np
import pytest

from cvqmpt_lab import JointState, Motion, TimingSettings, certified_motion, judge


@pytest.fixture(scope="module")
def plan(solution):
    return certified_motion(solution.problem, solution.path, TimingSettings(speed=0.5))


def chunk(plan, begin, off=0.0):
    """16 positions from a time on, joint 2 off by a parabola [rad]; and the state at that time."""
    times = begin + np.linspace(0.0, 0.3, 16)
    positions = plan.at(times).positions
    positions[:, 1] += off * (times - begin) ** 2
    return Motion(plan.joint_names, positions, times - begin), JointState(*plan.at(begin))


def test_chunks_of_a_policy_are_judged_where_they_begin(plan, problem):
    for begin in (0.0, 0.5, 1.0):
        motion, state = chunk(plan, begin)
        judged = judge(motion, problem, last=state)
        assert judged.certified and judged.speed == 1.0 and judged.first_fault is None
        assert judged.clearance_m > 0.0 and judged.check.uses
    motion, state = chunk(plan, 1.0, off=2.0)
    judged = judge(motion, problem, last=state)
    assert not judged.certified and judged.speed is None
    kinds = {fault.kind for fault in judged.check.certificate.faults}
    assert kinds & {"manifold", "collision"} and judged.first_fault.kind in kinds
    elsewhere = JointState(state.positions + 0.02, *state[1:])
    assert judge(motion, problem, last=elsewhere).first_fault.kind == "current"


def test_a_whole_motion_that_is_too_fast_has_a_speed(plan, problem):
    kinds = (plan.positions, plan.times, plan.velocities, plan.accelerations)
    whole = Motion(plan.joint_names, *kinds)
    assert judge(whole, problem).certified
    fast = judge(whole.at_speed(2.5), problem)
    assert not fast.certified and 0.39 < fast.speed < 0.81
    assert judge(whole.at_speed(2.5 * fast.speed), problem).certified
