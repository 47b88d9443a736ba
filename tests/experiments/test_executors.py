"""Executors: results and errors reach the caller; a lost process costs only its own task."""

import ctypes
import os
import signal
import time
from functools import partial

import pebble
import pytest
from made_rows import untimed
from refusals import refused

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.results.row import FailReason
from cvqmpt_lab.search.result import Budget
from experiments import executors
from experiments import run as runner
from experiments.executors import Lost, dask_cluster, local_processes
from experiments.experiment import Experiment
from experiments.run import executor_for, run_experiment

FOUR = Experiment("place-task", (2, 10), ("birrt",), (0, 1), Budget(iterations=20_000))


def perform(mark, task):
    """Does the task: kills its process (always or once), stops, runs out of memory, or answers."""
    if task == "dies" or (task == "dies once" and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "hangs":
        mark.with_suffix(".pid").write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGSTOP)  # does not hear SIGTERM either
    if task == "holds the interpreter lock":
        ctypes.PyDLL(None).sleep(600)  # as compiled code that never returns
    if task == "too much memory":
        raise MemoryError("Unable to allocate")
    return os.getpid()


@pytest.mark.parametrize("count", [1, 2])
def test_what_dies_hangs_or_eats_memory_costs_its_own_task_only(tmp_path, monkeypatch, count):
    monkeypatch.setattr(pebble.CONSTS, "term_timeout", 0.2)
    tasks = ["answers", "dies", "too much memory", "hangs", "holds the interpreter lock"]
    tasks += ["dies once", "answers", "answers"]
    with local_processes(count, lambda task: 1.0) as executor:
        found = list(executor.results(partial(perform, tmp_path / "mark"), tasks))
    assert sorted(task for task, _ in found) == sorted(tasks)
    lost = {task: result for task, result in found if isinstance(result, Lost)}
    killed = "its process was ended by SIGKILL; perhaps memory ran out, twice"
    hung = FailReason.WORKER_HUNG, "no answer in 1 s; its process was ended"
    assert lost == {
        "dies": (FailReason.WORKER_DIED, killed),
        "hangs": hung,
        "holds the interpreter lock": hung,
        "too much memory": (FailReason.OUT_OF_MEMORY, "Unable to allocate"),
    }
    assert os.getpid() not in [result for task, result in found if task not in lost]
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "mark.pid").read_text()), 0)


def process_id(_):
    return os.getpid()


def test_a_pool_whose_idle_process_is_killed_says_that_the_command_continues():
    with local_processes(1) as executor:
        ((_, pid),) = executor.results(process_id, [0])
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(CvqmptError, match=r"has stopped; .* the same command continues"):
            for _ in range(100):  # until pebble sees it
                list(executor.results(abs, range(3)))
                time.sleep(0.05)


def rows_of(out, executor, on_progress=lambda *_: None):
    return run_experiment(FOUR, out, executor, ["test"], on_progress)


def test_a_cluster_makes_the_rows_of_one_process_though_a_worker_is_killed(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    killed = []
    size = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with (
        distributed.LocalCluster(**size) as machines,
        executor_for(FOUR, 1, machines.scheduler_address) as executor,
    ):
        assert executor.size == 2
        pids = [worker.process.pid for worker in machines.workers.values()]

        def kill_one(done, total, note):
            if done == 1:
                os.kill(pids[0], signal.SIGKILL)
                killed.append(done)

        there = rows_of(tmp_path / "there", executor, kill_one)
        monkeypatch.setattr(runner, "weights_of", lambda *_: {"vq_mpt": "f" * 64})
        other = executor_for(FOUR, 1, machines.scheduler_address)
        refused("has other weights; install the same cvqmpt-lab there", other.__enter__)
    monkeypatch.undo()
    with executor_for(FOUR, 2) as executor:
        here = rows_of(tmp_path / "here", executor)
    assert killed and len(here) == len(there) == 4
    assert [untimed(row) for row in here] == [untimed(row) for row in there]


def test_what_is_no_cluster_is_refused_in_one_line(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(executors, "CONNECT_S", 0.3)
    cluster = partial(dask_cluster, "tcp://127.0.0.1:9", lambda task: 1.0, dict)
    told = r"no Dask scheduler answers at tcp://127.0.0.1:9: .*start one"
    refused(told, cluster().__enter__)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    told = r"not installed: .venv/bin/pip install -c .*'\.\[dask\]'"
    refused(told, cluster().__enter__)
