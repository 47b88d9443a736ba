"""The multi-sequence suite: its tasks differ, and a run of it continues."""

import numpy as np
import pytest

from cli.main import main
from experiments.suites.multi_sequence import TARGET, TARGET_SIDE, multi_sequence_task


def test_tasks_differ_and_are_drawn_within_the_stated_square():
    tasks = [multi_sequence_task(k) for k in range(4)]
    starts = {tuple(task.start) for task in tasks}
    targets = np.array([task.phases[7].goal.T0_w[:3, 3] for task in tasks])
    assert len(starts) == 4 and len({tuple(target) for target in targets}) == 4
    assert (np.array(TARGET)[:2] <= targets[:, :2]).all()
    assert (targets[:, :2] <= np.array(TARGET)[:2] + TARGET_SIDE).all()
    np.testing.assert_array_equal(tasks[1].start, multi_sequence_task(1).start)


@pytest.mark.slow
def test_reproduce_continues_where_it_was(tmp_path, capsys):
    command = ["reproduce", "multi-sequence", "--problems", "1", "--planners", "birrt", "--jobs", "1"]
    command += ["--out", str(tmp_path)]
    assert main(command) == 0
    first = (tmp_path / "runs.csv").read_bytes()
    assert main(command) == 0
    assert (tmp_path / "runs.csv").read_bytes() == first
    assert "By phase" in (tmp_path / "table.md").read_text()
    assert len(capsys.readouterr().out.splitlines()) <= 15
