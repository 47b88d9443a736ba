"""Running planners over a suite: in parallel processes, resumable, every outcome one row or more."""

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planning.restarts import check_units
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import BACKENDS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.results.row import FailReason, ResultRow
from cvqmpt_lab.results.store import RunStore
from cvqmpt_lab.tasks.task import Task
from experiments.rows import Item, Outcome, Run, failed_rows, outcome_of
from experiments.suites.table import suite_named
from experiments.warmup import compile_kernels
from experiments.workers import worker_pool

Outcomes = Generator[tuple[Run, Outcome], None, list[Run]]
"""Runs with what came of them as they come in; at the end, the runs that were in flight when a worker died."""


@dataclass(frozen=True)
class Experiment:
    """What is run: items x planners x seeds of one suite, under one budget."""

    suite: str
    problems: tuple[int, ...]
    planners: tuple[str, ...]
    seeds: tuple[int, ...]
    budget: Budget
    backend: str = "compiled"
    model: str | None = None
    """Weights in place of the shipped ones, of planners that use any."""
    optimize: Budget | None = None
    """What is spent on a better path once there is one."""

    def __post_init__(self) -> None:
        suite = suite_named(self.suite)
        for index in self.problems:
            if index not in suite.problems:
                suite.item(index)
        for name in self.planners:
            planner_named(name)
        if self.backend not in BACKENDS:
            raise UnknownChoiceError("backend", self.backend, BACKENDS)
        if self.optimize is not None:
            check_units(self.budget, self.optimize)
        for what in ("problems", "planners", "seeds"):
            if not getattr(self, what):
                raise InvalidInputError(f"an experiment needs at least one of {what}")

    @property
    def runs(self) -> list[Run]:
        """All of it, planners of one problem side by side."""
        return [
            Run(self.suite, problem, planner, seed, self.budget, self.backend, self.model, self.optimize)
            for seed in self.seeds
            for problem in self.problems
            for planner in self.planners
        ]

    def settings(self) -> dict[str, object]:
        """What must be equal for a run to be continued: everything that changes a row."""
        return {
            "suite": self.suite,
            "cutoff_s": self.budget.seconds,
            "iterations": self.budget.iterations,
            "backend": self.backend,
            **({"optimize": asdict(self.optimize)} if self.optimize else {}),
            **suite_named(self.suite).settings,
        }


def run_experiment(
    experiment: Experiment,
    out: Path,
    jobs: int,
    command: Sequence[str],
    on_progress: Callable[[int, int, str], None],
) -> list[ResultRow]:
    """Run what is not yet in `out` and return all rows, sorted.

    An interrupt keeps every finished run; the same call continues.

    Parameters
    ----------
    on_progress
        Called with (runs done, runs in all, a note on the last one).
    """
    if jobs < 1:
        raise InvalidInputError(f"jobs must be 1 or more, not {jobs}")
    session = provenance(command, experiment.seeds, weights_of(experiment.planners, experiment.model), jobs)
    with RunStore.open(out, experiment.settings(), session) as store:
        runs, done = experiment.runs, store.done()
        left = [run for run in runs if run.key not in done]
        on_progress(len(runs) - len(left), len(runs), "")
        for finished, (run, outcome) in enumerate(_outcomes(left, jobs), start=len(runs) - len(left) + 1):
            store.append(outcome.rows, outcome.paths)
            failed = next((row for row in outcome.rows if not row.solved), None)
            note = f"{failed.problem} {failed.fail_reason}" if failed else f"{run.item} solved"
            on_progress(finished, len(runs), f"{run.planner} {note}")
        return store.rows()


def models_of(planner: str) -> tuple[str, ...]:
    """Names of the models that a planner needs."""
    weights = planner_named(planner).weights
    return () if weights is None else (weights.kind,)


def weights_of(planners: Iterable[str], model: str | None = None) -> dict[str, str]:
    """Digests of the models that the planners need, by name; model: see `Experiment.model`."""
    kinds = {kind for planner in planners for kind in models_of(planner)}
    if not kinds:
        return {}
    from cvqmpt_lab.models.weights_folder import weights_digest  # torch takes 2 s to import
    from cvqmpt_lab.prediction.weights import SHIPPED, resolve_model

    return {kind: weights_digest(resolve_model(model or kind, SHIPPED[kind])) for kind in sorted(kinds)}


def default_jobs() -> int:
    """One process per core."""
    return os.cpu_count() or 1


def _outcomes(runs: Sequence[Run], jobs: int) -> Iterator[tuple[Run, Outcome]]:
    """What came of every run. When a worker dies, the runs in flight are repeated one by one to find which did it."""
    waiting, suspects = deque(runs), deque[Run]()
    setup = tuple({run.planner: run for run in runs}.values())
    while waiting or suspects:
        if not suspects:
            suspects.extend((yield from _in_pool(waiting, jobs, 2 * jobs, setup)))
            continue
        for run in (yield from _in_pool(suspects, 1, 1, setup)):
            item, _ = _item(run.suite, run.item)
            rows = failed_rows(run, item, FailReason.WORKER_DIED, "the process that ran it ended")
            yield run, Outcome(rows)


def _in_pool(queue: deque[Run], jobs: int, in_flight: int, setup: tuple[Run, ...]) -> Outcomes:
    """Run a queue, a few runs in flight at a time, so that an interrupt is quick."""
    pool = worker_pool(min(jobs, len(queue)))
    flying: dict[Future, Run] = {}
    try:
        while queue or flying:
            while queue and len(flying) < in_flight:
                flying[pool.submit(_run_warm, queue[0], setup)] = queue[0]  # stays queued if that fails
                queue.popleft()
            for future in wait(flying, return_when=FIRST_COMPLETED).done:
                outcome = future.result()
                yield flying.pop(future), outcome
    except BrokenProcessPool:
        return list(flying.values())
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return []


def _run_warm(run: Run, setup: tuple[Run, ...]) -> Outcome:
    """What comes of a run, in a worker that is ready for all planners; a fault of ours costs that run alone."""
    _warm_up(setup)
    item, seconds = _item(run.suite, run.item)
    try:
        return outcome_of(run, item, seconds)
    except CvqmptError:
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        return Outcome(failed_rows(run, item, FailReason.PLANNER_ERROR, what))


@lru_cache(maxsize=1)
def _warm_up(setup: tuple[Run, ...]) -> None:
    """Load compiled code and planner libraries once a process, by short runs, so that no row pays for it."""
    compile_kernels(lambda _: None)
    for run in setup:
        item, seconds = _item(run.suite, run.item)
        budget = Budget(seconds=5.0, iterations=None if isinstance(item, Task) else 1)
        outcome_of(replace(run, budget=budget), item, seconds)
    _item.cache_clear()


@lru_cache(maxsize=4)
def _item(suite: str, index: int) -> tuple[Item, float]:
    """An item, a problem with its goals sampled once for all planners, and the seconds [s] that took."""
    item = suite_named(suite).item(index)
    return with_sampled_goals(item) if isinstance(item, PlanningProblem) else (item, 0.0)
