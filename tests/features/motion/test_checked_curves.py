"""Motions that stand for several curves: every judgement is the worst one of all curves."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cvqmpt_lab import JointState, Motion, PlanningProblem, Scene, judge
from cvqmpt_lab.base.polyline import cut
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.features.motion.judge import clearance_along
from cvqmpt_lab.features.motion.motion_check import dry_run
from cvqmpt_lab.features.moveit_requests.motion_request import judge_request, read_request
from cvqmpt_lab.robot.joint_frames import poses_at_once
from cvqmpt_lab.robot.load import load_robot
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Sphere

NEAR_LINES = [0.3559, -0.0672, 0.7593]  # straight lines come 2.4 mm closer than the spline


@pytest.fixture(scope="module")
def motion(panda):
    """Seven positions; joint 5 steps to 0.36 rad, beyond which its spline goes for a while."""
    turn = np.linspace(0.0, np.pi, 7)
    positions = np.tile([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], (7, 1))
    positions[:, 0] = 0.5 * np.cos(turn)
    positions[:, 3] += 0.5 * np.sin(turn)
    positions[3:, 4] += 0.36
    return Motion(panda.joint_names, positions, 1.5 * np.arange(7.0))


def among(panda, motion, radius):
    """Return the problem of the motion with a ball of a radius [m] near its lines."""
    scene = Scene("ball", (SceneObject("ball", Sphere(radius), pose(NEAR_LINES)),))
    return PlanningProblem("lines", panda, scene, motion.positions[0], motion.positions[-1:])


def asked(kind, robot, states, room):
    """Return path constraints that the lines between states keep with `room` [rad]."""
    if kind == "joint":
        both = dict.fromkeys(("tolerance_above", "tolerance_below"), 0.36 + room)
        return {"joint_constraints": [{"joint_name": "panda_joint5", "position": 0.0, **both}]}
    R = poses_at_once(robot, cut(states, np.full(6, 50)), "panda_link7")[:, :3, :3]
    angles = np.abs(Rotation.from_matrix(R[0].T @ R).as_euler("XYZ")).max(axis=0) + room
    x, y, z, w = Rotation.from_matrix(R[0]).as_quat().tolist()
    axes = [f"absolute_{axis}_axis_tolerance" for axis in "xyz"]
    tilt = {"link_name": "panda_link7", "orientation": {"x": x, "y": y, "z": z, "w": w}}
    return {"orientation_constraints": [tilt | dict(zip(axes, angles.tolist(), strict=True))]}


@pytest.mark.parametrize("kind", ["joint", "euler"])
def test_a_request_is_judged_on_every_curve(tmp_path, panda, motion, kind):
    """The lines come closest to the ball and keep the request; the spline breaks it."""
    problem = among(panda, motion, 0.03)
    assert dry_run(problem, motion, exact_clearance=True).curve == "linear"
    for room, certified in ((0.001, False), (0.2, True)):
        request = {"path_constraints": asked(kind, panda, motion.positions, room)}
        (tmp_path / "r.json").write_text(json.dumps(request))
        made = read_request(tmp_path / "r.json", panda)
        found = judge_request(motion, made, panda, problem.scene, exact=True)[1]
        assert found.certified == certified, found.check.certificate.reasons
    assert found.check.curve == "linear"


def test_slowing_is_no_cure_if_another_curve_collides(panda, motion):
    """The spline exceeds the velocity limit; the lines collide, at any speed."""
    for radius, cured in ((0.03, True), (0.0378, False)):
        judged = judge(motion.at_speed(15.0), among(panda, motion, radius))
        kinds = {fault.kind for fault in judged.check.certificate.faults}
        assert not judged.certified
        assert ("collision" not in kinds) == cured and (judged.speed is not None) == cured


def test_clearances_and_shares_are_the_worst_ones_of_all_curves(panda, motion):
    problem = among(panda, motion, 0.03)
    found = dry_run(problem, motion, exact_clearance=True)
    shares = {use.kind: use.share for use in found.uses}
    (spline,) = found.others
    assert spline.curve == "spline"
    assert shares["velocity"] == max(use.share for use in spline.uses if use.kind == "velocity")
    assert {"acceleration", "effort"} <= shares.keys()
    certificate, other = found.certificate, spline.certificate
    assert certificate.tolerated.points_m <= other.tolerated.points_m
    assert certificate.self_clearance.at_least_m <= other.self_clearance.at_least_m
    nearest = min(row.obstacles_m for row in clearance_along(problem, found, 30))
    alone = min(row.obstacles_m for row in clearance_along(problem, found._replace(others=()), 30))
    assert nearest <= alone


def zigzag(robot, joint, v, seconds=0.5):
    """A motion of positions alone: one joint goes out and back by straight lines at v [rad/s]."""
    middle = 0.5 * (robot.lower + robot.upper)
    steps = v * seconds * np.array([0.0, 1.0, 0.0, 0.5])[:, None] * np.eye(robot.dof)[joint]
    return Motion(robot.joint_names, middle + steps, seconds * np.arange(4.0))


def alone(robot, motion):
    """Return the problem of a motion without obstacles."""
    q = motion.positions
    return PlanningProblem("alone", robot, Scene("empty", ()), q[0], q[-1:])


@pytest.mark.parametrize("name", ["panda", "slider"])
def test_velocities_that_jump_between_straight_lines_are_a_fault(name, panda, slider_arm_urdf):
    """The largest jump is 2 v, where the joint turns back; the spline keeps every limit."""
    robot, joint, unit = panda, 5, "rad/s"
    if name == "slider":
        robot, joint, unit = load_robot(slider_arm_urdf, "tool", acceleration_limits=5.0), 0, "m/s"
    v = 0.2 * robot.joint_limits.velocity[joint]
    motion = zigzag(robot, joint, v)
    judged = judge(motion, alone(robot, motion))
    (fault,) = judged.check.certificate.faults
    assert fault.kind == "velocity_jump" and judged.check.curve == "linear"
    assert f"of {robot.joint_names[joint]} jumps by {2.0 * v:.4g} {unit}" in fault.text
    assert np.interp(fault.at, range(len(judged.check.times)), judged.check.times) == 0.5
    # a quarter of the speed has a quarter of the jump
    assert judged.speed == 0.25 and judge(motion.at_speed(0.24), alone(robot, motion)).certified


def test_smooth_motions_given_at_100_hz_are_certified(panda):
    """Their lines have jumps of at most the acceleration times 10 ms."""
    v = 0.9 * panda.joint_limits.velocity[0]
    rate = 1.9 * panda.joint_limits.acceleration[0] / v
    times = np.arange(0.0, 2.0 * np.pi / rate, 0.01)
    times = np.append(times, 2.0 * np.pi / rate)
    positions = np.tile([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], (len(times), 1))
    positions[:, 0] = 0.5 * v * (times - np.sin(rate * times) / rate)
    motion = Motion(panda.joint_names, positions, times)
    judged = judge(motion, alone(panda, motion))
    assert judged.certified, judged.check.certificate.reasons
    shares = {use.kind: use.share for use in judged.check.uses}
    assert 0.2 < shares["velocity_jump"] < 1.0 and shares["velocity"] > 0.89


def test_a_part_of_a_motion_jumps_from_its_given_velocity(panda):
    q = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    positions = q + 0.5 * np.outer(np.linspace(0.0, 0.3, 16), np.eye(7)[0])
    motion = Motion(panda.joint_names, positions, np.linspace(0.0, 0.3, 16))
    for v, certified in ((0.5, True), (0.1, False)):
        last = JointState(q, v * np.eye(7)[0], np.zeros(7))
        check = judge(motion, alone(panda, motion), last=last).check
        (jump,) = (use for use in check.uses if use.kind == "velocity_jump")
        assert jump.value == pytest.approx(0.5 - v) and check.certificate.valid == certified
