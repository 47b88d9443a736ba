"""The paper's Table II: planning, execution and total time of whole tasks, and every phase.

A row is one planned phase. Times of a task are sums over all its phases, or over the phases that
the paper times.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

from cvqmpt_lab.benchmarks.results.row import (
    PAPER_PHASES,
    FailReason,
    ResultRow,
    sorted_rows,
    split_problem,
)
from cvqmpt_lab.paper_tables import table_engine as table
from cvqmpt_lab.paper_tables.measures import (
    Measure,
    grouped,
    mean_of,
    median_of,
    share_of,
    solved,
)
from cvqmpt_lab.paper_tables.ompl_table import capped, mean_cost
from cvqmpt_lab.paper_tables.statements import CBIRRT, PublishedValue, in_ompl
from cvqmpt_lab.paper_tables.table_engine import Column, Entry, SuiteTable
from cvqmpt_lab.paper_tables.writers import Lines, number

# phases over which times are summed, by part of the task; None: all phases
PHASES_OF_PART: Mapping[str, Collection[str] | None] = {"paper": PAPER_PHASES, "all": None}
TASK_PARTS = {
    "paper": "the three phases that the paper times (reach the handle, reach the can, carry)",
    "all": "all planned phases",
}
TIMES = {"planning_time": "Planning", "execution_time": "Execution", "total_time": "Total"}
TASK_STATISTICS = {"mean": mean_of, "median": median_of}


def task_rows(rows: Iterable[ResultRow], phases: Collection[str] | None = None) -> list[ResultRow]:
    """Return a row for each task, planner, seed and backend, with sums over phases.

    ``t_total_s`` is the planning time and ``execution_time_s`` the execution time. A task is solved
    if all its phases are solved, also those that are not summed; otherwise it fails for the reason
    of its first failed phase.

    Args:
        rows: rows of phases.
        phases: names of the phases whose times and lengths are summed; None: all phases.
    """
    tasks = []
    for group in grouped([(row.run_key, row) for row in sorted_rows(rows)]).values():
        failed = next((row for row in group if not row.solved), None)
        counted = [
            row for row in group if phases is None or split_problem(row.problem).phase in phases
        ]
        phase = split_problem(failed.problem).phase if failed else ""
        task = ResultRow(
            suite=group[0].suite,
            problem=group[0].item,
            planner=group[0].planner,
            seed=group[0].seed,
            backend=group[0].backend,
            solved=failed is None,
            fail_reason=failed.fail_reason if failed else None,
            detail=f"{phase}: {failed.detail or failed.fail_reason}" if failed else None,
            certified=None if failed else True,
            t_total_s=sum(row.t_total_s or 0.0 for row in counted),
            execution_time_s=None
            if failed
            else sum(row.execution_time_s or 0.0 for row in counted),
            path_length_rad=None if failed else sum(row.path_length_rad or 0.0 for row in counted),
        )
        tasks.append(task)
    return tasks


def of_tasks(measure: Measure, phases: Collection[str] | None = None) -> Measure:
    """Return a measure of whole tasks instead of phases."""
    summed = None if phases is None else tuple(phases)
    return lambda rows, runs: measure(_tasks_of(_Same(rows), summed), runs)


class _Same(NamedTuple):
    """Rows that are equal only to themselves, as the key of a cache that does not compare them."""

    rows: Iterable[ResultRow]

    def __hash__(self) -> int:
        return id(self.rows)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.rows is other.rows


@lru_cache(maxsize=len(PHASES_OF_PART) + 1)  # one planner's rows, for all columns of its entry
def _tasks_of(rows: _Same, phases: tuple[str, ...] | None) -> list[ResultRow]:
    return task_rows(rows.rows, phases)


def time_metric(time: str, part: str, statistic: str) -> str:
    """Return a column name, from keys of `TIMES`, `TASK_PARTS` and `TASK_STATISTICS`."""
    return f"{time}_of_{part}_phases_{statistic}"


TASK_COLUMNS: Mapping[str, Column] = {
    "solved": Column("Solved", "%", of_tasks(share_of(solved)), best="most"),
    **{
        time_metric(time, part, name): Column(
            label,
            "s",
            of_tasks(statistic(time), phases),
            time if (part, name) == ("paper", "mean") else None,
        )
        for part, phases in PHASES_OF_PART.items()
        for time, label in TIMES.items()
        for name, statistic in TASK_STATISTICS.items()
    },
}


def _median(label: str, value: str, unit: str = "s", interval: bool = False) -> Column:
    """Return a column with the median over runs that reached the phase; failures are infinite."""
    column = Column(f"{label} [{unit}]", unit, median_of(value))
    return column if interval else replace(column, cell=lambda ours: number(ours.estimate))


PHASE_COLUMNS: Mapping[str, Column] = {
    "solved": Column(
        "solved [%]", "%", share_of(solved), cell=lambda ours: number(ours.estimate), best="most"
    ),
    "goals": _median("goals", "goals_time"),
    "networks": _median("networks", "network_time"),
    "search": _median("search", "search_time"),
    "simplify": _median("simplify", "simplify_time"),
    "planning": _median("planning", "planning_time", interval=True),
    "execution": _median("execution", "execution_time", interval=True),
    "length": _median("path length", "path_length", "rad"),
}
COST_COLUMN = Column("cost [s]", "s", mean_cost("search_cost"))
TASK_HEADLINES = {"accuracy": {"ours": "solved"}} | {
    time: {"ours": time_metric(time, "paper", "mean")} for time in TIMES
}
TASK_NOTES = (
    "Ours: estimate [95 % interval]; in round brackets the range of all runs, if these are too few "
    "for an interval.",
    "A task counts as solved when every phase has a certified path that could be timed; Wilson "
    "interval.",
    "Execution: duration of the fastest motion within a tenth of the joints' velocity and "
    "acceleration limits, at rest between phases. The paper's number is the wall-clock time of a "
    "simulated controller that follows waypoints, so that only ratios can be compared.",
    "Fallbacks: phases whose path was found by another method than the named planner; they count "
    "as runs of the named planner.",
)
OF_SOLVED = (
    "Mean over solved tasks (bootstrap interval), because the paper gives means; in the median, "
    "failures count as infinite."
)
TIMED_NOTE = (
    "Planning: wall-clock time of goals, networks, search and simplification, including attempts "
    f"that were undone later. {OF_SOLVED}"
)
PRICED_NOTE = (
    "Planning, and cost of a phase (mean over solved runs): counted work at the prices of the "
    "published code, at most 100 s a phase; other times of phases are seconds of this machine. "
    f"{OF_SOLVED}"
)

ABSENT = (
    f"{CBIRRT} has no rows here. With a limit of 2 s per search it solved neither of the first two "
    "tasks: each took half a minute, with ten attempts to reach the can."
)


def task_table(
    rows: Iterable[ResultRow],
    published: Sequence[PublishedValue],
    notes: Sequence[str] = (),
    priced: bool = False,
) -> SuiteTable:
    """Return the paper's Table II for both sets of phases, phases, fallbacks, failures and notes.

    Args:
        rows: rows of one suite of tasks.
        published: the paper's numbers.
        notes: further notes of the suite.
        priced: whether planning is the price of counted work, for planners inside OMPL.

    Raises:
        InvalidInputError: a row is not a phase of a task.
    """
    if priced:
        published = in_ompl(published)
    runs = table.suite_runs(rows, published)
    names = {split_problem(row.problem) for row in runs.rows}
    phases = [phase for _, phase in sorted({(name.number, name.phase) for name in names})]
    found, tasks, by_phase = [], [], []
    columns = {"cost": COST_COLUMN, **PHASE_COLUMNS} if priced else PHASE_COLUMNS
    cost = capped("search_cost")
    for name, own in runs.groups.items():
        timed = [replace(row, t_total_s=cost(row)) for row in own] if priced else own
        tasks.append(table.entry(name, timed, runs, TASK_COLUMNS, published))
        reached = [row for row in own if row.fail_reason is not FailReason.NOT_REACHED]
        tried = grouped((split_problem(row.problem).phase, row) for row in reached)
        parts = [
            table.entry(
                name,
                tried.get(phase, []),
                runs,
                columns,
                group=(phase,),
                suffix=f"_in_{phase}",
            )
            for phase in phases
        ]
        by_phase += parts
        found += [tasks[-1], *parts]
    by_phase.sort(key=lambda item: phases.index(item.group[0]))
    size, suite = f"{len({name.task for name in names})} tasks", runs.rows[0].suite
    only_timed = set(phases) <= set(PAPER_PHASES)
    sections = {
        **{
            f"{size}, {text}": _time_lines(tasks, part)
            for part, text in TASK_PARTS.items()
            if part == "paper" or not only_timed
        },
        "By phase (medians over the runs that reached it)": table.group_lines(
            by_phase, ["phase"], "n"
        ),
        **table.counted(tasks),
        "Notes": [
            *TASK_NOTES,
            PRICED_NOTE if priced else TIMED_NOTE,
            *notes,
            *([] if CBIRRT in runs.groups else [ABSENT]),
            *table.run_notes(runs),
            *table.published_notes(runs, published),
        ],
    }
    latex = partial(table.latex_planners, found=tasks, metrics=TASK_HEADLINES)
    return SuiteTable(suite, size, found, sections, latex)


def _time_lines(found: Sequence[Entry], part: str) -> Lines:
    """Return a table of solved tasks and times; with the paper's times for part "paper"."""
    ours = part == "paper"
    lines = [["planner", "tasks run", "solved [%]"]]
    for label in TIMES.values():
        paper = [f"{label} [s]: paper", "ours, mean"]
        lines[0] += [*(paper if ours else [f"{label} [s]: mean"]), "median"]
    columns = [table.cells_of(found, "solved")]
    for time in TIMES:
        columns += [[item.paper_cell(time) for item in found]] if ours else []
        names = [time_metric(time, part, name) for name in TASK_STATISTICS]
        columns += [table.cells_of(found, name) for name in names]
    for item, *cells in zip(found, *columns, strict=True):
        lines.append([item.title, str(item.n_runs), *cells])
    return lines
