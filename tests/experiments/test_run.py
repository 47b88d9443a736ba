"""The runner: rows are the same however many processes, interruptions and continuations made them."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from cvqmpt_lab.errors import InvalidInputError, RunStoreError, UnknownChoiceError
from cvqmpt_lab.methods.table import CONTROLS, PLANNERS
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.results.provenance import ProvenanceFile
from cvqmpt_lab.results.row import RUNS_FILE, read_rows, sorted_rows
from cvqmpt_lab.results.store import PARTIAL_FILE
from cvqmpt_lab.vqmpt.weights import resolve_model, weights_digest
from experiments import run as runner
from experiments.run import Experiment, models_of, run_experiment, weights_of
from experiments.warmup import compile_kernels

ROOT = Path(__file__).resolve().parents[2]
ENOUGH = Budget(iterations=20_000)
FOUR = Experiment("place-task", (2, 10), ("birrt", "guided-birrt"), (0,), ENOUGH)  # four tasks


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Workers are forked: what is compiled here need not be loaded by each of them."""
    compile_kernels(lambda _: None)


def ignore(done, total, note):
    pass


def run(experiment, out, jobs=1, on_progress=ignore):
    return run_experiment(experiment, out, jobs, ["test"], on_progress)


def untimed(rows):
    """Rows without their times."""
    return [{k: v for k, v in asdict(row).items() if not (k.startswith("t_"))} for row in rows]


def keys(rows):
    return [(row.problem, row.planner, row.seed) for row in rows]


@pytest.fixture(scope="module")
def four_rows(tmp_path_factory):
    return run(FOUR, tmp_path_factory.mktemp("four"))


def test_rows_are_sorted_and_complete(four_rows):
    assert keys(four_rows) == [(p, n, 0) for p in ("2", "10") for n in ("birrt", "guided-birrt")]
    assert four_rows == sorted_rows(four_rows)
    assert all(row.solved and row.certified and row.path_sha256 for row in four_rows)


def test_two_processes_make_the_rows_that_one_makes(four_rows, tmp_path):
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


def test_a_larger_experiment_adds_to_the_rows(tmp_path):
    small = Experiment("place-task", (2,), ("birrt",), (0,), ENOUGH)
    first = run(small, tmp_path)
    both = run(Experiment("place-task", (2,), ("birrt",), (0, 1), ENOUGH), tmp_path)
    assert len(first) == 1 and both[0] == first[0] and keys(both) == [("2", "birrt", 0), ("2", "birrt", 1)]


def test_another_budget_is_refused_by_name_and_nothing_is_lost(tmp_path):
    rows = run(Experiment("place-task", (2,), ("birrt",), (0,), ENOUGH), tmp_path)
    with pytest.raises(RunStoreError, match=r"iterations was 20000, now 7.*another --out"):
        run(Experiment("place-task", (2,), ("birrt",), (0,), Budget(iterations=7)), tmp_path)
    assert read_rows(tmp_path / RUNS_FILE) == rows


def test_failures_are_rows_with_a_reason(tmp_path):
    (row,) = run(Experiment("place-task", (5,), ("birrt",), (0,), Budget(iterations=1)), tmp_path)
    assert (row.solved, row.fail_reason) == (False, "iteration_limit")
    assert row.path_sha256 is None and row.path_length_rad is None and row.n_iterations == 1


def dies_on(problem, always=True):
    """`outcome_of` that kills its worker on a problem, or only the first time."""
    real, once = runner.outcome_of, Path(tempfile.mkdtemp()) / "died"

    def outcome_of(run, item, seconds):
        if run.item == problem and run.budget == ENOUGH and (always or not once.exists()):
            once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return real(run, item, seconds)

    return outcome_of


def test_a_fault_of_ours_costs_its_own_run_only_and_stands_in_the_table(tmp_path, monkeypatch):
    real = runner.outcome_of

    def outcome_of(run, item, seconds):
        return real(run, item, seconds / (run.item - 10 if run.budget == ENOUGH else 1))

    monkeypatch.setattr(runner, "outcome_of", outcome_of)
    rows = run(Experiment("place-task", (10, 15), ("birrt",), (0,), ENOUGH), tmp_path)
    assert [(row.problem, row.fail_reason) for row in rows] == [("10", "planner_error"), ("15", None)]
    assert rows[0].detail.startswith("ZeroDivisionError: ")


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_worker_that_dies_costs_its_own_run_only(tmp_path, monkeypatch, jobs):
    monkeypatch.setattr(runner, "outcome_of", dies_on(10))
    three = Experiment("place-task", (2, 10, 5), ("birrt",), (0,), ENOUGH)
    rows = run(three, tmp_path, jobs=jobs)
    assert [(row.problem, row.fail_reason) for row in rows] == [
        ("2", None),
        ("5", None),
        ("10", "worker_died"),
    ]
    assert run(three, tmp_path) == rows, "what killed a worker is not tried again"


