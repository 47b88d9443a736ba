"""Attacks on what a certificate compares and on the numbers that it derives, judged without it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from second_judge import Arm, Judge
from small_arms import beside_a_half_turn, carried, gantry, pendulum, problem_of, turned

from cvqmpt_lab.certificate.certificate import CERTIFICATE_TOLERANCE, certify
from cvqmpt_lab.features.motion.motion_check import dry_run
from cvqmpt_lab.features.motion.trajectory import Motion, Trajectory
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.search.result import JointPath


@pytest.mark.promise(
    "on certified motions, objects in two hands overlap by at most 0.1 mm",
    "cases",
    ci=10,
    long=2000,
)
def test_things_in_two_hands(trials, tmp_path):
    """Boxes of any size in both hands, or at two frames of one arm, on short motions."""
    certified, deep = 0, {}
    for number in range(trials):
        rng = np.random.default_rng(number)
        hands = [("left", "right"), ("left", "wrist"), ("wrist", "right")][number % 3]
        things = [
            carried(name, rng.uniform(0.02, 0.4, 3), rng.uniform(-0.5, 0.5, 3), hand)
            for name, hand in zip(("first", "second"), hands, strict=True)
        ]
        dof = 3 if hands == ("wrist", "right") else 2
        start = rng.uniform(-0.6, 0.6, dof)
        states = np.linspace(start, start + rng.uniform(-0.2, 0.2, dof), 6)
        problem = problem_of(tmp_path, gantry(), states, hands, things)
        if not certify(problem, JointPath(states)).valid:
            continue
        certified += 1
        source = {"urdf": "arm.urdf", "srdf": None, "end_effectors": hands}
        arm = Arm(source, tmp_path, problem.robot.joint_names)
        found = Judge(tmp_path / "problem.json", arm).walk(states)
        deep |= {number: found} if found.depth > 1e-4 else {}
    assert deep == {} and certified >= 0.3 * trials


@pytest.mark.promise(
    "certified motions near a rotation of π keep rotation bounds that contain only positive or "
    "only negative values",
    "cases",
    ci=10,
    long=2000,
)
def test_half_turns(trials, tmp_path):
    """Quaternions that keep their own sign say where a rotation vector changes its sign."""
    certified, left = 0, {}
    for number in range(trials):
        rng = np.random.default_rng(number)
        ends = beside_a_half_turn(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-4, -2.5), number)
        dense = turned(np.linspace(*ends, 4001))
        x = Rotation.from_quat(dense, scalar_first=True).as_rotvec()
        middle, row = x[0], int(np.abs(x[0]).argmax())
        bounds = [[None, None] for _ in range(6)]
        below, above = rng.uniform(0.05, 1.0, 2)
        # an angle beyond pi would bound nothing, and is refused
        bounds[3 + row] = np.clip([middle[row] - below, middle[row] + above], -3.2, 3.2).tolist()
        region = {"T0_w": np.eye(4).tolist(), "Tw_e": np.eye(4).tolist(), "Bw": bounds}
        problem = problem_of(tmp_path, pendulum(), ends, ("part_2",), constraint=[region])
        if not certify(problem, JointPath(ends)).valid:
            continue
        certified += 1
        outside = np.maximum(bounds[3 + row][0] - x[:, row], x[:, row] - bounds[3 + row][1]).max()
        left |= {number: outside} if outside > CERTIFICATE_TOLERANCE + 1e-6 else {}
    assert left == {} and certified >= 0.2 * trials


def off(rng, points, hand):
    """A change (4, 4) of a hand's pose: moved by at most `points` [m], turned by `hand` [rad]."""
    T, way, axis = np.eye(4), *rng.standard_normal((2, 3))
    T[:3, 3] = points * way / np.linalg.norm(way)
    T[:3, :3] = Rotation.from_rotvec(hand * axis / np.linalg.norm(axis)).as_matrix()
    return T


