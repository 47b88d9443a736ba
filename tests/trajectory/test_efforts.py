"""Efforts of motions: what is carried, bounds between samples, limits kept, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from command_line import refused as command_refused
from refusals import refused
from toppra_duration import weak_efforts

from cli.main import main
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.certificate import FaultKind
from cvqmpt_lab.motion_check import certified_motion, dry_run
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.poses import pose
from cvqmpt_lab.robot.dynamics import Dynamics, without_effort_limit
from cvqmpt_lab.robot.load import panda, robot_from_source
from cvqmpt_lab.scene.coal_shapes import loads_of
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Box, Cylinder, PointCloud
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.trajectory.piecewise import bounds, extremes, quintic
from cvqmpt_lab.trajectory.timing import TimingSettings, time_path
from cvqmpt_lab.trajectory.trajectory import Motion

FULL = TimingSettings(speed=1.0)
GRAVITY = 9.81


@pytest.fixture(scope="module")
def solution():
    return solve(place_problem(1001, with_can=True), "birrt", Budget(iterations=20_000), seed=0)


def random_motion(robot, seed=0, pieces=6):
    """Quintics through states that follow each other at random, over 10 ms each."""
    rng = np.random.default_rng(seed)
    steps, v, a = rng.normal(size=(3, pieces + 1, robot.dof))
    q = robot.random_configurations(rng, 1) + np.cumsum(0.01 * steps, axis=0)
    return quintic(0.01 * np.arange(pieces + 1), q, v, 10.0 * a)


def test_what_is_carried_pulls_on_the_joints():
    """Held 1 m above the last joint's axis or beside it, by the work that lifting it takes."""
    robot = panda()
    q = robot.random_configurations(np.random.default_rng(0), 3)
    still = np.zeros_like(q)
    cloud = PointCloud(np.array([[0.1, 0.0, 0.0], [0.3, 0.0, 0.2]]), 0.01)
    for shape, centre in ((Box((0.1, 0.2, 0.3)), 0.0), (Cylinder(0.1, 0.2), 0.0), (cloud, 0.1)):
        item = Attachment("load", shape, pose((0.0, 0.05, 0.3)), mass=2.0)
        loaded, empty = Dynamics.of(robot, loads_of([item])), Dynamics.of(robot)
        pulls = loaded.efforts(q, still, still) - empty.efforts(q, still, still)
        place = np.append(item.T_hand_object[:3, 3] + (2.0 * centre, 0.0, centre), 1.0)

        def height(states, place=place):
            return (robot.poses(states) @ place)[:, 2]

        for j, step in enumerate(1e-5 * np.eye(robot.dof)):
            lifted = (height(q + step) - height(q - step)) / 2e-5
            np.testing.assert_allclose(pulls[:, j], 2.0 * GRAVITY * lifted, atol=1e-5)
    (solid,) = loads_of([Attachment("box", Box((0.1, 0.2, 0.3)), np.eye(4), mass=2.0)])
    sides = np.square([0.1, 0.2, 0.3])
    np.testing.assert_allclose(np.diag(solid.tensor), 2.0 / 12.0 * (sides.sum() - sides))


@pytest.mark.parametrize("name", ["panda", "tiago", "pr2-left"])
def test_efforts_bend_at_most_as_bounded(name):
    """Second differences of efforts on random quintics; tiago and PR2 have sliders."""
    robot = robot_from_source({"name": name})
    dynamics = Dynamics.of(robot)
    curve = random_motion(robot)
    rates = np.array([bounds(curve, order) for order in range(5)])
    bent = dynamics.curvature(rates[0], rates[1:])
    step, tightest = 1e-5, np.zeros(robot.dof)
    for k, begin in enumerate(curve.x[:-1]):
        times = begin + step * np.arange(1, 999)
        efforts = dynamics.efforts(*(curve(times, order) for order in range(3)))
        seen = np.abs(np.diff(efforts, 2, axis=0)).max(axis=0) / step**2
        assert (seen <= bent[k]).all()
        tightest = np.maximum(tightest, seen / bent[k])
    assert tightest.max() > 0.01


