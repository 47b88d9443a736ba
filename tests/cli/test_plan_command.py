"""`cvqmpt plan`: what is wrong with a problem file is named; a plan is a short report and a path."""

import json

import numpy as np
import pytest
from command_line import refused

from cli.main import main


@pytest.mark.parametrize("field", ["schema", "name", "robot", "scene", "start"])
def test_a_missing_field_is_named(capsys, problem_file, data, field):
    del data[field]
    problem_file.write_text(json.dumps(data))
    line = refused(capsys, "plan", "--problem-file", problem_file)
    assert str(problem_file) in line and field in line


@pytest.mark.parametrize(
    ("path", "value", "word"),
    [
        (["robot"], 5, "robot"),
        (["robot", "name"], "nope", "'nope'"),
        (["robot", "finger_opening"], "wide", "robot"),
        (["start"], "abc", "start"),
        (["start"], [0.0, 1.0], "start"),
        (["start", 0], float("nan"), "NaN"),
        (["start", 0], 9.0, "panda_joint1 by 6.1"),
        (["goals"], 5, "goals"),
        (["goals", 0, 1], float("nan"), "goals[0, "),
        (["goals", 0], [0.0], "goal"),
        (["goal_region", "T0_w"], 5, "T0_w"),
        (["goal_region", "Bw"], 5, "Bw"),
        (["constraint"], None, "constraint"),
        (["constraint", 0, "Tw_e"], [1.0], "Tw_e"),
        (["constraint", 0, "Bw", 4], [float("nan")] * 2, "Bw"),
        (["attachments"], [{}], "attach"),
        (["scene", "objects", 0, "shape"], {}, "objects[0].shape"),
    ],
)
def test_a_malformed_field_is_named(capsys, problem_file, data, path, value, word):
    *outer, last = path
    place = data
    for key in outer:
        place = place[key]
    place[last] = value
    problem_file.write_text(json.dumps(data))
    assert word in refused(capsys, "plan", "--problem-file", problem_file)


@pytest.mark.parametrize(
    "text",
    [
        *(b"", b"[]", b"null", b'{"a":', b"\xff\xfe\x00"),
        pytest.param(b"[" * 100_000, id="deep"),
        pytest.param(b'{"a":' * 100_000 + b"1" + b"}" * 100_000, id="deep and complete"),
        pytest.param(b'{"start": ' + b"9" * 5000 + b"}", id="a number of 5000 digits"),
    ],
)
@pytest.mark.parametrize("with_robot", [False, True], ids=["own robot", "with --urdf"])
def test_a_file_that_is_no_problem_is_named(capsys, problem_file, slider_arm_urdf, text, with_robot):
    problem_file.write_bytes(text)
    robot = ["--urdf", slider_arm_urdf, "--end-effector", "tool"] if with_robot else []
    assert str(problem_file) in refused(capsys, "plan", "--problem-file", problem_file, *robot)


@pytest.mark.parametrize("field", ["start", "robot", "scene", "constraint", "name"])
def test_a_deeply_nested_field_is_named(capsys, problem_file, data, field):
    """Shallow enough for json, too deep for an array."""
    deep = "[" * 200 + "1" + "]" * 200
    problem_file.write_text(json.dumps({**data, field: "DEEP"}).replace('"DEEP"', deep))
    line = refused(capsys, "plan", "--problem-file", problem_file)
    assert str(problem_file) in line and field in line and len(line) < 1000


def test_a_start_in_collision_names_the_pair(capsys, problem_file, data):
    data["start"][3] = -0.5
    problem_file.write_text(json.dumps(data))
    line = refused(capsys, "plan", "--problem-file", problem_file)
    assert "start is in collision: panda_link" in line and " and extractor_hood" in line


def test_a_goal_off_the_manifold_says_by_how_much(capsys, problem_file, data):
    data["constraint"][0]["Bw"][4] = [0.4, 0.6]
    problem_file.write_text(json.dumps(data))
    line = refused(capsys, "plan", "--problem-file", problem_file)
    assert "start is off the constraint manifold by 0." in line


def test_a_folder_as_output_file_is_refused(capsys, tmp_path):
    assert str(tmp_path) in refused(capsys, "plan", "place-task", "--save-path", tmp_path)


def test_plan_prints_a_report_and_writes_the_path(capsys, problem_file, problem, tmp_path):
    out = tmp_path / "path.csv"
    assert (
        main(["plan", "--problem-file", str(problem_file), "--iterations", "20000", "--save-path", str(out)])
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    heads = ["problem", "constraint", "planner", "status", "time", "counts", "length", "certificate", "path"]
    assert [line.split()[0] for line in lines] == heads
    assert lines[3].split() == ["status", "solved"] and " valid " in lines[7]
    assert out.read_text().splitlines()[0] == ",".join(problem.robot.joint_names)
    states = np.loadtxt(out, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(states[[0, -1]], [problem.start, problem.goals[0]])


def test_plan_without_success_exits_with_1(capsys):
    assert main(["plan", "place-task", "--problem", "5", "--iterations", "1"]) == 1
    assert "iteration_limit: no path found within " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--optimize", "0"), "--optimize: '0' is not a positive number"),
        (("--optimize", "soon"), "--optimize: 'soon'"),
        (
            ("--iterations", "500", "--optimize", "0.05"),
            "--optimize 0.05: a run of --iterations 500 knows no clock",
        ),
    ],
)
def test_time_for_a_better_path_is_refused_by_name(capsys, problem_file, options, word):
    assert word in refused(capsys, "plan", "--problem-file", problem_file, *options)


def test_what_was_gained_is_said(capsys, problem_file):
    assert (
        main(["plan", "--problem-file", str(problem_file), "--iterations", "20000", "--optimize", "40"]) == 0
    )
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("optimize"))
    assert "of 40 iterations" in line and "shorter" in line
