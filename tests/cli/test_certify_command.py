"""`cvqmpt certify`: intact solutions pass; changed ones are refused and the change is named."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import refused
from numpy.polynomial import Polynomial
from refusals import DATA

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.benchmarks.place_task import SHELF_DOOR, carried_can
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, read_rows, write_rows
from cvqmpt_lab.benchmarks.results.store import PATHS_FILE, states_hash, stored_paths
from cvqmpt_lab.certificate import between_states
from cvqmpt_lab.cli.main import main
from cvqmpt_lab.constraints.task_space_region import displacements
from cvqmpt_lab.experiments.experiment import Experiment
from cvqmpt_lab.experiments.run import executor_for, run_experiment
from cvqmpt_lab.features.motion.motion_check import with_limits_of
from cvqmpt_lab.features.motion.timing import TimingSettings, time_path
from cvqmpt_lab.features.motion.trajectory import as_csv, as_ros_json, read_motion, save_trajectory
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.source import ARMS, example_robots
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Sphere
from cvqmpt_lab.search.result import Budget, JointPath

MIDDLE = 40


def save(path, states):
    np.savetxt(path, states, delimiter=",", fmt="%.17g")


@pytest.fixture(scope="module")
def states(solution):
    return solution.path.states


@pytest.fixture(scope="module")
def trajectory(problem, states):
    return time_path(states, problem.robot.joint_limits, TimingSettings(speed=1.0))


@pytest.fixture(scope="module")
def region_problem(problem):
    """The problem with its goal region alone."""
    return replace(problem, goals=np.empty((0, 7)))


@pytest.fixture
def judged(tmp_path, region_problem, capsys):
    """Certify states or text against a problem; return the exit code and the printed json."""

    def judge(what, problem=None, name="motion.csv", options=()):
        if isinstance(what, str):
            (tmp_path / name).write_text(what)
        else:
            save(tmp_path / name, what)
        (problem or region_problem).save(tmp_path / "problem.json")
        files = [str(tmp_path / name), str(tmp_path / "problem.json")]
        code = main(["certify", *files, "--json", *options])
        return code, json.loads(capsys.readouterr().out)

    return judge


def test_paths_in_every_form_are_certified(judged, states, region_problem):
    names = list(region_problem.robot.joint_names)
    header = ",".join(names) + "\n"
    rows = [q.tolist() for q in states]
    backwards = {"joint_names": names[::-1], "states": [q[::-1] for q in rows]}
    forms = {
        "a.csv": header + "\n".join(",".join(map(repr, q)) for q in rows),
        "b.json": json.dumps(rows),
        "c.json": json.dumps({"joint_names": names, "states": rows}),
        "d.json": json.dumps({"path": rows}),
        "e.json": json.dumps(backwards),
    }
    for name, text in forms.items():
        code, found = judged(text, name=name)
        assert code == 0 and found["valid"] and found["faults"] == []
        assert found["unproven_rad"] == 0.0
    assert found["min_clearance_m"] > 0.0 and found["states_checked"] > 10


def test_what_is_not_proven_is_not_certified(judged, states, monkeypatch):
    monkeypatch.setattr(between_states, "CUTS", 0)
    code, found = judged(states)
    (fault,) = found["faults"]
    assert code == 1 and not found["valid"] and found["verdict"] == "not proven"
    assert fault["kind"] == "not_proven" and fault["state"] is not None
    told = "off the manifold by 0 rad, 0 m at the checked states, not proven to be less than"
    assert fault["text"].startswith(told)


def test_the_record_says_what_was_compared_and_where_it_was_closest(judged, region_problem, states):
    far = SceneObject("far", Sphere(0.1), pose((9.0, 0.0, 0.0)))
    scene = replace(region_problem.scene.with_objects(far), unseen=0.38)
    problem = replace(region_problem, scene=scene, attachments=(carried_can(),))
    found, robot = judged(states, problem)[1], problem.robot
    counts = found["compared"]
    assert counts["obstacles"] == len(problem.scene.obstacles) and "far" in counts["out_of_reach"]
    assert counts["unseen"] == 0.38 and "38% of the arm's reach is unseen" in counts["notes"][-1]
    assert counts["moving_pieces"] + counts["standing_pieces"] == len(robot.links)
    hand = [pair["first"] for pair in counts["left_out"] if pair["second"] == "carried_can"]
    held_by = ("panda_hand", "panda_left", "panda_right", "panda_link7")
    assert all(name.startswith(held_by) for name in hand)
    assert len(counts["left_out"]) == len(robot.left_out_pairs) + len(hand)
    assert counts["own_pairs"] == len(robot.self_collision_pairs) + len(robot.links) - len(hand)
    places = np.arange(len(states))
    q = [np.interp(found["min_clearance_at"], places, column) for column in states.T]
    distance, pair = problem.collision_checker().nearest(np.array(q))
    assert distance == pytest.approx(found["min_clearance_m"], abs=1e-9)
    assert str(pair) == found["min_clearance_pair"]


def until(state, direction, reached):
    """Return the state moved along a direction until `reached(q)`, by at most 0.6 rad."""
    low, high = 0.0, 0.6
    assert reached(state + high * direction) and not reached(state)
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if reached(state + middle * direction) else (middle, high)
    return state + high * direction


def tilted(problem, states):
    """One state with the hand tilted by 0.101 rad; its neighbours are unchanged."""
    region, bent = problem.constraint[0], states.copy()

    def tilt(q):
        return np.abs(displacements(problem.robot, region, q[None])[0, region.bounded_rows]).max()

    bent[MIDDLE] = until(states[MIDDLE], np.eye(7)[6], lambda q: tilt(q) >= 0.101)
    assert tilt(bent[MIDDLE]) == pytest.approx(0.101, abs=1e-6)
    return bent


def inside_by_1_mm(problem, states):
    """Move one state sideways until it collides by 1 mm."""
    checker, moved = problem.collision_checker(), states.copy()
    aside = states[20:] + 0.6 * np.eye(7)[0]
    k = next(k for k, q in enumerate(aside, 20) if checker.clearance(q) < -1e-3)
    moved[k] = until(states[k], np.eye(7)[0], lambda q: checker.clearance(q) <= -1e-3)
    return moved


def changed(states, index, by):
    tampered = states.copy()
    tampered[index] = tampered[index] + by
    return tampered


def beyond_limit(problem, states):
    return changed(states, (MIDDLE, 6), problem.robot.upper[6] + 1e-3 - states[MIDDLE, 6])


TAMPERED = {
    "a tilt of 0.101 rad": (tilted, "manifold", MIDDLE),
    "a state 1 mm inside a shelf": (inside_by_1_mm, "collision", None),
    "a limit passed by 1e-3": (beyond_limit, "limits", MIDDLE),
    "a jump": (lambda p, s: np.delete(s, range(MIDDLE, MIDDLE + 12), axis=0), "step", MIDDLE - 1),
    "a state repeated later": (lambda p, s: np.insert(s, 52, s[MIDDLE], axis=0), "step", 52),
    "nan": (lambda p, s: changed(s, MIDDLE, np.nan), "shape", MIDDLE),
    "infinity": (lambda p, s: changed(s, MIDDLE, np.inf), "shape", MIDDLE),
    "a start moved by 1e-5": (lambda p, s: changed(s, 0, 1e-5), "start", 0),
    "reversed": (lambda p, s: s[::-1], "start", 0),
    "cut short": (lambda p, s: s[:-5], "goal", -1),
    "of another robot": (lambda p, s: s[:, :6], "shape", None),
}


@pytest.mark.parametrize("how", TAMPERED)
def test_what_was_tampered_with_is_refused_and_found(judged, problem, states, how):
    tamper, kind, place = TAMPERED[how]
    tampered = tamper(problem, states)
    code, found = judged(tampered)
    (fault,) = [fault for fault in found["faults"] if fault["kind"] == kind]
    assert code == 1 and not found["valid"]
    if place is not None:
        assert abs(fault["state"] - (place if place >= 0 else len(tampered) - 1)) <= 1.0


def test_a_path_into_a_closed_door_or_to_a_goal_2_mm_away_is_refused(
    judged, region_problem, states
):
    scene, region = region_problem.scene, region_problem.goal_region
    code, found = judged(states, replace(region_problem, scene=scene.with_joint(SHELF_DOOR, 0.0)))
    assert code == 1 and any("door_left" in fault["text"] for fault in found["faults"])
    moved = replace(region, T0_w=region.T0_w @ pose((0.0, 0.0, 2e-3)))
    code, found = judged(states, replace(region_problem, goal_region=moved))
    assert code == 1 and [fault["kind"] for fault in found["faults"]] == ["goal"]


@pytest.mark.parametrize(("form", "name"), [(as_csv, "motion.csv"), (as_ros_json, "motion.json")])
def test_a_trajectory_is_dry_run(judged, trajectory, states, form, name):
    here = " ".join(map(repr, (states[0] + 0.009).tolist()))
    code, found = judged(form(trajectory), name=name, options=["--current", here])
    assert code == 0 and found["valid"] and 0.0 < found["apart_m"] < 1e-4
    away = " ".join(map(repr, (states[0] + 0.011 * np.eye(7)[2]).tolist()))
    options = ["--current", away]
    code, found = judged(form(trajectory), name=name, options=options)
    assert code == 1 and [fault["kind"] for fault in found["faults"]] == ["current"]
    assert "panda_joint3 stands 0.011" in found["faults"][0]["text"]
    options += ["--tolerance", "0.02"]
    assert judged(form(trajectory), name=name, options=options)[0] == 0


def test_a_trajectory_that_swings_out_between_its_points_is_refused(judged, trajectory):
    """Positions are intact; a wrong velocity of one point makes the cubic leave the path."""
    velocities = trajectory.velocities.copy()
    middle = len(velocities) // 2
    velocities[middle] += 1.5 * np.eye(7)[0]
    code, found = judged(as_csv(replace(trajectory, velocities=velocities)))
    (fault,) = [fault for fault in found["faults"] if fault["kind"] == "acceleration"]
    assert code == 1 and abs(fault["time_s"] - trajectory.times[middle]) < 0.1


@pytest.fixture(scope="module")
def jerky_panda(panda):
    """The panda from its URDF, which limits no jerk: motions may begin with an acceleration."""
    arm, robots = ARMS["panda"], example_robots()
    source = {"urdf": str(robots / arm.urdf), "srdf": str(robots / arm.srdf)}
    source |= {"end_effector": arm.end_effector, "locked": dict(arm.locked)}
    return robot_from_source(
        {**source, "acceleration_limits": panda.limits["acceleration"].tolist()}
    )


@pytest.mark.parametrize(
    ("acceleration", "code", "curve"),
    [(None, 0, "cubic"), (0.0, 0, "quintic"), (6.02, 1, "quintic")],
)
def test_accelerations_that_are_not_the_cubics_are_judged_as_quintics(
    judged, jerky_panda, acceleration, code, curve
):
    """Joint 1 swings by 0.3 rad above a board; the quintic turns joint 2 down by 0.234 rad."""
    panda = jerky_panda
    start = np.array([0.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
    goal = start + 0.3 * np.eye(7)[0]
    hand = panda.pose(start)[:3, 3]
    board = SceneObject("board", Box((0.6, 2.0, 0.02)), pose((hand[0], 0.0, hand[2] - 0.2)))
    problem = PlanningProblem("swing", panda, Scene("board", (board,)), start, goal[None])
    mean = 0.3 / 1.5 * np.eye(7)[0]
    a = np.array([6.0 * mean / 1.5, -6.0 * mean / 1.5 + (acceleration or 0.0) * np.eye(7)[1]])
    kinds = ("position", "velocity", "acceleration")[: 2 if acceleration is None else 3]
    rows = np.column_stack([(0.0, 1.5), (start, goal), np.zeros((2, 7)), a][: 1 + len(kinds)])
    header = ["time", *(f"{name}_{kind}" for kind in kinds for name in panda.joint_names)]
    lines = [",".join(header), *(",".join(map(repr, map(float, row))) for row in rows)]
    found = judged("\n".join(lines), problem)
    assert (found[0], found[1]["curve"]) == (code, curve)
    assert [fault["kind"] for fault in found[1]["faults"]] == ["collision"] * code


def test_limits_of_the_file_stand_in_for_those_that_the_robot_lacks(
    judged, region_problem, trajectory, jerky_panda, panda, tmp_path
):
    limits = replace(panda.joint_limits, acceleration=1e3, effort=np.full(7, np.inf))
    save_trajectory(trajectory, tmp_path / "motion.json", limits)
    problem = replace(region_problem, robot=jerky_panda)
    limited = with_limits_of(problem, read_motion(tmp_path / "motion.json")).robot
    assert limited.limits["jerk"].tolist() == panda.limits["jerk"].tolist()
    np.testing.assert_array_equal(
        limited.joint_limits.acceleration, jerky_panda.limits["acceleration"]
    )
    code, found = judged((tmp_path / "motion.json").read_text(), problem, name="motion.json")
    assert code == 0 and found["jerk"] == "judged"
    assert "limits of jerk are those in the file of the motion" in found["compared"]["notes"]
    wrong = json.loads((tmp_path / "motion.json").read_text())
    for row, told in ([-1.0] * 7, "jerk is .* numbers above 0"), ([1.0], "give 7 numbers or null"):
        wrong["limits"]["jerk"] = row
        (tmp_path / "motion.json").write_text(json.dumps(wrong))
        with pytest.raises(InvalidInputError, match=told):
            read_motion(tmp_path / "motion.json")


@pytest.mark.parametrize(("share", "code"), [(1.0025, 1), (1.0005, 0)])
def test_a_speed_is_judged_at_its_peak(judged, jerky_panda, share, code):
    """Joint 1 moves at v(u) = u^2 (1 - u) (1 + 4.49 u), scaled, of u = t / 4 s.

    Its peak lies in the middle between two of 33 samples; the largest of these is 0.23 % lower.
    """
    panda = jerky_panda
    v = Polynomial([0, 0, 1]) * Polynomial([1, -1]) * Polynomial([1, 4.49])
    v *= share * panda.joint_limits.velocity[0] / v(0.73457)
    start = np.array([-2.0, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8])
    goal = start + 4.0 * v.integ()(1.0) * np.eye(7)[0]
    problem = PlanningProblem("sweep", panda, Scene("empty", ()), start, goal[None])
    points = [{"positions": q.tolist(), "velocities": [0.0] * 7} for q in (start, goal)]
    for point, sec, a in zip(points, (0, 4), (0.0, v.deriv()(1.0) / 4.0), strict=True):
        point |= {"accelerations": [a, *[0.0] * 6], "time_from_start": {"sec": sec}}
    text = json.dumps({"joint_names": panda.joint_names, "points": points})
    found = judged(text, problem, "motion.json")
    faults = found[1]["faults"]
    assert (found[0], len(faults)) == (code, code), faults
    assert all(f["kind"] == "velocity" and abs(f["time_s"] - 2.94) < 0.02 for f in faults)


@pytest.mark.parametrize(("part", "words"), [(slice(40), "ends"), (slice(40, None), "begins")])
def test_a_trajectory_that_begins_or_ends_on_the_move_is_refused(
    judged, region_problem, trajectory, part, words
):
    """Both halves of a trajectory that was cut while the arm moved."""
    kinds = ("times", "positions", "velocities", "accelerations")
    half = replace(trajectory, **{kind: getattr(trajectory, kind)[part] for kind in kinds})
    problem = replace(region_problem, start=half.positions[0], goals=half.positions[-1:])
    code, found = judged(as_csv(half), problem)
    assert code == 1 and {fault["kind"] for fault in found["faults"]} == {"velocity", "jerk"}
    assert all(f"where the motion {words}" in fault["text"] for fault in found["faults"])
    assert found["limits_hold_at_speed"] is None
    # as a part of a longer motion, with the velocity where it begins
    begin = (" ".join(map(repr, kind[0].tolist())) for kind in (half.positions, half.velocities))
    options = ["--part", "--current", next(begin), "--start-velocity", next(begin)]
    assert judged(as_csv(half), region_problem, options=options)[0] == 0


def test_positions_with_times_are_judged_as_spline_and_as_lines(judged, trajectory):
    """Between points of a dense motion both are close to it; half of the time breaks limits."""
    lines = as_csv(trajectory.sampled(0.01)).splitlines()
    positions = [line.split(",")[:8] for line in lines]
    positions[0] = [name.removesuffix("_position") for name in positions[0]]
    for row in positions[1:]:
        row[0] = repr(float(row[0]) / 0.7)
    code, found = judged("\n".join(map(",".join, positions)))
    assert (code, found["faults"]) == (0, []) and found["curve"] in ("spline", "linear")
    for row in positions[1:]:
        row[0] = repr(0.5 * float(row[0]))
    code, found = judged("\n".join(map(",".join, positions)))
    assert code == 1 and found["curve"] == "spline"
    assert {"velocity", "acceleration"} <= {fault["kind"] for fault in found["faults"]}
    slower = found["limits_hold_at_speed"]
    assert 0.5 < slower < 0.9
    for row in positions[1:]:
        row[0] = repr(float(row[0]) / slower)
    assert judged("\n".join(map(",".join, positions)))[0] == 0


def test_clearance_along_time_is_written(judged, trajectory, tmp_path):
    out, page = tmp_path / "clearance.csv", tmp_path / "motion.html"
    files = ["--save", str(out), "--save", str(page)]
    _, found = judged(as_csv(trajectory), options=files)
    shown = page.read_text()
    assert "certificate certified" in shown and f"{trajectory.duration:.1f} s" in shown
    assert '"title": "clearance [mm]"' in shown
    head, *rows = (line.split(",") for line in out.read_text().splitlines())
    assert head == ["at", "obstacles_m", "obstacles", "itself_m", "itself"] and len(rows) == 200
    assert float(rows[0][0]) == 0.0 and float(rows[-1][0]) == trajectory.duration
    least = min(min(float(row[1]), float(row[3])) for row in rows)
    assert found["min_clearance_m"] - 1e-6 <= least <= found["min_clearance_m"] + 2e-3


def test_times_are_those_of_the_file(judged, trajectory, tmp_path):
    """A motion whose times begin at 100 s has the same report, 100 s later."""
    out, page = tmp_path / "clearance.csv", tmp_path / "motion.html"
    files = ["--save", str(out), "--save", str(page)]
    kinds = ("times", "velocities", "accelerations")
    scaled = zip(kinds, (0.5, 2.0, 4.0), strict=True)
    fast = replace(trajectory, **{kind: x * getattr(trajectory, kind) for kind, x in scaled})
    (_, begun), (_, later) = (
        judged(as_csv(replace(fast, times=begin + fast.times)), options=files)
        for begin in (0.0, 100.0)
    )
    for kind in ("faults", "limits"):
        assert begun[kind]
        for one, other in zip(begun[kind], later[kind], strict=True):
            assert other["kind"] == one["kind"]
            assert other["time_s"] == pytest.approx(100.0 + one["time_s"], abs=1e-6)
    rows = [line.split(",")[0] for line in out.read_text().splitlines()[1:]]
    ends = [100.0, 100.0 + 0.5 * trajectory.duration]
    assert [float(rows[0]), float(rows[-1])] == pytest.approx(ends)
    shown = page.read_text()
    assert f"trajectory of {0.5 * trajectory.duration:.3f} s" in shown
    seconds = json.loads(shown.partition('"seconds": ')[2].partition(",")[0])
    assert seconds == pytest.approx(max(0.5 * trajectory.duration, 1.0))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--save", "a.txt"], "--save a.txt: suffix '.txt'; valid choices: .html, .csv"),
        (["--part"], "--part: a part of a motion begins where the arm is: give --current"),
        (["--start-velocity", "1 2"], "--start-velocity has 2 numbers; give 7"),
        (["--end-velocity", "1 2 fast"], "--end-velocity '1 2 fast': write numbers"),
    ],
)
def test_wrong_ends_are_one_line(capsys, tmp_path, trajectory, options, told):
    (tmp_path / "a.csv").write_text(as_csv(trajectory))
    assert told in refused(capsys, "certify", tmp_path / "a.csv", "place-task", *options)


def test_a_path_has_no_velocity(capsys, tmp_path, states):
    save(tmp_path / "a.csv", states)
    options = ["--start-velocity", " ".join("0" * 7)]
    told = refused(capsys, "certify", tmp_path / "a.csv", "place-task", *options)
    assert "--start-velocity goes with a trajectory" in told


def test_the_report_says_where_a_path_leaves_the_manifold_in_short_lines(tmp_path, states, cvqmpt):
    save(tmp_path / "bent.csv", changed(states, MIDDLE, 0.5 * np.eye(7)[5]))
    save(tmp_path / "far.csv", [states[0], states[0] + 1e300])
    bent, far = (
        cvqmpt("certify", tmp_path / f"{name}.csv", "place-task", code=1)
        for name in ("bent", "far")
    )
    assert all(said.startswith("certificate not certified: refused;") for said in (bent, far))
    assert "off the manifold by" in bent and "at state 40" in bent
    assert len(far.splitlines()) == 3 and max(map(len, far.splitlines())) < 120


def test_a_trajectory_with_times_that_go_back_or_in_other_units_is_one_line(
    tmp_path, capsys, trajectory
):
    lines, kinds = as_csv(trajectory).splitlines(), ("positions", "accelerations")
    times, velocities = trajectory.times / 1000.0, trajectory.velocities * 1000.0
    quick = replace(trajectory, times=times, velocities=velocities)
    ends = {kind: getattr(trajectory, kind)[[0, -1]] for kind in kinds}
    ends |= {"times": np.array([0.0, 1000.0]), "velocities": np.full((2, 7), 20.0)}
    swinging = replace(trajectory, **ends)
    for text, words in (
        ("\n".join([lines[0], lines[2], lines[1]]), "increase"),
        (as_csv(quick), "are units right"),
        (as_csv(swinging), "straight pieces; at most 100000"),
    ):
        (tmp_path / "a.csv").write_text(text)
        assert words in refused(capsys, "certify", tmp_path / "a.csv", "place-task")


def test_every_path_of_a_run_is_judged_again_from_its_rows(tmp_path, cvqmpt, capsys):
    experiment = Experiment("place-task", (2, 10), ("birrt",), (0,), Budget(iterations=20_000))
    with executor_for(experiment, 1) as executor:
        run_experiment(experiment, tmp_path, executor, ["test"], lambda *_: None)
    told = cvqmpt("certify", tmp_path)
    assert told == "2 paths, 2 certified, 0 not certified, 0 differ from their rows\n"

    rows = read_rows(tmp_path / RUNS_FILE)
    kept = dict(stored_paths(tmp_path))
    bent = kept[rows[0].path_sha256].copy()
    bent[10] += 0.05
    forged = replace(rows[0], path_sha256=states_hash(bent), path_length_rad=JointPath(bent).length)
    write_rows(tmp_path / RUNS_FILE, [forged, rows[1]])
    np.savez_compressed(tmp_path / PATHS_FILE, **kept, **{states_hash(bent): bent})
    assert main(["certify", str(tmp_path)]) == 1
    assert "2 birrt seed 0: certified in the row, not certified now: " in capsys.readouterr().err

    for forged, told in (
        ({"path_sha256": None, "path_length_rad": 0.5}, "certified in the row, without a path"),
        ({"min_clearance_m": 0.5}, "min_clearance_m is 0.5 in the row, 0.0"),
        ({"obstacle_clearance_m": 0.5}, "obstacle_clearance_m is 0.5 in the row, "),
        ({"self_clearance_m": 0.5}, "self_clearance_m is 0.5 in the row, "),
        ({"max_violation_rad": 0.3}, "max_violation_rad is 0.3 in the row, "),
        ({"max_violation_m": 0.0003}, "max_violation_m is 0.0003 in the row, "),
    ):
        write_rows(tmp_path / RUNS_FILE, [replace(rows[0], **forged), rows[1]])
        assert main(["certify", str(tmp_path)]) == 1
        captured = capsys.readouterr()
        assert f"2 birrt seed 0: {told}" in captured.err and ", 1 differ" in captured.out
    write_rows(tmp_path / RUNS_FILE, [*rows, replace(rows[0], t_plan_s=0.1)])
    twice = refused(capsys, "certify", tmp_path)
    assert "line 3: problem 2, planner birrt, seed 0 is in line 2, too" in twice

    write_rows(tmp_path / RUNS_FILE, [replace(rows[0], path_sha256="0" * 64), rows[1]])
    assert main(["certify", str(tmp_path)]) == 1
    assert "2 birrt seed 0: its path is not kept" in capsys.readouterr().err
    (tmp_path / PATHS_FILE).write_bytes(b"PK" + 50 * b"x")
    assert "paths.npz is damaged" in refused(capsys, "certify", tmp_path)


def test_the_digest_of_a_problem_is_also_of_the_bodies_in_its_robot_file(tmp_path, cvqmpt):
    """The json names the file of a robot; an arm with thinner links had the same digest."""
    text = (DATA / "slider_arm.urdf").read_text()
    path, digests = tmp_path / "arm.urdf", []
    path.write_text(text)
    robot = robot_from_source({"urdf": str(path), "end_effector": "tool"})
    start = 0.5 * (robot.lower + robot.upper)
    problem = PlanningProblem("p", robot, Scene("s", ()), start=start, goals=start[None] + 0.01)
    problem.save(tmp_path / "p.json")
    save(tmp_path / "path.csv", [start, start + 0.01])
    for content in (text, text.replace('radius="0.0', 'radius="0.00'), text):
        path.write_text(content)
        words = [tmp_path / "path.csv", tmp_path / "p.json", "--json"]
        digests.append(json.loads(cvqmpt("certify", *words))["problem_sha256"])
    assert digests[0] == digests[2] != digests[1]
    # the same files in another folder are the same problem
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("arm.urdf", "p.json", "path.csv"):
        copied = (tmp_path / name).read_text().replace(str(tmp_path), str(elsewhere))
        (elsewhere / name).write_text(copied)
    words = [elsewhere / "path.csv", elsewhere / "p.json", "--json"]
    assert json.loads(cvqmpt("certify", *words))["problem_sha256"] == digests[0]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--clearance", "0.1"], "--clearance goes with a problem; the hand of a task touches"),
        (["--topic", "/plan"], "--topic goes with"),
        (["--tolerance", "0.1"], "--tolerance goes with one motion; a task states where"),
    ],
)
def test_the_motions_of_a_task_refuse_options_of_one_motion(tmp_path, capsys, options, told):
    (tmp_path / "task.json").write_text("{}")
    words = [tmp_path, DATA / "task-1.json", *options]
    assert told in refused(capsys, "certify", *words)


def test_a_problem_in_the_place_of_the_motion_is_named(capsys, problem_file, tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("0,0,0,0,0,0,0\n")
    told = refused(capsys, "certify", problem_file, path)
    assert f"the motion comes first: cvqmpt certify {path} {problem_file}" in told
    (tmp_path / "task.json").write_text('{"task": "t", "steps": []}')
    index = tmp_path / "list.json"
    index.write_text('{"task": "t", "steps": []}')
    assert "lists the motions of a task; give its folder" in refused(capsys, "certify", index)
