"""Running planners over a suite: in parallel processes, resumable, every outcome a row."""

import csv
import ctypes
import io
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from cvqmpt_lab.errors import InvalidInputError, RunStoreError, UnknownChoiceError
from cvqmpt_lab.methods.table import CONTROLS, PLANNERS, WITHOUT_WEIGHTS, planner_named
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import BACKENDS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import provenance, write_text_atomic
from cvqmpt_lab.results.store import ResultRow, RunKey, RunStore
from experiments.rows import result_row
from experiments.suites.place_task import UnsolvableProblem
from experiments.suites.table import suite_named
from experiments.warmup import compile_kernels

UNSOLVABLE_FILE = "unsolvable.csv"
UNSOLVABLE_COLUMNS = ("problem", "reason")
PR_SET_PDEATHSIG = 1  # Linux: a worker ends with its parent, however that ends


def require_planners(names: Sequence[str]) -> None:
    """Refuse unknown planners without making the others: a process that has used torch must not be forked."""
    for name in names:
        if name not in PLANNERS and name not in CONTROLS:
            raise UnknownChoiceError("planner", name, [*PLANNERS, *CONTROLS])


@dataclass(frozen=True)
class Experiment:
    """What is run: problems x planners x seeds of one suite, under one budget."""

    suite: str
    problems: tuple[int, ...]
    planners: tuple[str, ...]
    seeds: tuple[int, ...]
    budget: Budget
    backend: str = "compiled"

    def __post_init__(self) -> None:
        suite = suite_named(self.suite)
        for index in self.problems:
            if index not in suite.problems:
                suite.problem(index)
        require_planners(self.planners)
        if self.backend not in BACKENDS:
            raise UnknownChoiceError("backend", self.backend, BACKENDS)
        for what in ("problems", "planners", "seeds"):
            if not getattr(self, what):
                raise InvalidInputError(f"an experiment needs at least one of {what}")

    def settings(self) -> dict:
        """What must be equal for a run to be continued: everything that changes a row."""
        return {
            "suite": self.suite,
            "cutoff_s": self.budget.seconds,
            "iterations": self.budget.iterations,
            "backend": self.backend,
        }


@dataclass(frozen=True)
class Task:
    """One run of one planner on one problem with one seed."""

    suite: str
    problem: int
    planner: str
    seed: int
    budget: Budget
    backend: str

    @property
    def key(self) -> RunKey:
        """The row it makes."""
        return RunKey(self.suite, str(self.problem), self.planner, self.seed, self.backend)


@lru_cache(maxsize=4)
def _problem(suite: str, index: int) -> tuple[PlanningProblem | UnsolvableProblem, float]:
    """A problem with its goals sampled once for all planners, and the seconds that took."""
    problem = suite_named(suite).problem(index)
    return (problem, 0.0) if isinstance(problem, UnsolvableProblem) else with_sampled_goals(problem)


def run_task(task: Task) -> ResultRow | UnsolvableProblem:
    """Solve one task; the goal sampling is charged to every planner alike."""
    problem, goal_seconds = _problem(task.suite, task.problem)
    if isinstance(problem, UnsolvableProblem):
        return problem
    solution = solve(problem, planner_named(task.planner), task.budget, task.seed, backend=task.backend)
    return result_row(task.suite, task.planner, task.seed, task.backend, solution, goal_seconds)


