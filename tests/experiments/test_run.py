"""The runner and its executors: equal rows for any processes, interruptions and continuations."""

import ctypes
import os
import signal
import time
from dataclasses import replace
from functools import partial

import pebble
import pytest
from command_line import start
from made_rows import differences
from refusals import refused

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, RunStoreError
from cvqmpt_lab.benchmarks.results.provenance import ProvenanceFile
from cvqmpt_lab.benchmarks.results.row import (
    RUNS_FILE,
    FailReason,
    read_rows,
    sorted_rows,
    write_rows,
)
from cvqmpt_lab.benchmarks.results.store import PARTIAL_FILE, directory_rows
from cvqmpt_lab.experiments import executors
from cvqmpt_lab.experiments import run as runner
from cvqmpt_lab.experiments.executors import Limit, Lost, dask_cluster, local_processes
from cvqmpt_lab.experiments.experiment import Experiment, weights_of
from cvqmpt_lab.experiments.run import executor_for, run_experiment
from cvqmpt_lab.paper_tables.rendering import render_directory
from cvqmpt_lab.planning.warm_up import compile_kernels
from cvqmpt_lab.search.result import Budget

ENOUGH = Budget(iterations=20_000)
ONE = Experiment("place-task", (2,), ("birrt",), (0,), ENOUGH)
FOUR = replace(ONE, problems=(2, 10), planners=("birrt", "guided-birrt"))


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Compile before the fork, so that workers need not load the kernels."""
    compile_kernels(lambda *_: None)


def run(experiment, out, jobs=1, on_progress=lambda *_: None):
    with executor_for(experiment, jobs) as executor:
        return run_experiment(experiment, out, executor, ["test"], on_progress)


def keys(rows):
    return [(row.problem, row.planner, row.seed) for row in rows]


@pytest.fixture(scope="module")
def four_rows(tmp_path_factory):
    return run(FOUR, tmp_path_factory.mktemp("four"))


def test_rows_are_sorted_complete_and_those_of_two_processes(four_rows, tmp_path):
    assert keys(four_rows) == [(p, n, 0) for p in ("2", "10") for n in ("birrt", "guided-birrt")]
    assert four_rows == sorted_rows(four_rows)
    assert all(row.solved and row.certified and row.path_sha256 for row in four_rows)
    assert differences(run(FOUR, tmp_path, jobs=2), four_rows) == []


class Killed(BaseException):
    """Exception that stands for an interruption of a run."""


def test_an_interrupted_run_keeps_its_rows_and_continues_without_duplicates(four_rows, tmp_path):
    def interrupt(done, total, note):
        if done == 2:
            raise Killed

    with pytest.raises(Killed):
        run(FOUR, tmp_path, on_progress=interrupt)
    kept = read_rows(tmp_path / RUNS_FILE)
    assert len(kept) == 2 and not (tmp_path / PARTIAL_FILE).exists()
    seen = []
    rows = run(FOUR, tmp_path, on_progress=lambda done, total, note: seen.append((done, total)))
    assert seen == [(2, 4), (3, 4), (4, 4)]
    assert [row for row in rows if row in kept] == kept, "finished rows were measured anew"
    assert differences(rows, four_rows) == []
    assert read_rows(tmp_path / RUNS_FILE) == rows
    before = (tmp_path / RUNS_FILE).read_bytes()
    assert run(FOUR, tmp_path) == rows and (tmp_path / RUNS_FILE).read_bytes() == before


def test_larger_experiments_add_rows_and_others_are_refused(tmp_path, monkeypatch):
    first = run(replace(ONE, planners=("roadmap-cvq",)), tmp_path)
    larger = replace(ONE, planners=("birrt", "roadmap-cvq"))
    both = run(larger, tmp_path)
    assert len(first) == 1 and both[1] == first[0]
    assert keys(both) == [("2", "birrt", 0), ("2", "roadmap-cvq", 0)]
    assert ProvenanceFile(tmp_path).read()["weights"] == weights_of(larger.planners)
    other, told = replace(larger, budget=Budget(iterations=7)), "iterations was 20000, now 7.*--out"
    refused(told, run, other, tmp_path, error=RunStoreError)
    monkeypatch.setattr(runner, "weights_of", lambda planners, model: {"vq_mpt": "f" * 64})
    told = rf'weights.vq_mpt was "\w+", now "{"f" * 64}"'
    refused(told, run, larger, tmp_path, error=RunStoreError)
    assert read_rows(tmp_path / RUNS_FILE) == both


def test_a_lost_run_is_a_failure_row_and_is_not_tried_again(tmp_path, monkeypatch):
    plan = runner.outcome_of

    def outcome_of(run, item, seconds):
        if run.experiment.budget == ENOUGH and run.item == 10:  # the warm-up has another budget
            os.kill(os.getpid(), signal.SIGKILL)
        if run.experiment.budget == ENOUGH and run.item == 25:
            raise ZeroDivisionError("by nothing")
        return plan(run, item, seconds)

    monkeypatch.setattr(runner, "outcome_of", outcome_of)
    three = replace(ONE, problems=(2, 10, 25))
    rows = run(three, tmp_path, jobs=2)
    assert [row.fail_reason for row in rows] == [None, "worker_died", "planner_error"]
    assert rows[2].detail == "ZeroDivisionError: by nothing"
    assert run(three, tmp_path) == rows


def test_an_error_in_a_worker_is_the_error_of_the_run(tmp_path, monkeypatch):
    def refuse(run, item, seconds):
        raise InvalidInputError("weights are for another robot")

    monkeypatch.setattr(runner, "outcome_of", refuse)
    refused("another robot", run, FOUR, tmp_path, jobs=2)
    refused("at least one of seeds", replace, FOUR, seeds=())


@pytest.mark.slow
def test_an_interrupt_leaves_no_worker_and_a_run_that_the_same_command_continues(tmp_path):
    options = ("--problems", 4, "--planners", "birrt", "--seeds", 30, "--iterations", 20_000)
    # children of a shell in the background ignore Ctrl-C
    hear_ctrl_c = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    words = ("reproduce", "place-task", *options, "--jobs", 2, "--out", tmp_path)
    started = start(words, hear_ctrl_c)
    rows_so_far = tmp_path / PARTIAL_FILE
    while not rows_so_far.is_file() or rows_so_far.read_bytes().count(b"\n\n") < 2:
        assert started.poll() is None, "the run ended before it could be interrupted"
        time.sleep(0.02)
    os.killpg(started.pid, signal.SIGINT)  # what Ctrl-C in a terminal does
    error = started.communicate(timeout=30)[1]
    assert started.returncode == 130 and "Traceback" not in error
    assert error.splitlines()[-1].startswith("cvqmpt: interrupted; finished results are kept")
    time.sleep(1.0)
    with pytest.raises(ProcessLookupError):
        os.killpg(started.pid, 0)
    kept = read_rows(tmp_path / RUNS_FILE)
    assert 2 <= len(kept) < 120 and len(set(keys(kept))) == len(kept)
    last = max(kept, key=lambda row: row.seed)
    rows = run(replace(ONE, problems=(int(last.problem),), seeds=(last.seed, 30)), tmp_path)
    assert len(rows) == len(kept) + 1 and [row for row in rows if row in kept] == kept


SEEDS = replace(ONE, problems=(2, 10), seeds=(0, 1))


def perform(mark, task):
    """Perform a task: kill the process (always or once), hang, use up memory, or answer."""
    if task == "dies" or (task == "dies once" and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "hangs":
        mark.with_suffix(".pid").write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGSTOP)  # does not hear SIGTERM either
    if task == "holds the interpreter lock":
        ctypes.PyDLL(None).sleep(600)  # as compiled code that never returns
    if task == "never ends":
        while True:
            pass
    if task == "waits a little":  # longer than the processor time that it may use
        time.sleep(1.5)
    if task == "too much memory":
        raise MemoryError("Unable to allocate")
    return os.getpid()


@pytest.mark.parametrize("count", [1, 2])
def test_what_dies_hangs_or_eats_memory_costs_its_own_task_only(tmp_path, monkeypatch, count):
    monkeypatch.setattr(pebble.CONSTS, "term_timeout", 0.2)
    tasks = ["answers", "dies", "too much memory", "hangs", "holds the interpreter lock"]
    tasks += ["dies once", "never ends", "waits a little", "answers", "answers"]
    with local_processes(count, lambda task: Limit(1.0, 2.0)) as executor:
        found = list(executor.results(partial(perform, tmp_path / "mark"), tasks))
    assert sorted(task for task, _ in found) == sorted(tasks)
    lost = {task: result for task, result in found if isinstance(result, Lost)}
    killed = "its process was ended by SIGKILL; perhaps memory ran out, twice"
    hung = FailReason.WORKER_HUNG, "it used no processor for 2 s; its process was ended"
    busy = FailReason.WORKER_HUNG, "no answer in 1 s of processor time; its process was ended"
    assert lost == {
        "dies": (FailReason.WORKER_DIED, killed),
        "hangs": hung,
        "holds the interpreter lock": hung,
        "never ends": busy,
        "too much memory": (FailReason.OUT_OF_MEMORY, "Unable to allocate"),
    }
    assert os.getpid() not in [result for task, result in found if task not in lost]
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "mark.pid").read_text()), 0)


def test_a_run_that_the_guard_ended_counts_nowhere_and_runs_again(tmp_path):
    whole = run(FOUR, tmp_path)
    ended = {"fail_reason": FailReason.WORKER_HUNG, "detail": "no answer in 1 s of processor time"}
    lost = replace(whole[0], solved=False, certified=None, path_sha256=None, **ended)
    write_rows(tmp_path / RUNS_FILE, [lost, *whole[1:]])
    assert len(directory_rows(tmp_path)) == len(whole) - 1
    table = render_directory(tmp_path).texts["table.md"]
    assert f"1 runs that the guard of processor time ended, such as {lost.planner}" in table
    again = run(FOUR, tmp_path)
    assert differences(again, whole) == []
    assert "guard" not in render_directory(tmp_path).texts["table.md"]


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


def test_a_cluster_makes_the_rows_of_one_process_though_a_worker_is_killed(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    killed = []
    size = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with (
        distributed.LocalCluster(**size) as machines,
        executor_for(SEEDS, 1, machines.scheduler_address) as executor,
    ):
        assert executor.size == 2
        pids = [worker.process.pid for worker in machines.workers.values()]

        def kill_one(done, total, note):
            if done == 1:
                os.kill(pids[0], signal.SIGKILL)
                killed.append(done)

        there = run_experiment(SEEDS, tmp_path / "there", executor, ["test"], kill_one)
        monkeypatch.setattr(runner, "weights_of", lambda *_: {"vq_mpt": "f" * 64})
        other = executor_for(SEEDS, 1, machines.scheduler_address)
        refused("has other weights; install the same cvqmpt-lab there", other.__enter__)
    monkeypatch.undo()
    here = run(SEEDS, tmp_path / "here", jobs=2)
    assert killed and len(here) == len(there) == 4 and differences(here, there) == []


def test_what_is_no_cluster_is_refused_in_one_line(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(executors, "CONNECT_S", 0.3)
    cluster = partial(dask_cluster, "tcp://127.0.0.1:9", lambda task: Limit(1.0), dict)
    told = r"no Dask scheduler answers at tcp://127.0.0.1:9: .*start one"
    refused(told, cluster().__enter__)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    told = r"not installed: .venv/bin/pip install -c .*'\.\[dask\]'"
    refused(told, cluster().__enter__)


def test_more_processes_than_a_machine_can_bear_are_refused(tmp_path):
    """A million of them were started, one after another, without an end."""
    most = max(64, 4 * os.cpu_count())
    refused(f"jobs 1000000: give a whole number from 1 to {most}", run, FOUR, tmp_path, jobs=10**6)
