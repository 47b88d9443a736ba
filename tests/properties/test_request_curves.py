"""Motions that a MoveIt request judges, on every curve that a controller may drive through them.

Curves are scipy's splines and polynomials, poses of links those of `second_judge`.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BPoly, CubicHermiteSpline, CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation
from second_judge import Arm

from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.features.moveit_requests.motion_request import judge_request, read_request
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.source import read_source
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Sphere

ROBOTS = ("panda", "ur5", "xarm7", "so-arm101")
LINKS = {"panda": ("panda_hand", "panda_link5"), "ur5": ("tool0", "forearm_link")}
LINKS |= {"xarm7": ("link7", "link4"), "so-arm101": ("gripper_link", "lower_arm_link")}
DENSE = 2000  # moments judged on a curve
JOINTS, TURNS = 3e-6, 5e-4 + 1e-4  # slack on bounds of joints [rad] and of rotations [rad]
AXES = "xyz"


@cache
def arm_of(name):
    """Return a robot with wide limits of rates, and the judge's model of it without bodies."""
    source = {"name": name, "velocity_limits": 4.0, "acceleration_limits": 60.0}
    robot = robot_from_source({**source, "effort_limits": 1e4})
    given = read_source(robot.source)
    locked = {joint.name: joint.value for joint in robot.held_joints}
    fields = {"urdf": given.urdf, "srdf": None, "end_effector": given.end_effector}
    arm = Arm({**fields, "locked": locked}, Path(), robot.joint_names, bodies=False)
    return robot, arm


def drawn_motion(rng, robot, kind):
    """Return a short motion from rest to rest: 0 positions, 1 with velocities, 2 accelerations."""
    count = int(rng.integers(3, 7))
    middle = 0.5 * (np.maximum(robot.lower, -2.0) + np.minimum(robot.upper, 2.0))
    q = middle + rng.uniform(-0.3, 0.3, robot.dof)
    steps = rng.uniform(-0.2, 0.2, (count - 1, robot.dof)) * (rng.random(robot.dof) < 0.7)
    q = np.clip(np.vstack([q, q + np.cumsum(steps, axis=0)]), robot.lower, robot.upper)
    times = np.cumsum([0.0, *rng.uniform(0.7, 3.0, count - 1)])
    v = a = None
    if kind:
        v = rng.uniform(-0.3, 0.3, q.shape)
        v[[0, -1]] = 0.0
    if kind == 2:
        a = rng.uniform(-0.6, 0.6, q.shape)
        a[[0, -1]] = 0.0
    return Motion(robot.joint_names, q, times, v, a, in_seconds=True)


def curves(motion):
    """Return states (DENSE, n) of every curve between the points of a motion, by name."""
    t, q, v, a = motion.times, motion.positions, motion.velocities, motion.accelerations
    moments = np.unique([*np.linspace(t[0], t[-1], DENSE), *t])
    if v is None:
        lines = make_interp_spline(t, q, k=1)(moments)
        return {"spline": CubicSpline(t, q, bc_type="clamped")(moments), "lines": lines}
    found = {"cubic": CubicHermiteSpline(t, q, v)(moments)}
    if a is not None:
        values = np.stack([q, v, a], axis=1)
        found["quintic"] = BPoly.from_derivatives(t, values)(moments)
    return found


def angles(R, vector):
    """Return |entries| (k, 3) of rotation vectors, or of MoveIt's angles: R = Rx(a) Ry(b) Rz(c)."""
    turned = Rotation.from_matrix(R)
    return np.abs(turned.as_rotvec() if vector else turned.as_euler("XYZ"))


def off(rng, largest):
    """Return a bound near a largest value: a little below or above it, or much above."""
    return largest * rng.choice([1.0, 1.0, 1.3]) + rng.choice([-1.0, 1.0, 1.0]) * 10.0 ** (
        rng.uniform(-3.0, -1.5)
    )


def request_for(rng, robot, arm, link, among):
    """Return a request whose bounds are near what one of the curves needs, and these bounds.

    among: states (k, n) of one curve.
    """
    j = int(rng.integers(robot.dof))
    middle = float(among[:, j].mean())
    below, above = (
        max(off(rng, max(float(x.max()), 0.0)), 1e-4)
        for x in (middle - among[:, j], among[:, j] - middle)
    )
    joints = {"joint_name": robot.joint_names[j], "position": middle}
    joints |= {"tolerance_above": above, "tolerance_below": below}
    group, T = arm.frames[link]
    R = (arm.poses(among)[group] @ T)[:, :3, :3]
    desired = R[len(R) // 2] @ Rotation.from_rotvec(rng.normal(0.0, 0.05, 3)).as_matrix()
    vector = int(rng.integers(2))
    largest = angles(desired.T @ R, vector).max(axis=0)
    most = np.array([max(off(rng, x), 1e-3) for x in largest.tolist()])
    most = np.minimum(np.where(rng.random(3) < 0.3, 3.1, most), 3.1)
    orientation = dict(zip("xyzw", Rotation.from_matrix(desired).as_quat().tolist(), strict=True))
    bound = {"link_name": link, "orientation": orientation, "parameterization": vector}
    for axis, value in zip(AXES, most.tolist(), strict=True):
        bound[f"absolute_{axis}_axis_tolerance"] = value
    asked = {}
    if (both := rng.integers(3)) != 1:
        asked["joint_constraints"] = [joints]
    if both:
        asked["orientation_constraints"] = [bound]

    def beyond(states):
        """How far states (k, n) leave the bounds on the joint, and on the link's rotation."""
        x = states[:, j] - middle
        joint = max((x - above).max(), (-below - x).max()) if both != 1 else -1.0
        turned = desired.T @ (arm.poses(states)[group] @ T)[:, :3, :3]
        return joint, (angles(turned, vector) - most).max() if both else -1.0

    return {"path_constraints": asked, "goal_constraints": []}, beyond


@pytest.mark.promise(
    "motions certified by a request keep its bounds on joints and orientations on every curve",
    "motions",
    ci=30,
    long=4000,
)
def test_every_curve_keeps_the_bounds_of_a_request(trials, tmp_path):
    certified, wrong = 0, {}
    for number in range(trials):
        rng, name = np.random.default_rng(number), ROBOTS[number % len(ROBOTS)]
        robot, arm = arm_of(name)
        motion = drawn_motion(rng, robot, number % 3)
        among = curves(motion)
        link = LINKS[name][rng.integers(2)]
        asked, beyond = request_for(rng, robot, arm, link, among[rng.choice([*among])])
        (tmp_path / "request.json").write_text(json.dumps(asked))
        ball = np.eye(4)
        ball[:3, 3] = rng.uniform(-0.8, 0.8, 3)
        scene = Scene("ball", (SceneObject("ball", Sphere(0.02), ball),))
        request = read_request(tmp_path / "request.json", robot)
        found = judge_request(motion, request, robot, scene)[1]
        if not found.certified:
            continue
        certified += 1
        for curve, states in among.items():
            joint, turn = beyond(states)
            if joint > JOINTS or turn > TURNS:
                wrong[number, curve] = joint, turn
    assert wrong == {} and certified >= 0.15 * trials
