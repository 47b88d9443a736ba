"""Plans do not depend on how many threads the machine would give."""

from threadpoolctl import threadpool_info, threadpool_limits

from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.processes import one_thread
from cvqmpt_lab.search.result import Budget


def test_libraries_have_one_thread_meanwhile_and_what_they_had_afterwards():
    with threadpool_limits(3):
        before = threadpool_info()
        with one_thread():
            assert {library["num_threads"] for library in threadpool_info()} == {1}
        assert threadpool_info() == before


def test_a_learned_path_is_the_same_on_one_thread_and_on_four(problem):
    def states(threads):
        with threadpool_limits(threads):
            return solve(problem, "mpnet", Budget(iterations=300), seed=0).plan.path.states.tobytes()

    assert states(1) == states(4)
