"""The command line: bad input is one line and exit code 2, good input is short reports and files."""

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cli.main import COMMANDS, main
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.scene.scene import Scene

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("numba", "scipy", "pinocchio", "coal", "ompl", "rerun", "matplotlib", "torch")


@pytest.fixture(scope="session")
def problem_data(problem):
    """The json form of a place problem with one goal."""
    return problem.with_goals(problem.goals[:1]).to_dict()


@pytest.fixture
def data(problem_data):
    return json.loads(json.dumps(problem_data))


@pytest.fixture
def problem_file(tmp_path, data):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(data))
    return path


@pytest.fixture
def arm_file(tmp_path, slider_arm):
    """A problem without constraint for the slider arm of the tests, in an empty scene."""
    problem = PlanningProblem("reach", slider_arm, Scene("empty", ()), [0.0] * 4, [[0.3, 0.2, -0.4, 1.0]])
    problem.save(tmp_path / "arm.json")
    return tmp_path / "arm.json"


def refused(capsys, *words):
    """The one line on standard error of a command that is refused."""
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert code == 2 and len(lines) == 1 and captured.out == "", (code, captured)
    assert lines[0].startswith("cvqmpt: ")
    return lines[0]


# ---------------------------------------------------------------- unknown choices


@pytest.mark.parametrize(
    ("words", "value", "choice"),
    [
        ("plan place-task --planner nope", "'nope'", "ompl-projected"),
        ("plan nope", "'nope'", "place-task-with-can"),
        ("plan place-task --problem 150", "150", "0 to 149"),
        ("plan place-task --problem -1", "-1", "0 to 149"),
        ("plan place-task --backend nope", "'nope'", "compiled, exact"),
        ("plan place-task --seed -1", "-1", "0 or more"),
        ("plan", "--problem-file", "place-task"),
        ("plan place-task --problem-file x", "--problem-file", "one of the three"),
        ("plan --problem-file /nope", "/nope", "No such file"),
        ("plan place-task --save /nope/x.rrd", "/nope", "does not exist"),
        ("plan place-task --save-path /nope/x.csv", "/nope", "does not exist"),
        ("reproduce nope", "'nope'", "place-task"),
        ("figure nope", "'nope'", "histogram, concept"),
        ("reproduce place-task --planners birrt,nope", "'nope'", "ompl-projected"),
        ("reproduce place-task --planners ,", "planners", "at least one"),
        ("problems nope place-task", "'nope'", "list, export"),
        ("problems list nope", "'nope'", "place-task-with-can"),
        ("problems export place-task", "--out", "DIR"),
        ("table /nope", "/nope", "not a directory"),
        ("bench nope", "'nope'", "kernels"),
        ("check-tables --expected /nope", "/nope", "check-tables --update"),
    ],
)
def test_unknown_choices_name_the_value_and_the_valid_ones(capsys, words, value, choice):
    line = refused(capsys, *words.split())
    assert value in line and choice in line


@pytest.mark.parametrize(
    "words",
    [
        "nope",
        "plan place-task --cutoff nan",
        "plan place-task --cutoff -1",
        "plan place-task --cutoff inf",
        "plan place-task --iterations 0",
        "plan place-task --problem one",
        "reproduce place-task --problems 0",
        "reproduce place-task --seeds x",
        "reproduce place-task --jobs 0",
        "plan place-task --nope",
        "plan place-task --cutoff ten",
        "plan place-task --seed",
        "warmup nope",
        "bench",
        "table",
    ],
)
def test_malformed_options_are_one_line_that_names_the_value_and_the_help(capsys, words):
    line = refused(capsys, *words.split())
    command = " ".join(["cvqmpt", *[word for word in words.split()[:1] if word in COMMANDS]])
    assert words.split()[-1] in line and f"{command} --help" in line


# ---------------------------------------------------------------- problem files


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


# ---------------------------------------------------------------- output directories


