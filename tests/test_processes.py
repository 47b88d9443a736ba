"""Workers end with their parent; plans do not depend on the number of threads."""

import multiprocessing
import os

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.processes import end_with_parent, one_thread
from cvqmpt_lab.search.result import Budget


@pytest.mark.parametrize(("off", "code"), [(0, 0), (1, 1)])
def test_a_worker_whose_parent_is_another_by_now_ends_at_once(off, code):
    worker = multiprocessing.get_context("fork").Process(
        target=end_with_parent, args=(os.getpid() + off,)
    )
    worker.start()
    worker.join(20)
    assert worker.exitcode == code


def test_libraries_have_one_thread_meanwhile_and_a_learned_path_is_the_same_on_four(problem):
    with threadpool_limits(3):
        before = threadpool_info()
        with one_thread():
            assert {library["num_threads"] for library in threadpool_info()} == {1}
        assert threadpool_info() == before

    def states(threads):
        with threadpool_limits(threads):
            return solve(
                problem, "mpnet-bridged", Budget(iterations=300), seed=0
            ).plan.path.states.tobytes()

    assert states(1) == states(4)
