"""Timing of paths, compared with limits and toppra; efforts of motions; refused motions."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from command_line import refused as command_refused
from properties.test_differential import tuning_problems
from refusals import refused, table
from toppra_duration import weak_efforts

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.certificate.certificate import FaultKind
from cvqmpt_lab.features.motion.motion_check import certified_motion, dry_run
from cvqmpt_lab.features.motion.timing import TimingSettings, time_path
from cvqmpt_lab.features.motion.trajectory import (
    Motion,
    bounds,
    extremes,
    quintic,
    read_motion,
    save_trajectory,
)
from cvqmpt_lab.features.plan import Request, plan
from cvqmpt_lab.planning.margins import NO_MARGIN
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.robot.dynamics import Dynamics, without_effort_limit
from cvqmpt_lab.robot.load import load_robot, panda, robot_from_source
from cvqmpt_lab.robot.robot import JointLimits
from cvqmpt_lab.scene.coal_shapes import loads_of
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import Box, Cylinder, PointCloud
from cvqmpt_lab.search.result import Budget, JointPath

FULL = TimingSettings(speed=1.0)
TWO_JOINTS = JointLimits(("first", "second"), np.array([2.0, 1.0]), np.array([4.0, 5.0]))


@pytest.fixture(scope="module")
def solutions():
    """Certified solutions of four tuning problems."""
    return [
        solve(problem, "birrt", Budget(iterations=20_000), seed=0)
        for problem, *_ in tuning_problems(4, 1)
    ]


@pytest.fixture(scope="module")
def paths(solutions):
    return [s.path.states for s in solutions]


@pytest.fixture(scope="module")
def limits(panda):
    return panda.joint_limits


@pytest.fixture(scope="module")
def motion(paths, limits):
    return time_path(paths[0], limits, FULL)


def segment_distances(points, path):
    """Distance of each point (k, n) from a polyline (m, n)."""
    a, d = path[:-1], np.diff(path, axis=0)
    share = np.clip(((points[:, None] - a) * d).sum(-1) / (d**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(points[:, None] - a - share[..., None] * d, axis=-1).min(axis=1)


@pytest.mark.parametrize("deviation", [1e-2, 1e-3, 1e-4])
def test_the_motion_stays_as_close_to_the_path_as_it_says(paths, limits, deviation):
    motion = time_path(paths[1], limits, replace(FULL, deviation=deviation))
    points = motion.at(np.linspace(0.0, motion.duration, 3000)).positions
    furthest = segment_distances(points, paths[1]).max()
    assert 0.2 * motion.deviation < furthest <= 1.001 * motion.deviation <= 1.001 * deviation


def test_a_refused_curve_is_drawn_closer_to_the_path(paths, limits):
    seen = []

    def too_far(motion):
        seen.append(segment_distances(motion.positions, paths[0]).max())
        return ("too far",) if seen[-1] > 2e-4 else ()

    motion = time_path(paths[0], limits, FULL, too_far)
    assert len(seen) > 1 and seen[0] > 2e-4
    assert segment_distances(motion.positions, paths[0]).max() <= 2e-4
    told, never = r"refused even .* rad from it: never", lambda motion: ("never",)
    refused(told, time_path, paths[0], limits, FULL, never)


def test_the_motion_of_a_solution_is_certified_as_its_file_is(solutions):
    """The certificate covers all points; repeated states count once, a path at rest is refused."""
    for found in solutions:
        path = JointPath(np.repeat(found.path.states, 2, axis=0))
        motion = certified_motion(found.problem, path, FULL)
        rates = (motion.velocities, motion.accelerations)
        for stated in (rates[:1], rates):  # controllers follow cubics or quintics
            moving = Motion(motion.joint_names, motion.positions, motion.times, *stated)
            assert dry_run(found.problem, moving).certificate.valid
        np.testing.assert_allclose(motion.positions[[0, -1]], path.states[[0, -1]], atol=1e-12)
    still = JointPath(path.states[:2])
    refused("the path does not move", certified_motion, found.problem, still, FULL)


def test_the_motion_keeps_all_limits_everywhere(paths, limits):
    for states in paths:
        motion, free = (time_path(states, of, FULL) for of in (limits, replace(limits, jerk=None)))
        kinds = (limits.velocity, limits.acceleration, limits.jerk)
        most = [(np.abs(extremes(motion.curve, k)[1]) / of).max() for k, of in enumerate(kinds, 1)]
        assert max(most) <= 1.0 + 1e-4 and max(most) > 0.99
        assert free.duration <= motion.duration <= 1.03 * free.duration
        at_1_khz = motion.at(np.arange(0.0, motion.duration, 1e-3)).accelerations
        assert (np.abs(np.diff(at_1_khz, axis=0)) / 1e-3 <= (1.0 + 1e-4) * limits.jerk).all()


def test_a_motion_has_the_given_velocities_at_its_ends(solutions, limits, motion):
    """It is certified with them, as short as it can be or of a given duration."""
    problem, path = solutions[0].problem, solutions[0].path
    steps = np.diff(path.states, axis=0)[[0, -1]]
    ways = steps / np.linalg.norm(steps, axis=1)[:, None]
    given = np.array([[0.3], [0.2]]) * ways
    settings = TimingSettings(1.0, start_velocity=given[0], end_velocity=given[1])
    quick = certified_motion(problem, path, settings)
    lasting = replace(settings, duration=1.2 * motion.duration)
    slow = time_path(path.states, limits, lasting)
    assert quick.duration < motion.duration
    assert slow.duration == pytest.approx(lasting.duration, abs=1e-6)
    for made in (quick, slow):
        np.testing.assert_allclose(made.velocities[[0, -1]], given, atol=1e-6)
        np.testing.assert_allclose(made.positions[[0, -1]], path.states[[0, -1]], atol=1e-9)
    for off, words in (
        (given[0] + 0.1 * np.eye(7)[5], r"the start velocity is \S+ degrees off the direction"),
        (-given[0], r"the start velocity is 1\.8e\+02 degrees off .*: let the arm stop first"),
        (50.0 * ways[0], r"but with about 0\.\d+ of them"),
        (np.ones(3), "start velocity has 3 values: give 7 finite numbers"),
    ):
        refused(words, time_path, path.states, limits, replace(settings, start_velocity=off))


def test_a_path_goes_straight_on_where_the_arm_moves(problem):
    """It is certified from the given start to a goal that is reached on the move."""
    start, end = 0.2 * np.eye(7)[0], np.array([0.1, 0.2, 0.0, 0.0, 0.0, 0.0, 0.2])
    goals = problem.start + 0.1 * np.ones((1, 7))
    free = problem.changed(
        scene=Scene("none", ()), constraint=(), goal_region=None, goals=goals, attachments=()
    )

    settings = TimingSettings(1.0, start_velocity=start, end_velocity=end)
    motion = plan(
        free, Request("birrt", Budget(iterations=20_000), margin=NO_MARGIN, timing=settings)
    ).motion
    np.testing.assert_allclose(motion.velocities[[0, -1]], [start, end], atol=1e-6)
    np.testing.assert_allclose(motion.positions[[0, -1]], [free.start, goals[0]], atol=1e-9)


def test_jerk_limits_shape_the_motion_and_are_judged(solutions, tmp_path):
    """Lower jerk limits take longer; a motion that starts with an acceleration exceeds them."""
    problem, path = solutions[0].problem, solutions[0].path
    limits = problem.robot.joint_limits
    soft = time_path(path.states, replace(limits, jerk=0.1 * limits.jerk), FULL)
    motion = certified_motion(problem, path, FULL)
    assert 1.02 * motion.duration < soft.duration < 2.0 * motion.duration
    save_trajectory(motion, tmp_path / "motion.json")
    written = read_motion(tmp_path / "motion.json")
    assert dry_run(problem, written).certificate.valid
    written.accelerations[0] = 0.3 * limits.acceleration
    fault, jump = dry_run(problem, written).certificate.faults
    assert fault.kind is FaultKind.JERK and "rad/s^3, its jerk limit is" in fault.text
    assert jump.kind is FaultKind.JERK and "at once by" in jump.text and jump.at == 0.0


def test_another_arm_has_its_urdfs_velocities_and_is_given_accelerations(slider_arm_urdf):
    silent = load_robot(slider_arm_urdf, "tool")
    refused(r"no acceleration limits.*--acceleration", lambda: silent.joint_limits)
    given = load_robot(slider_arm_urdf, "tool", acceleration_limits=[1.0, 2.0, 3.0, 4.0])
    assert given.joint_limits.velocity.tolist() == [1.0] * 4
    assert given.joint_limits.jerk is None
    written = robot_from_source(json.loads(json.dumps(given.source)))
    for again in (written, pickle.loads(pickle.dumps(given))):
        assert again.joint_limits.acceleration.tolist() == [1.0, 2.0, 3.0, 4.0]
    held = {"locked": {"lift": 0.0}, "acceleration_limits": [1.0, 3.0, 4.0]}
    locked = load_robot(slider_arm_urdf, "tool", **held)
    assert locked.joint_limits.joint_names == ("rail", "bend", "twist")


def test_bad_limits_are_named(slider_arm_urdf, tmp_path):
    for values, words in (
        ([1.0, 2.0, 3.0], r"shape \(3,\): give 4 numbers .* rail, lift, bend, twist"),
        ([1.0, 0.0, 3.0, 4.0], r"0\.0 of joint 'lift': give a finite number above 0"),
        ([1.0, 2.0, -3.0, 4.0], r"-3\.0 of joint 'bend'"),
        ([1.0, 2.0, 3.0, np.nan], r"nan of joint 'twist'"),
        ("fast", r"'fast'; it must be a number, or one a joint"),
    ):
        refused(words, load_robot, slider_arm_urdf, "tool", acceleration_limits=values)
    refused("jerk limit 0.0 of joint 'rail'", load_robot, slider_arm_urdf, "tool", jerk_limits=0)
    still = tmp_path / "still.urdf"
    still.write_text(slider_arm_urdf.read_text().replace('velocity="1"', 'velocity="0"', 1))
    arm = load_robot(still, "tool", acceleration_limits=1.0)
    refused(r"velocity limits of 0 for rail: give each <limit>", lambda: arm.joint_limits)


PATH = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.1], [0.3, 0.1]])


def test_bad_waypoints_settings_and_times_are_named(motion):
    for waypoints, words in (
        (PATH[:1], r"shape \(1, 2\): give \(m, n\), two or more"),
        (PATH[[0, 1, 1, 2]], "waypoint 2 repeats waypoint 1"),
        (PATH[[0, 1, 2, 2]], "waypoint 3 repeats waypoint 2"),
        ([[0.0, 0.0], [0.1, 0.0], [0.2, np.nan]], "waypoint 2 has nan at joint index 1"),
        ([[-np.inf, 0.0], [0.1, 0.0]], "waypoint 0 has -inf at joint index 0"),
        (PATH[:, :1], "waypoints have 1 joints, the limits 2: first, second"),
        (PATH[0], r"shape \(2,\)"),
        ([[0.0, 1.0], [0.0]], "not an array of numbers"),
    ):
        refused(words, time_path, waypoints, TWO_JOINTS)
    bad = [(f"speed factor {value}:", {"speed": value}) for value in (0.0, 1.1, np.nan)]
    bad += [(f"deviation {value}:", {"deviation": value}) for value in (0.0, np.nan, np.inf)]
    for words, settings in bad:
        refused(words, time_path, PATH, TWO_JOINTS, TimingSettings(**settings))
    refused("time nan", motion.at, np.nan)
    refused("sampling period nan", motion.sampled, np.nan)


def test_what_cannot_be_timed_names_joint_and_place():
    """Joint 'second' moves only at the end, and its limit is close to 0."""
    path = np.array([[x, max(0.0, x - 1.3)] for x in np.linspace(0.0, 1.5, 16)])
    for kind in ("velocity", "acceleration"):
        slow = replace(TWO_JOINTS, **{kind: np.array([2.0, 1e-13])})
        said = refused(f"joint 'second', {kind} limit 1e-13", time_path, path, slow, FULL)
        waypoint = int(said.partition("(waypoint ")[2].partition(")")[0])
        assert waypoint >= 12, "where it moves"


def test_plan_writes_the_motion_of_a_certified_path(cvqmpt, tmp_path):
    out = tmp_path / "motion.json"
    text = cvqmpt("plan place-task --problem 1 --speed 0.5 --trajectory", out)
    message = json.loads(out.read_text())
    last = message["points"][-1]["time_from_start"]
    line = next(line for line in text.splitlines() if line.startswith("trajectory"))
    assert "at 0.5 of the joint limits" in line and "certified" in line and str(out) in line
    assert float(line.split()[1]) == pytest.approx(last["sec"] + 1e-9 * last["nanosec"], abs=0.01)
    fastest = np.abs([point["velocities"] for point in message["points"]]).max(axis=0)
    assert (fastest / panda().joint_limits.velocity).max() == pytest.approx(0.5, rel=0.01)


@pytest.mark.parametrize("row", table("wrong_motions"), ids=lambda row: row["line"])
def test_what_is_no_motion_is_one_line(tmp_path, capsys, row):
    file = tmp_path / row["name"]
    file.write_text(row["text"])
    assert row["line"] in command_refused(capsys, "certify", file, "place-task")


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path):
    for name, text in (("a.csv", "time,a\n0,1\n"), ("a.json", '{"joints": ["a"], "path": [[1]]}')):
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
        assert read_motion(tmp_path / name).joint_names == ("a",)


def test_complex_states_are_refused(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", q=np.zeros((2**20, 9)))
    told = "a.npz cannot be parsed: it unpacks to 75497600 bytes, at most 67108864 are read"
    refused(told, read_motion, tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", t=np.arange(2.0), q=np.full((2, 7), 1j))
    refused("q is .*1.j.*; it must be numbers", read_motion, tmp_path / "a.npz")


GRAVITY = 9.81


@pytest.fixture(scope="module")
def solution():
    return solve(place_problem(1001, with_can=True), "birrt", Budget(iterations=20_000), seed=0)


def random_motion(robot, seed=0, pieces=6):
    """A random walk of joint states, connected by quintics of 10 ms each."""
    rng = np.random.default_rng(seed)
    steps, v, a = rng.normal(size=(3, pieces + 1, robot.dof))
    q = robot.random_configurations(rng, 1) + np.cumsum(0.01 * steps, axis=0)
    return quintic(0.01 * np.arange(pieces + 1), q, v, 10.0 * a)


def test_what_is_carried_pulls_on_the_joints():
    """The static effort of a load at a joint is the derivative of its potential energy."""
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
    """Compare with second differences of efforts on random quintics; tiago and PR2 slide."""
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
    """Lower effort limits take longer; a motion timed with higher limits then has a fault."""
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
    told = r"joint 'panda_joint\d' needs \d+(\.\d)? of \d+ Nm to stand still"
    refused(told, certified_motion, problem, solution.path, FULL)


def test_what_no_urdf_says_is_named(slider_arm, cvqmpt, capsys):
    assert "no mass of the links of rail, lift, bend, twist" in without_effort_limit(slider_arm)
    assert Dynamics.of(slider_arm) is None
    finger = robot_from_source({"name": "finger"})
    assert "finger_base_to_upper_joint (1000)" in without_effort_limit(finger)
    assert Dynamics.of(finger) is None
    given = robot_from_source({"name": "finger", "effort_limits": 2.0})
    assert without_effort_limit(given) == without_effort_limit(panda()) == ""
    assert "not plausible in the URDF" in cvqmpt("robot finger")
    assert "effort limit -1" in command_refused(capsys, "robot", "finger", "--effort", "-1")


def test_without_efforts_timing_is_as_before(solution):
    """The motion is as fast as without dynamics if no effort is near its limit."""
    states, limits = solution.path.states, solution.problem.robot.joint_limits
    slow = TimingSettings(speed=0.1)
    durations = [
        time_path(states, limits, slow, dynamics=dynamics).duration
        for dynamics in (None, solution.problem.dynamics)
    ]
    assert durations[1] == pytest.approx(durations[0], rel=1e-3)


@pytest.mark.parametrize("amount", [2e-8, 1e-7, 1e-6])
def test_tiny_motions_are_timed_within_the_limits(panda, amount):
    """Their moments lie closer together than windows of averaging tell apart: NaN, a traceback."""
    limits = panda.joint_limits
    start = 0.5 * (panda.lower + panda.upper)
    for speed in (0.1, 1.0):
        settings = TimingSettings(speed=speed)
        motion = time_path(np.array([start, start + amount * np.eye(7)[0]]), limits, settings)
        assert 1e-4 < motion.duration < 0.01 and (np.diff(motion.times) > 0.0).all()
        np.testing.assert_allclose(motion.positions[-1] - start, amount * np.eye(7)[0], atol=1e-15)
        allowed = limits.scaled(speed)
        for order, limit in ((1, allowed.velocity), (2, allowed.acceleration), (3, allowed.jerk)):
            assert (np.abs(extremes(motion.curve, order)[1]) <= 1.01 * limit).all()