def test_bounds_of_polynomials_are_above_their_extremes():
    curve = random_motion(panda())
    for order in range(5):
        most = np.abs(extremes(curve, order)[1]).max(axis=0)
        assert (bounds(curve, order) >= (1.0 - 1e-9) * most).all()
        assert (bounds(curve, order) <= 40.0 * most).all()


def test_a_motion_keeps_its_efforts_and_one_beyond_them_is_refused(solution):
    """Weak motors take longer; what was timed for strong ones is a fault then."""
    problem = solution.problem
    strong = certified_motion(problem, solution.path, FULL)
    efforts = weak_efforts(problem, solution.path.states)
    weak = robot_from_source({"name": "panda", "effort_limits": efforts.tolist()})
    slowly = problem.changed(robot=weak)
    motion = certified_motion(slowly, solution.path, FULL)
    assert motion.duration > 1.01 * strong.duration
    dense = motion.at(np.arange(0.0, motion.duration, 1e-4))
    used = np.abs(problem.dynamics.efforts(*dense)) / efforts
    assert 0.95 < used.max() <= 1.0
    state = (strong.positions, strong.times, strong.velocities, strong.accelerations)
    written = Motion(strong.joint_names, *state)
    assert dry_run(problem, written).certificate.valid
    (fault,) = dry_run(slowly, written).certificate.faults
    assert fault.kind is FaultKind.EFFORT and "Nm, its effort limit is" in fault.text


def test_torque_rates_are_kept_where_they_are_limited(solution):
    problem = solution.problem.changed(
        robot=robot_from_source({"name": "panda", "torque_rate_limits": 1000.0})
    )
    free = certified_motion(solution.problem, solution.path, FULL)
    motion = certified_motion(problem, solution.path, FULL)
    assert motion.duration > 1.1 * free.duration
    efforts = problem.dynamics.efforts(*motion.at(np.arange(0.0, motion.duration, 1e-3)))
    assert 900.0 < np.abs(np.diff(efforts, axis=0)).max() / 1e-3 <= 1010.0
    state = (free.positions, free.times, free.velocities, free.accelerations)
    (fault,) = dry_run(problem, Motion(free.joint_names, *state)).certificate.faults
    assert fault.kind is FaultKind.TORQUE_RATE and "its torque rate limit is 1000" in fault.text


def test_too_heavy_a_load_is_named(solution):
    heavy = replace(solution.problem.attachments[0], mass=15.0)
    problem = solution.problem.changed(attachments=(heavy,))
    told = r"joint 'panda_joint\d' needs \d+(\.\d)? of \d+ Nm standing still"
    refused(told, certified_motion, problem, solution.path, FULL)


def test_what_no_urdf_says_is_named(slider_arm, solution, capsys):
    assert "no mass of what rail, lift, bend, twist moves" in without_effort_limit(slider_arm)
    assert Dynamics.of(slider_arm) is None
    finger = robot_from_source({"name": "finger"})
    assert "finger_base_to_upper_joint (1000)" in without_effort_limit(finger)
    assert Dynamics.of(finger) is None
    given = robot_from_source({"name": "finger", "effort_limits": 2.0})
    assert without_effort_limit(given) == without_effort_limit(panda()) == ""
    assert main(["robot", "finger"]) == 0
    assert "not plausible in the URDF" in capsys.readouterr().out
    assert "effort limit -1" in command_refused(capsys, "robot", "finger", "--effort", "-1")


def test_without_efforts_timing_is_as_before(solution):
    """The same motion as without dynamics where no effort is near its limit."""
    states, limits = solution.path.states, solution.problem.robot.joint_limits
    slow = TimingSettings(speed=0.1)
    durations = [
        time_path(states, limits, slow, dynamics=dynamics).duration
        for dynamics in (None, solution.problem.dynamics)
    ]
    assert durations[1] == pytest.approx(durations[0], rel=1e-3)