def test_a_directory_with_rows_of_another_run_is_refused_and_kept(capsys, tmp_path):
    words = [
        "reproduce",
        "place-task",
        "--problems",
        "1",
        "--planners",
        "birrt",
        "--jobs",
        "1",
        "--out",
        str(tmp_path),
    ]
    assert main([*words, "--iterations", "20000"]) == 0
    capsys.readouterr()
    before = (tmp_path / RUNS_FILE).read_bytes()
    assert "iterations was 20000, now 9" in refused(capsys, *words, "--iterations", "9")
    assert (tmp_path / RUNS_FILE).read_bytes() == before and len(read_rows(tmp_path / RUNS_FILE)) == 1


@pytest.mark.parametrize("out", ["/dev/null", "/dev/null/x"])
def test_a_directory_that_cannot_be_made_is_refused(capsys, out):
    assert out in refused(capsys, "reproduce", "place-task", "--problems", "1", "--out", out)
    assert out in refused(capsys, "problems", "export", "place-task", "--problems", "1", "--out", out)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_directory_is_refused(capsys, tmp_path):
    tmp_path.chmod(0o555)
    assert "read-only" in refused(capsys, "reproduce", "place-task", "--problems", "1", "--out", tmp_path)


def test_an_unknown_backend_of_an_experiment_is_refused(capsys, tmp_path):
    out = tmp_path / "out"
    assert "'nope'" in refused(
        capsys, "reproduce", "place-task", "--problems", "1", "--backend", "nope", "--out", out
    )
    assert not out.exists()


def test_a_folder_as_output_file_is_refused(capsys, tmp_path):
    assert str(tmp_path) in refused(capsys, "plan", "place-task", "--save-path", tmp_path)


# ---------------------------------------------------------------- what works


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
    assert "iteration_limit" in capsys.readouterr().out


def test_exported_problems_are_planned_from_their_files(capsys, tmp_path):
    assert main(["problems", "export", "place-task", "--problems", "1", "--out", str(tmp_path)]) == 0
    (path,) = tmp_path.iterdir()
    assert path.name == "place-task-000.json" and PlanningProblem.load(path).goal_region is not None
    assert main(["plan", "--problem-file", str(path), "--iterations", "20000"]) == 0


