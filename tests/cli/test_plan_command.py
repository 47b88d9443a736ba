"""`cvqmpt plan`: a report and a path of a problem, the phases of a task, and refused options."""

import numpy as np
import pytest
from command_line import refused

from cli.main import main
from cvqmpt_lab.tasks.task import PlannedPhase, Task
from experiments.suites.multi_sequence import multi_sequence_task


def test_plan_prints_a_report_and_writes_the_path(capsys, problem_file, problem, tmp_path):
    out = tmp_path / "path.csv"
    words = ["plan", "--problem-file", str(problem_file), "--iterations", "20000", "--save-path", str(out)]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    heads = ["problem", "constraint", "planner", "status", "time", "counts", "length", "certificate", "path"]
    assert [line.split()[0] for line in lines] == heads
    assert lines[3].split() == ["status", "solved"] and " valid " in lines[7]
    assert out.read_text().splitlines()[0] == ",".join(problem.robot.joint_names)
    states = np.loadtxt(out, delimiter=",", skiprows=1)
    np.testing.assert_array_equal(states[[0, -1]], [problem.start, problem.goals[0]])


def test_plan_without_success_exits_with_1_and_writes_no_motion(capsys, tmp_path):
    words = ["plan", "place-task", "--problem", "5", "--iterations", "1"]
    assert main([*words, "--trajectory", str(tmp_path / "motion.csv")]) == 1
    out = capsys.readouterr().out
    assert "iteration_limit: no path found within " in out and "trajectory  none" in out
    assert not (tmp_path / "motion.csv").exists()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ("--optimize 0", "'0' is not a positive number"),
        ("--optimize soon", "--optimize: 'soon'"),
        ("--iterations 500 --optimize 0.05", "knows no clock"),
    ],
)
def test_time_for_a_better_path_is_refused_by_name(capsys, problem_file, options, word):
    assert word in refused(capsys, "plan", "--problem-file", problem_file, *options.split())


def test_command_line(task, tmp_path, capsys):
    task.save(tmp_path / "task.json")
    assert main(["plan", "--task-file", str(tmp_path / "task.json")]) == 0
    out = capsys.readouterr().out
    assert (
        all(phase.name in out for phase in task.phases if isinstance(phase, PlannedPhase)) and "solved" in out
    )
    assert main(["plan", "place-task", "--task-file", str(tmp_path / "task.json")]) == 2
    assert "one of the four" in capsys.readouterr().err
    assert main(["plan", "--task-file", str(tmp_path / "task.json"), "--json"]) == 2
    assert "--json does not go with a task" in capsys.readouterr().err
    assert main(["problems", "export", "multi-sequence", "--problems", "1", "--out", str(tmp_path)]) == 0
    assert Task.load(tmp_path / "multi-sequence-000.json").to_dict() == multi_sequence_task(0).to_dict()
