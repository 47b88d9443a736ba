"""`cvqmpt plan --task-file`."""

from cli.main import main
from cvqmpt_lab.tasks.task import PlannedPhase, Task
from experiments.suites.multi_sequence import multi_sequence_task


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
