"""Worker processes: answers, errors and ends arrive where the call was made."""

import os
import signal
import time

import pytest

from experiments.workers import WorkerDiedError, WorkerHungError, WorkerPool


def end(path=None):
    if path is None or not path.exists():
        if path is not None:
            path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def test_answers_and_errors_come_from_other_processes():
    with WorkerPool(2) as pool:
        assert list(pool.map(abs, range(-9, 0))) == list(range(9, 0, -1))
        assert pool.submit(os.getpid).result() != os.getpid()
        with pytest.raises(ZeroDivisionError):
            pool.submit(divmod, 1, 0).result()


def test_a_call_whose_process_ended_is_made_once_more_and_others_do_not_notice(tmp_path):
    with WorkerPool(2) as pool:
        others = [pool.submit(abs, -number) for number in range(20)]
        again, twice = pool.submit(end, tmp_path / "once"), pool.submit(end)
        assert again.result() != os.getpid()
        with pytest.raises(WorkerDiedError, match="was ended by SIGKILL; perhaps memory ran out, twice"):
            twice.result()
        assert [future.result() for future in others] == list(range(20))
        assert pool.submit(abs, -1).result() == 1, "a new process took its place"


def test_a_call_that_takes_too_long_is_given_up():
    with WorkerPool(1, seconds=1.0) as pool:
        with pytest.raises(WorkerHungError, match="no answer in 1 s; its process was ended"):
            pool.submit(time.sleep, 600).result()
        assert pool.submit(abs, -1).result() == 1


def test_a_pool_that_is_shut_down_at_once_waits_for_nothing():
    pool = WorkerPool(2)
    calls = [pool.submit(time.sleep, 600) for _ in range(5)]
    began = time.monotonic()
    pool.shutdown(wait=False, cancel_futures=True)
    assert time.monotonic() - began < 60 and all(call.done() for call in calls)