def test_problems_are_listed(capsys):
    assert main(["problems", "list", "place-task", "--problems", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["0:", "1:", "2"]


def test_reproduce_names_the_files_it_wrote(capsys, tmp_path):
    words = ["reproduce", "place-task", "--problems", "1", "--planners", "birrt", "--jobs", "1"]
    assert main([*words, "--iterations", "20000", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    for name in ("runs.csv", "table.md", "table.tex", "table.csv"):
        assert (tmp_path / name).is_file() and name in out
    assert str(tmp_path / "table.md") in out and "birrt" in out


@pytest.mark.parametrize(
    ("bench", "figure"),
    [("kernels", "projection, uniform sample"), ("unconstrained", "random scenes: first path")],
)
def test_benches_print_their_figures_and_write_them(capsys, tmp_path, bench, figure):
    """That they run; times are nobody's pass or fail."""
    out = tmp_path / "figures.json"
    assert main(["bench", bench, "--problems", "1", "--states", "50", "--json", str(out)]) == 0
    lines, figures = capsys.readouterr().out.splitlines(), json.loads(out.read_text())
    assert [line.split("  ")[0] for line in lines] == [item["name"] for item in figures]
    assert figures[0]["name"].startswith("calibration") and figure in [item["name"] for item in figures]
    assert all(0.0 < item["low"] <= item["median"] <= item["high"] for item in figures if item["unit"] != "%")
    assert [path.name for path in tmp_path.iterdir()] == ["figures.json"]


# ---------------------------------------------------------------- a robot of one's own


def test_a_robot_of_the_problem_file_is_replaced(capsys, arm_file, slider_arm_urdf):
    data = json.loads(arm_file.read_text())
    del data["robot"]  # the file may leave it to the command line
    arm_file.write_text(json.dumps(data))
    robot = ["--urdf", str(slider_arm_urdf), "--end-effector", "tool"]
    assert main(["plan", "--problem-file", str(arm_file), *robot, "--iterations", "20000"]) == 0
    assert "robot slider_arm" in capsys.readouterr().out


def test_joints_are_locked(capsys, arm_file, slider_arm_urdf):
    data = json.loads(arm_file.read_text())
    data["start"], data["goals"] = data["start"][1:], [data["goals"][0][1:]]
    arm_file.write_text(json.dumps(data))
    words = ["plan", "--problem-file", arm_file, "--urdf", slider_arm_urdf, "--end-effector", "tool"]
    assert "robot slider_arm needs (4,)" in refused(capsys, *words)
    words += ["--lock", "rail=0.2", "--iterations", "20000"]
    assert main([str(word) for word in words]) == 0


def test_options_alone_speak_of_the_files_own_robot_whose_path_is_seen_from_the_file(
    capsys, arm_file, slider_arm_urdf
):
    data = json.loads(arm_file.read_text())
    (arm_file.parent / "arm.urdf").write_bytes(slider_arm_urdf.read_bytes())
    data["robot"] = {"urdf": "arm.urdf", "end_effector": "tool", "locked": {"rail": data["start"][0]}}
    data["start"], data["goals"] = data["start"][1:], [data["goals"][0][1:]]
    arm_file.write_text(json.dumps(data))
    words = ["plan", "--problem-file", str(arm_file), "--iterations", "20000"]
    assert main(words) == 0
    assert main([*words, "--acceleration", "2", "--trajectory", str(arm_file.parent / "t.csv")]) == 0
    capsys.readouterr()
    assert "robot slider_arm needs (2,)" in refused(capsys, *words, "--lock", "bend=0")


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["--urdf", "URDF", "--end-effector", "nope"], "unknown end-effector frame 'nope'"),
        (["--urdf", "URDF"], "--end-effector FRAME"),
        (["--urdf", "/nope.urdf", "--end-effector", "tool"], "/nope.urdf"),
        (["--end-effector", "nope"], "unknown end-effector frame 'nope'"),
        (["--lock", "rail=0"], "robot slider_arm needs (3,)"),
        (["--urdf", "URDF", "--end-effector", "tool", "--lock", "nope=0"], "unknown joint to lock 'nope'"),
        (["--urdf", "URDF", "--end-effector", "tool", "--lock", "rail"], "JOINT=VALUE"),
        (["--urdf", "URDF", "--end-effector", "tool", "--lock", "rail=nan"], "finite number"),
        (["--urdf", "URDF", "--end-effector", "tool", "--srdf", "/nope.srdf"], "/nope.srdf"),
    ],
)
def test_a_bad_robot_is_refused_by_name(capsys, arm_file, slider_arm_urdf, words, found):
    words = [str(slider_arm_urdf) if word == "URDF" else word for word in words]
    assert found in refused(capsys, "plan", "--problem-file", arm_file, *words)


def test_a_robot_goes_with_a_problem_file(capsys, slider_arm_urdf):
    words = ["--urdf", slider_arm_urdf, "--end-effector", "tool"]
    assert "--problem-file" in refused(capsys, "plan", "place-task", *words)


# ---------------------------------------------------------------- help


def test_help_is_fast_and_imports_nothing_heavy():
    script = (
        "import sys; from cli.main import main\ntry: main(['--help'])\nfinally: print(sorted(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    modules = done.stdout.splitlines()[-1]
    assert "'argparse'" in modules and not [name for name in HEAVY if f"'{name}'" in modules]
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "cli.main", "--help"], cwd=ROOT, capture_output=True, check=True
        )
        seconds.append(time.perf_counter() - began)
    assert statistics.median(seconds) < 1.5, "aim: 0.5 s; the rest is for busy machines"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_examples(capsys, command):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    out = capsys.readouterr().out
    assert end.value.code == 0 and "examples:\n  cvqmpt " in out


def test_as_a_process_an_error_is_one_line_without_traceback():
    done = subprocess.run(
        [sys.executable, "-m", "cli.main", "plan", "nope"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1