@pytest.mark.promise("hands within what is tolerated keep bounds", "cases", ci=10, long=2000)
def test_tolerated(trials, tmp_path):
    """One hand with a lever, or two hands of which each is off in its own direction."""
    broken, told = {}, 0
    for number in range(trials):
        rng, two = np.random.default_rng(number), number % 2
        bounds = [[-float(b), float(b)] for b in rng.uniform((0.005,) * 3 + (0.05,) * 3, 0.2)]
        bounds[3:] = bounds[3:] if rng.random() < 0.5 else [[None, None]] * 3
        states = np.array([[0.0, 0.0], [0.002, 0.002]]) if two else np.diag((0.0, 0.002, 0.0))[:2]
        T, Tw_e = np.eye(4), np.eye(4)
        Tw_e[:3, 3] = rng.uniform(-0.5, 0.5, 3) * rng.choice([0.0, 1.0])
        T[:3, 3] = (0.0, -1.0, 0.0) if two else (0.0, 0.0, 0.0)
        T0_w = T @ np.linalg.inv(Tw_e)
        region = {"T0_w": T0_w.tolist(), "Tw_e": Tw_e.tolist(), "Bw": bounds}
        region |= {"base": "left", "end_effector": "right"} if two else {}
        given = (gantry(), states, ("left", "right")) if two else (pendulum(), states, ("part_2",))
        problem = problem_of(tmp_path, *given, constraint=[region])
        said = certify(problem, JointPath(states), exact_clearance=True).tolerated
        points, hand = min(said.points_m, 9.0), min(said.hand_rad, 3.0)
        told += points > 0.0
        limits = np.array(bounds, dtype=float)[:, 1]
        for _ in range(20):
            e = T @ off(rng, points, hand)
            b = off(rng, points, hand) if two else np.eye(4)
            D = np.linalg.inv(b @ T0_w) @ e @ np.linalg.inv(Tw_e)
            x = np.concatenate([D[:3, 3], Rotation.from_matrix(D[:3, :3]).as_rotvec()])
            beyond = float(np.nanmax(np.abs(x) - limits))
            broken |= {number: beyond} if beyond > 1e-9 else {}
    assert broken == {} and told >= 0.8 * trials


def third_derivatives(motion, count=200):
    """Of the quintics through all points (pieces, count, n), each from six equations."""
    found, s = [], np.linspace(0.0, 1.0, count)
    for k, h in enumerate(np.diff(motion.times)):
        powers = np.arange(6)
        rows = []
        for t in (0.0, h):
            for order in range(3):
                factor = np.prod([powers - i for i in range(order)], axis=0) * np.ones(6)
                rows.append(factor * t ** np.maximum(powers - order, 0))
        both = (motion.positions, motion.velocities, motion.accelerations)
        wanted = [values[k + end] for end in (0, 1) for values in both]
        c = np.linalg.solve(np.array(rows), np.array(wanted))
        t = s[:, None] * h
        found.append(6.0 * c[3] + 24.0 * c[4] * t + 60.0 * c[5] * t**2)
    return np.array(found)


@pytest.mark.promise("certified motions keep jerk, ends included", "motions", ci=10, long=2000)
def test_jerk(trials, tmp_path):
    """Cubics with their own accelerations, quintics, and motions that begin with a jump."""
    certified, above = 0, {}
    for number in range(trials):
        rng, t = np.random.default_rng(number), 0.25
        jumps = rng.uniform(-1.0, 1.0) * (number % 3 == 2)
        q, v, a = [0.0], [0.0], [jumps]
        pattern = rng.uniform(0.5, 2.0) * np.array([1.0, -1.0, -1.0, 1.0])
        for j in pattern:
            q.append(q[-1] + v[-1] * t + a[-1] * t**2 / 2 + j * t**3 / 6)
            v.append(v[-1] + a[-1] * t + j * t**2 / 2)
            a.append(a[-1] + j * t)
        a, v = np.array(a), np.array(v)
        v[-1] = 0.0
        a[1:-1] += 0.05 * rng.standard_normal(3) * (number % 3 == 1)
        both = (np.outer(values, (1.0, -0.5)) for values in (q, v, a))
        positions, velocities, accelerations = both
        motion = Motion(None, positions, t * np.arange(5.0), velocities, accelerations)
        most = np.abs(third_derivatives(motion)).max()
        limit = float(most * rng.uniform(0.6, 1.6))
        problem = problem_of(tmp_path, gantry(), positions, ("left", "right"))
        source = {**problem.robot.source, "acceleration_limits": 10.0, "jerk_limits": limit}
        problem = problem.changed(robot=robot_from_source(source))
        if dry_run(problem, motion).certificate.valid:
            certified += 1
            ends = np.abs(accelerations[[0, -1]]).max()
            above |= {number: (most, limit)} if most > 1.011 * limit or ends > 0.0101 else {}
    assert above == {} and certified >= 0.2 * trials


@pytest.mark.promise("executions without a fault arrive", "executions", ci=4, long=300)
def test_arrival(trials, tmp_path):
    """Motors from far too weak to strong."""
    pytest.importorskip("mujoco")
    from cvqmpt_lab.features.physics.execute import execute_motion

    late, there = {}, 0
    for number in range(trials):
        rng = np.random.default_rng(number)
        states = np.array([[0.0], [rng.uniform(0.2, 1.0)]])
        problem = problem_of(tmp_path, gantry(), states, ("left",))
        effort = 10.0 ** (-1.0 + 2.0 * (number % 4) / 3.0)
        weak = robot_from_source({**problem.robot.source, "effort_limits": effort})
        problem = problem.changed(robot=weak)
        still = np.zeros_like(states)
        motion = Trajectory(weak.joint_names, np.array([0.0, 1.0]), states, still, still)
        found = execute_motion(problem, motion, "computed-torque")
        away = abs(float(found.samples[-1].q[0] - states[-1, 0]))
        there += away <= 0.05
        late |= {number: away} if away > 0.055 and not found.faults else {}
    assert late == {} and 0 < there < max(trials, 2)
