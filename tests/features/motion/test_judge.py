"""Judgements of whole motions and of parts that begin on the move."""

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab import (
    JointState,
    Motion,
    PlanningProblem,
    Scene,
    TimingSettings,
    certified_motion,
    judge,
)
from cvqmpt_lab.robot.load import load_robot


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


def test_points_less_than_a_microsecond_apart_are_judged_up_to_rounding(plan, problem):
    times = np.sort(np.append(plan.times, plan.times[3:40] + 3e-7))
    judged = judge(Motion(plan.joint_names, *plan_at(plan, times)), problem)
    assert judged.certified, judged.check.certificate.reasons
    q, t, v, a = plan_at(plan, plan.times)
    a[len(a) // 2 :: 2] *= -1.0  # accelerations that swing are refused as before
    swinging = judge(Motion(plan.joint_names, q, t, v, a), problem)
    assert not swinging.certified


def plan_at(plan, times):
    """Positions, times, velocities and accelerations of a motion."""
    q, v, a = plan.at(times)
    return q, times, v, a


def extended(plan, extra=("finger",)):
    """The motion with more joints."""
    columns = np.hstack([plan.positions, np.full((len(plan.times), len(extra)), 0.02)])
    return (*plan.joint_names, *extra), columns, plan.times


WRONG = {
    r"is at -?\S+, its limits are .* degrees\? Give radians": lambda plan: (
        (plan.joint_names, np.degrees(plan.positions), plan.times)
    ),
    r"the motion lasts .* are its times in nanoseconds\? Give seconds": lambda plan: (
        (plan.joint_names, plan.positions, 1e9 * plan.times)
    ),
    r"of point 1 repeats that of point 0: times must increase": lambda plan: (
        (plan.joint_names, plan.positions, np.maximum(plan.times, plan.times[1]))
    ),
    r"of point 1 is before that of point 0: times must increase": lambda plan: (
        (plan.joint_names, plan.positions, plan.times[::-1])
    ),
    r"it begins at -1 s": lambda plan: (plan.joint_names, plan.positions, plan.times - 1.0),
    r"one point does not move": lambda plan: (
        (plan.joint_names, plan.positions[:1], plan.times[:1])
    ),
    r"values of time have shape \(6, 1\); positions of \(6, 7\) need \(6,\)": lambda plan: (
        (plan.joint_names, plan.positions[:6], plan.times[:6, None])
    ),
    r"leave out 'finger', fixed joints or ones that follow": extended,
    r"names joint 'panda_joint1' twice": lambda plan: extended(plan, ("panda_joint1",)),
    r"the robot has .*: give the robot that was planned": lambda plan: (
        (plan.joint_names[:6], plan.positions[:, :6], plan.times)
    ),
}


@pytest.mark.parametrize("told", WRONG)
def test_what_was_not_meant_is_one_line(plan, problem, told):
    refused(told, judge, Motion(*WRONG[told](plan)), problem)


def test_a_whole_motion_that_is_too_fast_has_a_speed(plan, problem):
    kinds = (plan.positions, plan.times, plan.velocities, plan.accelerations)
    whole = Motion(plan.joint_names, *kinds)
    assert judge(whole, problem).certified
    fast = judge(whole.at_speed(2.5), problem)
    assert not fast.certified and 0.39 < fast.speed < 0.81
    assert judge(whole.at_speed(2.5 * fast.speed), problem).certified


def test_a_slower_speed_is_certified_where_the_arm_moves_at_the_start(panda):
    """Joint 1 moves towards its limit; slower, with the same velocity, it swings out further."""
    v, found = 0.2 * np.eye(7)[0], []
    for room in (0.0048, 0.5):
        q = np.array([panda.upper[0] - room, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
        positions = q + 0.8 * np.linspace(0.0, 1.0, 8)[:, None] * np.eye(7)[3]
        problem = PlanningProblem("free", panda, Scene("empty", ()), q, q[None])
        state = JointState(q, v, np.zeros(7))
        motion = Motion(panda.joint_names, positions, 0.1 * np.arange(8.0))
        judged = judge(motion, problem, last=state)
        assert judged.check.limits_alone and not judged.certified
        found.append(judged.speed)
    assert found[0] is None and found[1] is not None
    assert judge(motion.at_speed(found[1]), problem, last=state).certified


def test_what_a_slider_does_is_told_in_metres_and_newtons(slider_arm_urdf):
    arm = load_robot(slider_arm_urdf, "tool", acceleration_limits=20.0)
    q = np.full(4, 0.1)
    problem = PlanningProblem("slide", arm, Scene("empty", ()), q, q[None] + 0.3 * np.eye(4)[:1])
    for joint, units in ((0, ["m", "m/s", "m/s^2"]), (1, ["rad", "rad/s", "rad/s^2"])):
        positions = q + 0.3 * np.linspace(0.0, 1.0, 4)[:, None] * np.eye(4)[joint]
        found = judge(Motion(arm.joint_names, positions, 0.07 * np.arange(4.0)), problem)
        uses = {use.unit: use.of for use in found.check.uses[1:]}
        assert uses == dict.fromkeys(units[1:], arm.joint_names[joint])
        (text,) = (text for text in found.check.certificate.reasons if "velocity limit" in text)
        assert f" {units[1]}, its velocity limit is 1" in text
        assert [arm.unit_of(joint, unit) for unit in ("rad", "rad/s", "rad/s^2")] == units
    assert [arm.unit_of(0, unit) for unit in ("Nm", "Nm/s")] == ["N", "N/s"]


def test_a_chunk_without_states_is_not_certified(problem):
    """Not an error of an index, although there is a current state to compare it with."""
    empty = Motion(problem.robot.joint_names, np.empty((0, 7)), np.empty(0))
    judged = judge(empty, problem, last=JointState(*np.zeros((3, 7))))
    assert "states have shape (0, 7)" in judged.first_fault.text


def test_lists_tensors_and_float32_are_judged_like_arrays(plan, problem):
    torch = pytest.importorskip("torch")
    times = np.linspace(0.0, 0.3, 16, dtype=np.float32)
    parts = [part.astype(np.float32) for part in (plan.at(times).positions, times)]
    state = JointState(*plan.at(0.0))
    first = judge(Motion(None, *(part.astype(float) for part in parts)), problem, last=state)
    for form in (np.ndarray.tolist, torch.from_numpy, np.asfortranarray):
        found = judge(Motion(None, *map(form, parts)), problem, last=state)
        np.testing.assert_array_equal(found.check.states, first.check.states)
        assert found.certified == first.certified and found.clearance_m == first.clearance_m
    refused("motion.positions is .* must be numbers", Motion, None, parts[0] + 1j)
    refused("motion.times is .* must be numbers", Motion, None, parts[0], ["now"] * 16)


def test_what_is_no_motion_is_refused(problem):
    path = np.zeros((2, 7))
    refused(r"motion .*give Motion\(joint_names, positions, times\)", judge, path, problem)
    refused("velocities, but no times", Motion, None, path, None, path)


def test_normalised_joints_are_no_degrees(plan, problem):
    """Joint 4 at 100 is outside its limits as degrees, too; LeRobot's values end at 100."""
    shares = (plan.positions - problem.robot.lower) / (problem.robot.upper - problem.robot.lower)
    for positions, told in (
        (200.0 * shares - 100.0, "degrees, or LeRobot's normalised values of -100 to 100"),
        (0.5 * np.degrees(plan.positions), "degrees, or LeRobot's normalised values"),
    ):
        normalised = Motion(plan.joint_names, positions, plan.times)
        refused(f"{told}.* Give radians", judge, normalised, problem)
    refused(told, PlanningProblem.from_dict, problem.to_dict() | {"start": [50.0] * 7})
    away = np.array(plan.positions)
    away[5, 3] += 20.0  # one joint far away is a fault, no unit
    assert not judge(Motion(plan.joint_names, away), problem).certified
