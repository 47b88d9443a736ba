"""`cvqmpt plan`: what is wrong with a problem file is named; a plan is a short report and a path."""

import numpy as np
import pytest
from command_line import refused

from cli.main import main


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
