"""Workers end with the process they work for, even if that ended before they could ask for it."""

import multiprocessing
import os

import pytest

from cvqmpt_lab.processes import end_with_parent


@pytest.mark.parametrize(("off", "code"), [(0, 0), (1, 1)])
def test_a_worker_whose_parent_is_another_by_now_ends_at_once(off, code):
    worker = multiprocessing.get_context("fork").Process(target=end_with_parent, args=(os.getpid() + off,))
    worker.start()
    worker.join(20)
    assert worker.exitcode == code
