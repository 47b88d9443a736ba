"""A Dask cluster of two workers gives the rows that one process here gives, even when one of them is killed."""

import os
import signal

import pytest

pytest.importorskip("distributed")

from distributed import LocalCluster

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.planning.result import Budget
from experiments import cluster
from experiments.cluster import dask_cluster
from experiments.run import Experiment, run_experiment
from experiments.trust.determinism import differences

EIGHT = Experiment("place-task", (2, 10), ("birrt",), (0, 1, 2, 3), Budget(iterations=20_000))


def rows_of(out, crew=None, on_progress=lambda *_: None):
    return run_experiment(EIGHT, out, 1, ["test"], on_progress, crew)


def test_rows_are_those_of_one_process_though_a_worker_is_killed(tmp_path, monkeypatch):
    killed = []
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as machines,
        dask_cluster(machines.scheduler_address, EIGHT) as crew,
    ):
        assert crew.size == 2
        pids = [worker.process.pid for worker in machines.workers.values()]

        def kill_one(done, total, note):
            if done == 1:
                os.kill(pids[0], signal.SIGKILL)
                killed.append(done)

        rows = rows_of(tmp_path / "there", crew, kill_one)
        monkeypatch.setattr(cluster, "weights_of", lambda *_: {"vq_mpt": "f" * 64})
        with pytest.raises(InvalidInputError, match="has other weights; install the same cvqmpt-lab there"):
            dask_cluster(machines.scheduler_address, EIGHT).__enter__()
    assert killed and len(rows) == 8
    assert not differences(rows_of(tmp_path / "here"), rows)


def test_what_is_no_cluster_is_refused_in_one_line(monkeypatch):
    monkeypatch.setattr(cluster, "ANSWER_S", 1)
    with pytest.raises(
        InvalidInputError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9: .*start one"
    ):
        dask_cluster("tcp://127.0.0.1:9", EIGHT).__enter__()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InvalidInputError, match=r"not installed: pip install 'cvqmpt-lab\[dask\]'"):
        dask_cluster("tcp://127.0.0.1:9", EIGHT).__enter__()