def end_with_parent() -> None:
    """Let this worker process end when its parent does, however that ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def _warm_up(suite: str, problem: int, backend: str, planners: tuple[str, ...]) -> None:
    """Load compiled code and planner libraries in a fresh worker, so that no row pays for it."""
    end_with_parent()
    compile_kernels(lambda _: None)
    for planner in planners:
        run_task(Task(suite, problem, planner, 0, Budget(seconds=5.0, iterations=1), backend))
    _problem.cache_clear()


def run_experiment(
    experiment: Experiment,
    out: Path,
    jobs: int,
    command: Sequence[str],
    on_progress: Callable[[int, int, ResultRow | None], None],
) -> list[ResultRow]:
    """Run what is not yet in `out` and return all rows, sorted.

    Parameters
    ----------
    on_progress: called with (rows done, rows in all, last row or None).

    An interrupt keeps every finished row; the same call continues.
    """
    if jobs < 1:
        raise InvalidInputError(f"jobs must be 1 or more, not {jobs}")
    tasks = [
        Task(experiment.suite, problem, planner, seed, experiment.budget, experiment.backend)
        for seed in experiment.seeds
        for problem in experiment.problems
        for planner in experiment.planners
    ]
    weights = model_hash(experiment.planners)
    record = provenance(list(command), asdict(experiment), list(experiment.seeds), weights, threads=jobs)
    with RunStore.open(out, experiment.settings(), record) as store:
        unsolvable = _read_unsolvable(out)
        done = store.done_keys()
        open_tasks = [task for task in tasks if task.key not in done]
        finished = len(tasks) - len(open_tasks)
        on_progress(finished, len(tasks), None)
        setup = (experiment.suite, experiment.problems[0], experiment.backend, experiment.planners)
        for outcome in outcomes(run_task, open_tasks, jobs, _warm_up, setup):
            finished += 1
            if isinstance(outcome, UnsolvableProblem):
                unsolvable[outcome.name] = outcome
                on_progress(finished, len(tasks), None)
            else:
                store.append(outcome)
                unsolvable.pop(outcome.problem, None)
                on_progress(finished, len(tasks), outcome)
        _write_unsolvable(out, unsolvable)
        store.finish()
        return store.rows()


def model_hash(planners: Sequence[str]) -> str | None:
    """Hash of the shipped weights if any of the planners uses them."""
    if set(planners) <= set(WITHOUT_WEIGHTS):
        return None
    from cvqmpt_lab.prediction.shipped import shipped_hash  # torch takes 2 s to import

    return shipped_hash()


def outcomes(
    run: Callable[[Any], Any], tasks: Sequence[Any], jobs: int, warm_up: Callable, setup: tuple
) -> Iterator[Any]:
    """run(task) of every task as they come in; a few are in flight at a time, so that an interrupt is quick.

    warm_up: called with `setup` in every process before its first task.
    """
    if not tasks:
        return
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    pool = ProcessPoolExecutor(min(jobs, len(tasks)), context, initializer=warm_up, initargs=setup)
    waiting = iter(tasks)
    flying: set[Future] = set()
    try:
        while True:
            while len(flying) < 2 * jobs and (task := next(waiting, None)) is not None:
                flying.add(pool.submit(run, task))
            if not flying:
                break
            landed, flying = wait(flying, return_when=FIRST_COMPLETED)
            for future in landed:
                yield future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _read_unsolvable(out: Path) -> dict[str, UnsolvableProblem]:
    """What earlier runs into the same directory found unsolvable, by name."""
    path = out / UNSOLVABLE_FILE
    try:
        header, *rows = csv.reader(io.StringIO(path.read_text(encoding="utf-8")), strict=True)
        if tuple(header) != UNSOLVABLE_COLUMNS:
            raise ValueError(f"the header is {','.join(header)}")
        return {str(int(name)): UnsolvableProblem(name, reason) for name, reason in rows}
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise RunStoreError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, csv.Error) as error:
        raise RunStoreError(f"{path} is no list of unsolvable problems ({error}); remove it") from error


def _write_unsolvable(out: Path, unsolvable: dict[str, UnsolvableProblem]) -> None:
    """Environments without a problem, with the reason, beside the rows."""
    path = out / UNSOLVABLE_FILE
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(UNSOLVABLE_COLUMNS)
    writer.writerows(
        (item.name, item.reason) for item in sorted(unsolvable.values(), key=lambda u: int(u.name))
    )
    try:
        write_text_atomic(path, text.getvalue())
    except OSError as error:
        raise RunStoreError(f"cannot write {path}: {error.strerror}") from error


def default_jobs() -> int:
    """One process per core."""
    return os.cpu_count() or 1
