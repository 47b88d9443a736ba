"""Running planners over a suite: side by side, resumable, every outcome one row or more."""

import hashlib
import math
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

from cvqmpt_lab.benchmarks.suite import SuiteItem, suite_named
from cvqmpt_lab.errors import (
    CvqmptError,
    InvalidInputError,
    UnknownChoiceError,
    located,
    whole_number,
)
from cvqmpt_lab.external import is_external
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planners import is_removed, planner_named, require_fit
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.results.row import FailReason, ResultRow
from cvqmpt_lab.results.store import RunStore
from cvqmpt_lab.search.anytime import check_units
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import BACKENDS
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.vqmpt.sampler_choice import PREFIX
from cvqmpt_lab.vqmpt.weights import SHIPPED, resolve_model, weights_digest
from cvqmpt_lab.warm_up import compile_kernels
from experiments.executors import Executor, Lost, dask_cluster, local_processes
from experiments.rows import Outcome, Run, failed_rows, outcome_of

SPARE_S, TIMES, ITERATION_S = 300.0, 30, 0.01
"""What a run may take beyond planning, and how many times its planning;
an iteration takes less than that [s].
"""
EXTERNAL_SPARE_S, EXTERNAL_TIMES = 120.0, 6
"""The same for external planners, which may hang: the first run of a process warms up all of ours.
"""
WARM_UP_S = 5.0  # given to a planner to warm up [s]
_WARM: set[str] = set()  # external planners that this process has called
PACKAGES = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Experiment:
    """What is run: items x planners x seeds of one suite, under one budget."""

    suite: str  # its name, or the full path of a folder of problem files
    problems: tuple[int | str, ...]
    planners: tuple[str, ...]
    seeds: tuple[int, ...]
    budget: Budget
    backend: str = "compiled"
    model: str | None = None  # weights in place of the shipped ones, of planners that use any
    optimize: Budget | None = None  # spent on a better path once there is one

    def __post_init__(self) -> None:
        suite = suite_named(self.suite)
        for index in self.problems:
            if index not in suite.problems:
                suite.item(index)
        for name in self.planners:
            planner_named(name)
        if suite.digests:
            self._require_fits()
        for seed in self.seeds:
            whole_number("seed", seed)
        for what, budget in (("budget", self.budget), ("optimize", self.optimize or self.budget)):
            Budget.require(budget, what)
        if self.backend not in BACKENDS:
            raise UnknownChoiceError("backend", self.backend, BACKENDS)
        if self.optimize is not None:
            check_units(self.budget, self.optimize)
        for what in ("problems", "planners", "seeds"):
            if not getattr(self, what):
                raise InvalidInputError(f"an experiment needs at least one of {what}")

    def _require_fits(self) -> None:
        """Refuse a planner that cannot serve a problem of a folder, before anything runs."""
        for run in self.runs:
            problem = suite_named(self.suite).solvable(run.item)
            if isinstance(problem, PlanningProblem):
                with located(problem.name):
                    require_fit(run.method, problem)

    @property
    def runs(self) -> list[Run]:
        """All of it, planners of one problem side by side."""
        return [
            Run(
                self.suite,
                problem,
                planner,
                seed,
                self.budget,
                self.backend,
                self.model,
                self.optimize,
            )
            for seed in self.seeds
            for problem in self.problems
            for planner in self.planners
        ]

    def limit_s(self, run: Run) -> float:
        """Time [s] without an answer after which a run is given up:
        far more than any takes that is alive.
        """
        external = planner_named(run.planner).external
        spare, times = (EXTERNAL_SPARE_S, EXTERNAL_TIMES) if external else (SPARE_S, TIMES)
        return spare + times * sum(
            _longest(budget) for budget in (self.budget, self.optimize) if budget
        )

    @property
    def digests(self) -> dict[str, str]:
        """sha256 of its problems by name, if they are those of a folder."""
        known = suite_named(self.suite).digests
        return {str(name): known[str(name)] for name in self.problems} if known else {}

    def settings(self) -> dict[str, object]:
        """What must be equal for a run to be continued: everything that changes a row."""
        return {
            "suite": suite_named(self.suite).name,
            "cutoff_s": self.budget.seconds,
            "iterations": self.budget.iterations,
            "backend": self.backend,
            **({"optimize": asdict(self.optimize)} if self.optimize else {}),
            **suite_named(self.suite).settings,
        }


def _longest(budget: Budget) -> float:
    """Time [s] that a budget allows."""
    by_count = math.inf if budget.iterations is None else ITERATION_S * budget.iterations
    return by_count if budget.seconds is None else min(budget.seconds, by_count)


def executor_for(
    experiment: Experiment, jobs: int, dask: str | None = None
) -> AbstractContextManager[Executor]:
    """So many processes on this machine, or the Dask cluster at an address, which must have our
    code and weights.
    """
    if jobs < 1:
        raise InvalidInputError(f"jobs must be 1 or more, not {jobs}")
    if dask is not None:
        return dask_cluster(dask, experiment.limit_s, partial(_installed, experiment))
    return local_processes(jobs, experiment.limit_s)


