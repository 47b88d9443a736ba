"""Running planners over the multi-sequence tasks: in parallel processes, resumable, a row for each phase."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.methods.table import planner_named
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import BACKENDS
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.results.store import ResultRow, RunStore
from cvqmpt_lab.tasks.solve_task import solve_task
from cvqmpt_lab.tasks.task import PlannedPhase, Task
from cvqmpt_lab.trajectory.timing import SLOW
from experiments.run import end_with_parent, outcomes, require_planners
from experiments.suites.multi_sequence import multi_sequence_task
from experiments.task_rows import phase_rows
from experiments.warmup import compile_kernels
from paper_tables.phases_summary import split_problem

SUITE = "multi-sequence"


@dataclass(frozen=True)
class TaskExperiment:
    """What is run: tasks x planners x seeds; the budget is that of one phase."""

    tasks: tuple[int, ...]
    planners: tuple[str, ...]
    seeds: tuple[int, ...]
    budget: Budget
    backend: str = "compiled"

    def __post_init__(self) -> None:
        require_planners(self.planners)
        if self.backend not in BACKENDS:
            raise UnknownChoiceError("backend", self.backend, BACKENDS)
        for what in ("tasks", "planners", "seeds"):
            if not getattr(self, what):
                raise InvalidInputError(f"an experiment needs at least one of {what}")

    def settings(self) -> dict:
        """What must be equal for a run to be continued: everything that changes a row."""
        return {
            "suite": SUITE,
            "cutoff_s": self.budget.seconds,
            "iterations": self.budget.iterations,
            "backend": self.backend,
            "speed": SLOW,
        }


@dataclass(frozen=True)
class TaskRun:
    """One planner on one task with one seed."""

    task: int
    planner: str
    seed: int
    budget: Budget
    backend: str


@lru_cache(maxsize=16)
def _task(number: int) -> Task:
    return multi_sequence_task(number)


def run_one(run: TaskRun) -> list[ResultRow]:
    """Rows of all phases of a task."""
    solution = solve_task(
        _task(run.task), planner_named(run.planner), run.budget, run.seed, backend=run.backend
    )
    return phase_rows(SUITE, run.planner, run.seed, run.backend, solution)


def _warm_up(runs: tuple[TaskRun, ...]) -> None:
    """Load compiled code and planner libraries in a fresh worker, so that no row pays for it."""
    end_with_parent()
    compile_kernels(lambda _: None)
    for run in runs:
        run_one(run)


def run_tasks(
    experiment: TaskExperiment,
    out: Path,
    jobs: int,
    command: Sequence[str],
    on_progress: Callable[[int, int, str], None],
) -> list[ResultRow]:
    """Run what is not yet in `out` and return all rows, sorted; an interrupt keeps every finished task.

    Parameters
    ----------
    on_progress: called with (tasks done, tasks in all, a note on the last one).
    """
    if jobs < 1:
        raise InvalidInputError(f"jobs must be 1 or more, not {jobs}")
    runs = [
        TaskRun(task, planner, seed, experiment.budget, experiment.backend)
        for seed in experiment.seeds
        for task in experiment.tasks
        for planner in experiment.planners
    ]
    record = provenance(list(command), asdict(experiment), list(experiment.seeds), threads=jobs)
    with RunStore.open(out, experiment.settings(), record) as store:
        done = _done(store.rows())
        open_runs = [run for run in runs if (str(run.task), run.planner, run.seed, run.backend) not in done]
        finished = len(runs) - len(open_runs)
        on_progress(finished, len(runs), "")
        first = tuple(
            TaskRun(experiment.tasks[0], planner, 0, Budget(seconds=5.0), experiment.backend)
            for planner in experiment.planners
        )
        for rows in outcomes(run_one, open_runs, jobs, _warm_up, (first,)):
            finished += 1
            for row in rows:
                store.append(row)
            failed = next((row for row in rows if not row.solved), None)
            note = "solved" if failed is None else f"{split_problem(failed.problem).phase}: {failed.status}"
            on_progress(
                finished, len(runs), f"{rows[0].planner} {split_problem(rows[0].problem).task} {note}"
            )
        store.finish()
        return store.rows()


def _done(rows: Sequence[ResultRow]) -> set[tuple[str, str, int, str]]:
    """(task, planner, seed, backend) of which every phase has its row."""
    planned = sum(isinstance(phase, PlannedPhase) for phase in _task(0).phases)
    counts: dict[tuple[str, str, int, str], int] = {}
    for row in rows:
        key = (split_problem(row.problem).task, row.planner, row.seed, row.backend)
        counts[key] = counts.get(key, 0) + 1
    return {key for key, count in counts.items() if count == planned}
