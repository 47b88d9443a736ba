"""The runner: rows are the same however many processes, interruptions and continuations made them."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pebble
import pytest

from cvqmpt_lab.errors import InvalidInputError, RunStoreError, UnknownChoiceError
from cvqmpt_lab.planners import CONTROLS, PLANNERS
from cvqmpt_lab.results.provenance import ProvenanceFile
from cvqmpt_lab.results.row import RUNS_FILE, read_rows, sorted_rows
from cvqmpt_lab.results.store import PARTIAL_FILE
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.vqmpt.weights import resolve_model, weights_digest
from cvqmpt_lab.warm_up import compile_kernels
from experiments import run as runner
from experiments.run import Experiment, executor_for, models_of, run_experiment, weights_of

ROOT = Path(__file__).resolve().parents[2]
ENOUGH = Budget(iterations=20_000)
ONE = Experiment("place-task", (2,), ("birrt",), (0,), ENOUGH)
FOUR = replace(ONE, problems=(2, 10), planners=("birrt", "guided-birrt"))


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Workers are forked: what is compiled here need not be loaded by each of them."""
    compile_kernels(lambda _: None)


def run(experiment, out, jobs=1, on_progress=lambda *_: None):
    with executor_for(experiment, jobs) as executor:
        return run_experiment(experiment, out, executor, ["test"], on_progress)


def untimed(rows):
    """Rows without their times."""
    return [{k: v for k, v in asdict(row).items() if not k.startswith("t_")} for row in rows]


def keys(rows):
    return [(row.problem, row.planner, row.seed) for row in rows]


@pytest.fixture(scope="module")
def four_rows(tmp_path_factory):
    return run(FOUR, tmp_path_factory.mktemp("four"))


def test_rows_are_sorted_complete_and_those_of_two_processes(four_rows, tmp_path):
    assert keys(four_rows) == [(p, n, 0) for p in ("2", "10") for n in ("birrt", "guided-birrt")]
    assert four_rows == sorted_rows(four_rows)
    assert all(row.solved and row.certified and row.path_sha256 for row in four_rows)
    assert untimed(run(FOUR, tmp_path, jobs=2)) == untimed(four_rows)


class Killed(BaseException):
    """Stands for whatever ends a run."""


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
    assert untimed(rows) == untimed(four_rows)
    assert read_rows(tmp_path / RUNS_FILE) == rows
    before = (tmp_path / RUNS_FILE).read_bytes()
    assert run(FOUR, tmp_path) == rows and (tmp_path / RUNS_FILE).read_bytes() == before


def test_a_larger_experiment_adds_to_the_rows_and_another_budget_is_refused(tmp_path):
    first = run(ONE, tmp_path)
    both = run(replace(ONE, seeds=(0, 1)), tmp_path)
    assert len(first) == 1 and both[0] == first[0] and keys(both) == [("2", "birrt", 0), ("2", "birrt", 1)]
    with pytest.raises(RunStoreError, match=r"iterations was 20000, now 7.*another --out"):
        run(replace(ONE, budget=Budget(iterations=7)), tmp_path)
    assert read_rows(tmp_path / RUNS_FILE) == both


def test_failures_are_rows_with_a_reason(tmp_path):
    (row,) = run(replace(ONE, problems=(5,), budget=Budget(iterations=1)), tmp_path)
    assert (row.solved, row.fail_reason) == (False, "iteration_limit")
    assert row.path_sha256 is None and row.path_length_rad is None and row.n_iterations == 1