def run_experiment(
    experiment: Experiment,
    out: Path,
    executor: Executor,
    command: Sequence[str],
    on_progress: Callable[[int, int, str], None],
) -> list[ResultRow]:
    """Run what is not yet in `out` and return all rows, sorted; an interrupt keeps every finished
    run.

    on_progress: called with (runs done, runs in all, a note on the last one).
    """
    session = provenance(
        command,
        experiment.seeds,
        weights_of(experiment.planners, experiment.model),
        executor.size,
        experiment.digests,
        externals_of(experiment.planners),
    )
    with RunStore.open(out, experiment.settings(), session) as store:
        runs, done = experiment.runs, store.done()
        left = [run for run in runs if run.key not in done]
        finished = len(runs) - len(left)
        on_progress(finished, len(runs), "")
        one_run_a_planner = tuple({run.planner: run for run in left}.values())
        for run, result in executor.results(partial(_run_in_worker, one_run_a_planner), left):
            outcome = result
            if isinstance(result, Lost):
                item = suite_named(run.suite).item(run.item)
                outcome = Outcome(failed_rows(run, item, result.reason, result.detail))
            store.append(outcome.rows, outcome.paths)
            failed = next((row for row in outcome.rows if not row.solved), None)
            note = f"{failed.problem} {failed.fail_reason}" if failed else f"{run.item} solved"
            finished += 1
            on_progress(finished, len(runs), f"{run.planner} {note}")
        return store.rows()


def models_of(planner: str) -> tuple[str, ...]:
    """Names of the models that a planner needs."""
    # an external planner needs none, and is perhaps not installed; nor does a removed one
    if is_external(planner.removeprefix(PREFIX)) or is_removed(planner):
        return ()
    kind = planner_named(planner).weights
    return () if kind is None else (kind,)


def weights_of(planners: Iterable[str], model: str | None = None) -> dict[str, str]:
    """Digests of the models that the planners need, by name; model: see `Experiment.model`."""
    kinds = {kind for planner in planners for kind in models_of(planner)}
    if not kinds:
        return {}
    return {
        kind: weights_digest(resolve_model(model or kind, SHIPPED[kind])) for kind in sorted(kinds)
    }


def externals_of(planners: Iterable[str]) -> dict[str, str]:
    """Distributions and versions of external planners, by the planner's name."""
    made_by = {name: planner_named(name).external for name in planners}
    return {name: text for name, text in made_by.items() if text}


def default_jobs() -> int:
    """One process per core."""
    return os.cpu_count() or 1


def _installed(experiment: Experiment) -> dict[str, object]:
    """What decides rows on a machine: digests of the sources and of the planners' weights."""
    digest = hashlib.sha256()
    for package in ("cvqmpt_lab", "experiments"):
        for path in sorted((PACKAGES / package).rglob("*.py")):
            digest.update(f"{path.relative_to(PACKAGES)}".encode() + path.read_bytes())
    return {
        "sources": digest.hexdigest(),
        "weights": weights_of(experiment.planners, experiment.model),
        "problem files": experiment.digests,
        "planners": externals_of(experiment.planners),
    }


def _run_in_worker(one_run_a_planner: tuple[Run, ...], run: Run) -> Outcome:
    """What comes of a run; an error that is no user's costs that run alone."""
    external = planner_named(run.planner).external
    _warm_up(tuple(one for one in one_run_a_planner if not planner_named(one.planner).external))
    item, seconds = _item(run.suite, run.item)
    try:
        if external:
            _warm_up_external(run)
        return outcome_of(run, item, seconds)
    except (CvqmptError, MemoryError):
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        return Outcome(failed_rows(run, item, FailReason.PLANNER_ERROR, what))


@lru_cache(maxsize=1)
def _warm_up(runs: tuple[Run, ...]) -> None:
    """Load compiled code and planner libraries once a process, by short runs, so that no row pays
    for it.
    """
    compile_kernels(lambda _: None)
    for run in runs:
        item, seconds = _item(run.suite, run.item)
        budget = Budget(seconds=WARM_UP_S, iterations=None if isinstance(item, Task) else 1)
        outcome_of(replace(run, budget=budget), item, seconds)
    _item.cache_clear()


def _warm_up_external(run: Run) -> None:
    """Call an external planner once a process, so that no row pays for what it loads;
    in its own run: it may hang.
    """
    if run.planner in _WARM:
        return
    _WARM.add(run.planner)
    item, seconds = _item(run.suite, run.item)
    short = replace(run.budget, seconds=min(WARM_UP_S, run.budget.seconds or WARM_UP_S))
    outcome_of(replace(run, budget=short), item, seconds)


@lru_cache(maxsize=4)
def _item(suite: str, index: int | str) -> tuple[SuiteItem, float]:
    """An item, a problem with its goals sampled once for all planners, and the seconds [s] that
    took.
    """
    item = suite_named(suite).item(index)
    return with_sampled_goals(item) if isinstance(item, PlanningProblem) else (item, 0.0)
