"""The paper's multi-sequence table from rows of phases: planning, execution and total time of whole tasks.

A row is one planned phase. Times of a task are sums over its phases: those that the paper times, or all.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter

from cvqmpt_lab.results.phase_name import PAPER_PHASES, split_problem
from cvqmpt_lab.results.row import FailReason, ResultRow, sorted_rows
from cvqmpt_lab.results.statistics import Interval
from paper_tables.comparison import Statistic, Value, censored, mean, network_time, share, typical
from paper_tables.paper_numbers import PublishedValue, notes_on
from paper_tables.statements import Statement, Verdict, judged
from paper_tables.summary import (
    Metric,
    PlannerSummary,
    Runs,
    by_planner,
    rows_of_one_suite,
    seed_notes,
    summarised,
)

SOLVED = attrgetter("solved")
PARTS: Mapping[str, Collection[str] | None] = {"paper": PAPER_PHASES, "all": None}
"""Phases that a time sums over, by name; None: all."""


def task_rows(rows: Iterable[ResultRow], phases: Collection[str] | None = None) -> list[ResultRow]:
    """One row for each task, planner, seed and backend: sums over the named phases, or all.

    ``t_total_s`` is planning and ``execution_time_s`` execution. A task is solved when all its phases
    are, the others too; the reason of a failure is that of its first failed phase.
    """
    groups: dict[tuple, list[ResultRow]] = {}
    for row in sorted_rows(rows):
        groups.setdefault(row.key._replace(problem=row.item), []).append(row)
    return [_task_row(group, phases) for group in groups.values()]


def _task_row(group: Sequence[ResultRow], phases: Collection[str] | None) -> ResultRow:
    failed = next((row for row in group if not row.solved), None)
    counted = [row for row in group if phases is None or split_problem(row.problem).phase in phases]
    return ResultRow(
        **group[0].key._replace(problem=group[0].item)._asdict(),
        solved=failed is None,
        fail_reason=failed.fail_reason if failed else None,
        detail=f"{split_problem(failed.problem).phase}: {failed.detail or failed.fail_reason}"
        if failed
        else None,
        certified=True if failed is None else None,
        t_total_s=sum(row.t_total_s or 0.0 for row in counted),
        execution_time_s=sum(row.execution_time_s or 0.0 for row in counted) if failed is None else None,
        path_length_rad=sum(row.path_length_rad or 0.0 for row in counted) if failed is None else None,
    )


def total_time(row: ResultRow) -> float | None:
    """Planning and execution of a row [s]."""
    if row.t_total_s is None or row.execution_time_s is None:
        return None
    return row.t_total_s + row.execution_time_s


TIMES: Mapping[str, tuple[str, Value]] = {
    "planning_time": ("Planning", attrgetter("t_total_s")),
    "execution_time": ("Execution", attrgetter("execution_time_s")),
    "total_time": ("Total", total_time),
}
"""Metrics of the paper's table: published name, label, value of a task's row."""

PHASE_COLUMNS: Mapping[str, tuple[str, Value]] = {
    "goals": ("goals [s]", attrgetter("t_goals_s")),
    "networks": ("networks [s]", network_time),
    "search": ("search [s]", attrgetter("t_plan_s")),
    "simplify": ("simplify [s]", attrgetter("t_simplify_s")),
    "planning": ("planning [s]", attrgetter("t_total_s")),
    "execution": ("execution [s]", attrgetter("execution_time_s")),
    "length": ("path length [rad]", attrgetter("path_length_rad")),
}
"""Medians of the breakdown by phase, beside the share that was solved."""


def time_metric(time: str, part: str, statistic: str) -> str:
    """Name of a metric: a time of `TIMES`, summed over a part of `PARTS`, as "mean" or "median"."""
    return f"{time}_of_{part}_phases_{statistic}"


def phase_metric(column: str, phase: str) -> str:
    """Name of a metric of one phase: "solved" or one of `PHASE_COLUMNS`."""
    return f"{column}_in_{phase}"


def metrics(phases: Iterable[str]) -> dict[str, Metric]:
    """Everything that is measured of tasks of these phases."""
    found = {"solved": Metric("solved [%]", "%", lambda runs: share(task_rows(runs.rows), SOLVED))}
    for part, counted in PARTS.items():
        for time, (label, value) in TIMES.items():
            published = time if part == "paper" else None
            found[time_metric(time, part, "mean")] = Metric(
                label, "s", _over_tasks(mean, value, counted), published
            )
            found[time_metric(time, part, "median")] = Metric(
                label, "s", _over_tasks(typical, value, counted)
            )
    for phase in phases:
        found[phase_metric("solved", phase)] = Metric("solved [%]", "%", _solved_in(phase))
        for column, (label, value) in PHASE_COLUMNS.items():
            unit = "rad" if column == "length" else "s"
            found[phase_metric(column, phase)] = Metric(label, unit, _median_in(phase, value))
    return found


def _over_tasks(
    statistic: Statistic, value: Value, phases: Collection[str] | None
) -> Callable[[Runs], Interval]:
    """Over all tasks, failures as infinite."""
    return lambda runs: statistic(censored(task_rows(runs.rows, phases), value))


def reached(rows: Iterable[ResultRow], phase: str) -> list[ResultRow]:
    """Rows of a phase that was tried."""
    return [
        row
        for row in rows
        if split_problem(row.problem).phase == phase and row.fail_reason is not FailReason.NOT_REACHED
    ]


def _solved_in(phase: str) -> Callable[[Runs], Interval]:
    return lambda runs: share(reached(runs.rows, phase), SOLVED)


def _median_in(phase: str, value: Value) -> Callable[[Runs], Interval]:
    """Over the runs that reached the phase, failures as infinite."""
    return lambda runs: typical(censored(reached(runs.rows, phase), value))


STATEMENTS = (
    Statement("reduces planning time by 45 %", "planning_time", 0.45),
    Statement("reduces execution time by 18 %", "execution_time", 0.18),
)


@dataclass(frozen=True)
class PhasesTable:
    """Everything a rendering needs."""

    suite: str
    n_tasks: int
    phases: tuple[str, ...]
    planners: tuple[PlannerSummary, ...]
    verdicts: tuple[Verdict, ...]
    footnotes: tuple[str, ...]
    published_notes: tuple[str, ...]


def build_phases_table(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> PhasesTable:
    """Summarise the rows of the multi-sequence task beside the paper's numbers.

    Planners that were not run are left out, and statements about them.

    Raises
    ------
    InvalidInputError
        For rows of several suites, or that are no phases.
    """
    rows = rows_of_one_suite(rows)
    names = [split_problem(row.problem) for row in rows]
    phases = tuple(phase for _, phase in sorted({(name.number, name.phase) for name in names}))
    groups = by_planner(rows, published)
    run = {row.planner for row in rows}
    measured = metrics(phases)
    return PhasesTable(
        suite=rows[0].suite,
        n_tasks=len({name.task for name in names}),
        phases=phases,
        planners=tuple(summarised(name, Runs(group), published, measured) for name, group in groups.items()),
        verdicts=judged(
            STATEMENTS,
            task_rows(rows, PAPER_PHASES),
            published,
            {time: value for time, (_, value) in TIMES.items()},
        ),
        footnotes=tuple(seed_notes(groups)),
        published_notes=tuple(notes_on(value for value in published if value.planner in run)),
    )
