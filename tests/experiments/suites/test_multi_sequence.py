"""The multi-sequence suite: its tasks differ and repeat."""

import numpy as np

from experiments.suites.multi_sequence import TARGET, TARGET_SIDE, multi_sequence_task


def test_tasks_differ_and_are_drawn_within_the_stated_square():
    tasks = [multi_sequence_task(k) for k in range(4)]
    starts = {tuple(task.start) for task in tasks}
    targets = np.array([task.phases[7].goal.T0_w[:3, 3] for task in tasks])
    assert len(starts) == 4 and len({tuple(target) for target in targets}) == 4
    assert (np.array(TARGET)[:2] <= targets[:, :2]).all()
    assert (targets[:, :2] <= np.array(TARGET)[:2] + TARGET_SIDE).all()
    np.testing.assert_array_equal(tasks[1].start, multi_sequence_task(1).start)