def in_place_of_planning(item):
    """What happens to the worker of a run on an item."""
    if item == 10:
        os.kill(os.getpid(), signal.SIGKILL)
    if item == 15:
        os.kill(os.getpid(), signal.SIGSTOP)
    if item == 20:
        np.empty(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"), np.uint8)
    if item == 25:
        raise ZeroDivisionError("by nothing")


def test_a_run_that_is_lost_is_a_failure_row_and_costs_no_other_run(tmp_path, monkeypatch):
    plan = runner.outcome_of

    def outcome_of(run, item, seconds):
        if run.budget == ENOUGH:  # and not that of the warm-up
            in_place_of_planning(run.item)
        return plan(run, item, seconds)

    monkeypatch.setattr(runner, "outcome_of", outcome_of)
    monkeypatch.setattr(Experiment, "limit_s", 4.0)
    monkeypatch.setattr(pebble.CONSTS, "term_timeout", 0.2)
    six = replace(ONE, problems=(2, 10, 15, 20, 25, 5))
    rows = run(six, tmp_path, jobs=2)
    assert [(row.problem, row.fail_reason) for row in rows] == [
        ("2", None),
        ("5", None),
        ("10", "worker_died"),
        ("15", "worker_hung"),
        ("20", "out_of_memory"),
        ("25", "planner_error"),
    ]
    told = ("SIGKILL; perhaps memory ran out, twice", "in 4 s; its process was ended", "Unable to allocate")
    assert all(words in row.detail for words, row in zip(told, rows[2:], strict=False))
    assert rows[5].detail == "ZeroDivisionError: by nothing"
    assert run(six, tmp_path) == rows, "what killed a worker is not tried again"


def test_a_run_may_take_far_longer_than_its_budget_before_it_counts_as_hung():
    def limit(**budget):
        return replace(ONE, budget=Budget(**budget)).limit_s

    assert limit(seconds=10.0) == 600.0
    assert limit(seconds=10.0, iterations=100) == limit(iterations=100) < limit(iterations=10**6)


def test_an_error_in_a_worker_is_the_error_of_the_run(tmp_path, monkeypatch):
    def refuse(run, item, seconds):
        raise InvalidInputError("weights are for another robot")

    monkeypatch.setattr(runner, "outcome_of", refuse)
    with pytest.raises(InvalidInputError, match="another robot"):
        run(FOUR, tmp_path, jobs=2)


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"suite": "x"}, UnknownChoiceError, "unknown suite 'x'"),
        ({"planners": ("birrt", "x")}, UnknownChoiceError, "unknown planner 'x'"),
        ({"problems": (2, 150)}, InvalidInputError, "unknown problem 150.*0 to 149"),
        ({"seeds": ()}, InvalidInputError, "at least one of seeds"),
    ],
)
def test_bad_experiments_are_refused_by_name(values, error, words):
    with pytest.raises(error, match=words):
        replace(FOUR, **values)


def wait_for_rows(process, out, count):
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and process.poll() is None:
        partial = out / PARTIAL_FILE
        if partial.is_file() and partial.read_bytes().count(b"\n\n") >= count:
            return
        time.sleep(0.02)
    pytest.fail("the run ended before it could be interrupted, or made no rows")


def processes_of_session(session):
    """Ids of the processes that still live in a session."""
    alive = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session = stat.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(its_session) == session and state != "Z":
            alive.append(int(stat.parent.name))
    return alive


@pytest.mark.slow
def test_an_interrupt_leaves_no_worker_and_a_run_that_the_same_command_continues(tmp_path):
    words = "reproduce place-task --problems 4 --planners birrt --seeds 30 --iterations 20000 --jobs 2"
    task = words.split()
    with (tmp_path / "stderr").open("w") as errors:
        started = subprocess.Popen(
            [sys.executable, "-m", "cli.main", *task, "--out", str(tmp_path / "out")],
            cwd=ROOT,
            stderr=errors,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
            # A shell in the background makes its children deaf to Ctrl-C: a person's terminal does not.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
    try:
        wait_for_rows(started, tmp_path / "out", 2)
        os.killpg(started.pid, signal.SIGINT)  # what Ctrl-C in a terminal does
        assert started.wait(timeout=30) == 130
        deadline = time.monotonic() + 5
        while processes_of_session(started.pid) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert processes_of_session(started.pid) == []
    finally:
        for pid in processes_of_session(started.pid):
            os.kill(pid, signal.SIGKILL)
        started.wait()
    told = (tmp_path / "stderr").read_text()
    assert told.splitlines()[-1].startswith("cvqmpt: interrupted; what was finished is kept")
    assert "Traceback" not in told
    kept = read_rows(tmp_path / "out" / RUNS_FILE)
    assert 2 <= len(kept) < 120 and len(set(keys(kept))) == len(kept)
    last = max(kept, key=lambda row: row.seed)
    more = replace(ONE, problems=(int(last.problem),), seeds=(last.seed, 30))
    rows = run(more, tmp_path / "out")
    assert len(rows) == len(kept) + 1 and [row for row in rows if row in kept] == kept


def test_only_planners_that_need_weights_name_them():
    digests = {name: weights_digest(resolve_model(name)) for name in ("mpnet", "vq_mpt")}
    assert weights_of(("birrt", "tb-rrt")) == {}
    assert weights_of(("birrt", "roadmap-cvq")) == {"vq_mpt": digests["vq_mpt"]}
    assert weights_of(tuple(PLANNERS)) == digests
    assert {models_of(name) for name in CONTROLS} == {(), ("vq_mpt",)}


def test_a_run_is_not_continued_with_other_weights(tmp_path, monkeypatch):
    few = replace(ONE, planners=("roadmap-cvq",))
    rows = run(few, tmp_path)
    recorded = ProvenanceFile(tmp_path).read()["weights"]
    assert recorded == weights_of(few.planners)
    monkeypatch.setattr(runner, "weights_of", lambda planners, model: {"vq_mpt": "f" * 64})
    with pytest.raises(RunStoreError, match=f'weights.vq_mpt was "{recorded["vq_mpt"]}", now "{"f" * 64}"'):
        run(few, tmp_path)
    assert read_rows(tmp_path / RUNS_FILE) == rows
