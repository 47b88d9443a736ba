"""Run planners over a suite, in parallel and resumable; every outcome gives rows."""

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

from cvqmpt_lab.benchmarks.suite import SuiteItem, suite_named
from cvqmpt_lab.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.external import external_planner
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.results.row import FailReason, ResultRow
from cvqmpt_lab.results.store import RunStore
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.warm_up import compile_kernels
from experiments.executors import Executor, Lost, dask_cluster, local_processes
from experiments.experiment import Experiment, Run, externals_of, weights_of
from experiments.rows import Outcome, failed_rows, outcome_of

WARM_UP_S = 5.0  # given to a planner to warm up [s]


def executor_for(
    experiment: Experiment, jobs: int, dask: str | None = None
) -> AbstractContextManager[Executor]:
    """Processes on this machine, or the Dask cluster at an address, with our code and weights."""
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
    """Run what is not yet in `out`; return all rows, sorted. An interrupt keeps finished runs.

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
                item = suite_named(experiment.suite).item(run.item)
                outcome = Outcome(failed_rows(run, item, result.reason, result.detail))
            store.append(outcome.rows, outcome.paths)
            failed = next((row for row in outcome.rows if not row.solved), None)
            note = f"{failed.problem} {failed.fail_reason}" if failed else f"{run.item} solved"
            finished += 1
            on_progress(finished, len(runs), f"{run.planner} {note}")
        return store.rows()


def default_jobs() -> int:
    """One process per core."""
    return os.cpu_count() or 1


def _installed(experiment: Experiment) -> dict[str, object]:
    """Digests of the sources and of the planners' weights on this machine: they decide rows."""
    digest, root = hashlib.sha256(), Path(__file__).resolve().parents[1]
    for package in ("cvqmpt_lab", "experiments"):
        for path in sorted((root / package).rglob("*.py")):
            digest.update(f"{path.relative_to(root)}".encode() + path.read_bytes())
    return {
        "sources": digest.hexdigest(),
        "weights": weights_of(experiment.planners, experiment.model),
        "problem files": experiment.digests,
        "planners": externals_of(experiment.planners),
    }


def _run_in_worker(one_run_a_planner: tuple[Run, ...], run: Run) -> Outcome:
    """Outcome of a run; an unexpected error fails this run alone."""
    _warm_up(tuple(one for one in one_run_a_planner if not one.method.external))
    item, seconds = _item(run.experiment.suite, run.item)
    try:
        # in its own run: it may hang
        if run.method.external and not external_planner(run.planner).process.has_planned:
            _run_shortly(run)
        return outcome_of(run, item, seconds)
    except (CvqmptError, MemoryError):
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        return Outcome(failed_rows(run, item, FailReason.PLANNER_ERROR, what))


@lru_cache(maxsize=1)
def _warm_up(runs: tuple[Run, ...]) -> None:
    """Load compiled code and planner libraries once a process by short runs: no row pays for it."""
    compile_kernels(lambda _: None)
    for run in runs:
        _run_shortly(run)
    _item.cache_clear()


def _run_shortly(run: Run) -> None:
    """Plan for a few seconds at most (our planners: one iteration); discard the result."""
    item, seconds = _item(run.experiment.suite, run.item)
    budget = run.experiment.budget
    if run.method.external:
        budget = replace(budget, seconds=min(WARM_UP_S, budget.seconds or WARM_UP_S))
    else:
        budget = Budget(seconds=WARM_UP_S, iterations=None if isinstance(item, Task) else 1)
    # this run alone: an experiment checks all that it names when it is made
    problems, planners, seeds = (run.item,), (run.planner,), (run.seed,)
    alone = replace(
        run.experiment, problems=problems, planners=planners, seeds=seeds, budget=budget
    )
    outcome_of(run._replace(experiment=alone), item, seconds)


@lru_cache(maxsize=4)
def _item(suite: str, index: int | str) -> tuple[SuiteItem, float]:
    """An item, with goals sampled once for all planners, and the seconds [s] that took."""
    item = suite_named(suite).item(index)
    return with_sampled_goals(item) if isinstance(item, PlanningProblem) else (item, 0.0)
