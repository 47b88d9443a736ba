"""The runner: equal rows for any number of processes, interruptions and continuations."""

import os
import signal
import time
from dataclasses import replace
from functools import partial

import pytest
from command_line import start
from made_rows import differences
from refusals import refused

from cvqmpt_lab.errors import CvqmptError, InvalidInputError, RunStoreError
from cvqmpt_lab.results.provenance import ProvenanceFile
from cvqmpt_lab.results.row import RUNS_FILE, read_rows, sorted_rows
from cvqmpt_lab.results.store import PARTIAL_FILE
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.warm_up import compile_kernels
from experiments import run as runner
from experiments.experiment import Experiment, weights_of
from experiments.run import executor_for, run_experiment

ENOUGH = Budget(iterations=20_000)
ONE = Experiment("place-task", (2,), ("birrt",), (0,), ENOUGH)
FOUR = replace(ONE, problems=(2, 10), planners=("birrt", "guided-birrt"))


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Compile before the fork, so that workers need not load the kernels."""
    compile_kernels(lambda _: None)


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
    """Stands for any end of a run."""


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


def test_a_larger_experiment_adds_to_the_rows_and_another_budget_is_refused(tmp_path):
    first = run(ONE, tmp_path)
    both = run(replace(ONE, seeds=(0, 1)), tmp_path)
    assert len(first) == 1 and both[0] == first[0]
    assert keys(both) == [("2", "birrt", 0), ("2", "birrt", 1)]
    other, told = replace(ONE, budget=Budget(iterations=7)), "iterations was 20000, now 7.*--out"
    refused(told, run, other, tmp_path, error=RunStoreError)
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


def test_bad_experiments_are_refused_by_name():
    for values, words in (
        ({"suite": "x"}, "unknown suite 'x'"),
        ({"planners": ("birrt", "x")}, "unknown planner 'x'"),
        ({"problems": (2, 150)}, "unknown problem 150.*0 to 149"),
        ({"seeds": ()}, "at least one of seeds"),
    ):
        refused(words, replace, FOUR, error=CvqmptError, **values)


@pytest.mark.slow
def test_an_interrupt_leaves_no_worker_and_a_run_that_the_same_command_continues(tmp_path):
    options = ("--problems", 4, "--planners", "birrt", "--seeds", 30, "--iterations", 20_000)
    # a shell in the background makes its children deaf to Ctrl-C
    hear_ctrl_c = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    started = start(
        ("reproduce", "place-task", *options, "--jobs", 2, "--out", tmp_path), hear_ctrl_c
    )
    rows_so_far = tmp_path / PARTIAL_FILE
    while not rows_so_far.is_file() or rows_so_far.read_bytes().count(b"\n\n") < 2:
        assert started.poll() is None, "the run ended before it could be interrupted"
        time.sleep(0.02)
    os.killpg(started.pid, signal.SIGINT)  # what Ctrl-C in a terminal does
    error = started.communicate(timeout=30)[1]
    assert started.returncode == 130 and "Traceback" not in error
    assert error.splitlines()[-1].startswith("cvqmpt: interrupted; what was finished is kept")
    time.sleep(1.0)
    with pytest.raises(ProcessLookupError):
        os.killpg(started.pid, 0)
    kept = read_rows(tmp_path / RUNS_FILE)
    assert 2 <= len(kept) < 120 and len(set(keys(kept))) == len(kept)
    last = max(kept, key=lambda row: row.seed)
    rows = run(replace(ONE, problems=(int(last.problem),), seeds=(last.seed, 30)), tmp_path)
    assert len(rows) == len(kept) + 1 and [row for row in rows if row in kept] == kept


def test_a_run_is_not_continued_with_other_weights(tmp_path, monkeypatch):
    few = replace(ONE, planners=("roadmap-cvq",))
    rows = run(few, tmp_path)
    assert ProvenanceFile(tmp_path).read()["weights"] == weights_of(few.planners)
    monkeypatch.setattr(runner, "weights_of", lambda planners, model: {"vq_mpt": "f" * 64})
    refused(rf'weights.vq_mpt was "\w+", now "{"f" * 64}"', run, few, tmp_path, error=RunStoreError)
    assert read_rows(tmp_path / RUNS_FILE) == rows