def test_a_worker_that_hangs_is_ended_and_costs_its_own_run_only(tmp_path, monkeypatch):
    real, limit = runner.outcome_of, 15.0

    def outcome_of(run, item, seconds):
        if run.item == 10 and run.budget == ENOUGH:
            (tmp_path / "pid").write_text(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGSTOP)  # does not even hear SIGTERM
        return real(run, item, seconds)

    monkeypatch.setattr(runner, "outcome_of", outcome_of)
    monkeypatch.setattr(Experiment, "limit_s", limit)
    rows = run(Experiment("place-task", (2, 10, 5), ("birrt",), (0,), ENOUGH), tmp_path / "out")
    assert [(row.problem, row.fail_reason) for row in rows] == [
        ("2", None),
        ("5", None),
        ("10", "worker_hung"),
    ]
    assert rows[2].detail == "no answer in 15 s; its process was ended"
    assert not Path("/proc", (tmp_path / "pid").read_text()).exists()


def test_a_run_may_take_far_longer_than_its_budget_before_it_counts_as_hung():
    def limit(**budget):
        return Experiment("place-task", (2,), ("birrt",), (0,), Budget(**budget)).limit_s

    assert limit(seconds=10.0) == 600.0
    assert limit(seconds=10.0, iterations=100) == limit(iterations=100) < limit(iterations=10**6)


def test_a_run_that_asks_for_more_memory_than_there_is_costs_itself_only(tmp_path, monkeypatch):
    real, memory = runner.outcome_of, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")

    def outcome_of(run, item, seconds):
        if run.item == 10 and run.budget == ENOUGH:
            np.empty(memory, np.uint8)
        return real(run, item, seconds)

    monkeypatch.setattr(runner, "outcome_of", outcome_of)
    rows = run(Experiment("place-task", (10, 2), ("birrt",), (0,), ENOUGH), tmp_path)
    assert [(row.problem, row.fail_reason) for row in rows] == [("2", None), ("10", "out_of_memory")]
    assert "Unable to allocate" in rows[1].detail


def test_a_worker_that_something_else_killed_costs_nothing(four_rows, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "outcome_of", dies_on(2, always=False))
    assert untimed(run(FOUR, tmp_path, jobs=2)) == untimed(four_rows)


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
        Experiment(
            **{
                **{f: getattr(FOUR, f) for f in ("suite", "problems", "planners", "seeds", "budget")},
                **values,
            }
        )


def command(out):
    task = ["reproduce", "place-task", "--problems", "4", "--planners", "birrt", "--seeds", "30"]
    return [
        sys.executable,
        "-m",
        "cli.main",
        *task,
        "--iterations",
        "20000",
        "--jobs",
        "2",
        "--out",
        str(out),
    ]


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


@pytest.fixture
def started(tmp_path):
    """A run in a session of its own, of which two rows are on disk; nothing of it is left afterwards."""
    with (tmp_path / "stderr").open("w") as errors:
        process = subprocess.Popen(
            command(tmp_path / "out"),
            cwd=ROOT,
            stderr=errors,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
            # A shell in the background makes its children deaf to Ctrl-C: a person's terminal does not.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
    try:
        wait_for_rows(process, tmp_path / "out", 2)
        yield process
    finally:
        for pid in processes_of_session(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.wait()


@pytest.mark.slow
def test_an_interrupt_leaves_a_run_that_the_same_command_continues(tmp_path, started):
    os.killpg(started.pid, signal.SIGINT)  # what Ctrl-C in a terminal does
    assert started.wait(timeout=30) == 130
    errors = (tmp_path / "stderr").read_text()
    assert errors.splitlines()[-1].startswith("cvqmpt: interrupted; what was finished is kept")
    assert "Traceback" not in errors
    kept = read_rows(tmp_path / "out" / RUNS_FILE)
    assert 2 <= len(kept) < 120 and len(set(keys(kept))) == len(kept)
    last = max(kept, key=lambda row: row.seed)
    more = Experiment("place-task", (int(last.problem),), ("birrt",), (last.seed, 30), ENOUGH)
    rows = run(more, tmp_path / "out")
    assert len(rows) == len(kept) + 1 and [row for row in rows if row in kept] == kept


@pytest.mark.slow
def test_an_interrupted_run_leaves_no_worker_behind(started):
    os.kill(started.pid, signal.SIGINT)
    assert started.wait(timeout=30) == 130
    deadline = time.monotonic() + 5
    while processes_of_session(started.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert processes_of_session(started.pid) == []


def test_only_planners_that_need_weights_name_them():
    digests = {name: weights_digest(resolve_model(name)) for name in ("mpnet", "vq_mpt")}
    assert weights_of(("birrt", "tb-rrt")) == {}
    assert weights_of(("birrt", "roadmap-cvq")) == {"vq_mpt": digests["vq_mpt"]}
    assert weights_of(tuple(PLANNERS)) == digests
    assert {models_of(name) for name in CONTROLS} == {(), ("vq_mpt",), ("vq_mpt_constrained",)}


def test_a_run_is_not_continued_with_other_weights(tmp_path, monkeypatch):
    few = Experiment("place-task", (2,), ("roadmap-cvq",), (0,), ENOUGH)
    rows = run(few, tmp_path)
    recorded = ProvenanceFile(tmp_path).read()["weights"]
    assert recorded == weights_of(few.planners)
    monkeypatch.setattr(runner, "weights_of", lambda planners, model: {"vq_mpt": "f" * 64})
    with pytest.raises(RunStoreError, match=f'weights.vq_mpt was "{recorded["vq_mpt"]}", now "{"f" * 64}"'):
        run(few, tmp_path)
    assert read_rows(tmp_path / RUNS_FILE) == rows
