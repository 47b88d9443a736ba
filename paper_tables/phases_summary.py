"""The paper's multi-sequence table from rows of phases: planning, execution and total time of whole tasks.

A row is one planned phase; its problem is named ``TASK/NUMBER-PHASE``, as in ``3/5-carry``. Times of a
task are sums over its phases: those that the paper times, or all.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.statistics import Interval, mean_of_solved, median_interval, wilson_interval
from cvqmpt_lab.results.store import ResultRow, sorted_rows
from paper_tables.comparison import Value, censored, paired_ratio
from paper_tables.place_task_summary import CONFIDENCE, PublishedValue

PAPER_PHASES = ("reach-handle", "reach-can", "carry")
"""The phases whose times the paper's add up to, as far as can be inferred."""


def phase_problem(task: str, number: int, phase: str) -> str:
    """Name of a phase's problem in rows."""
    return f"{task}/{number}-{phase}"


class PhaseName(NamedTuple):
    """What the problem of a row says: the task, and the number and name of one of its phases."""

    task: str
    number: int
    phase: str


def split_problem(problem: str) -> PhaseName:
    """Inverse of `phase_problem`; InvalidInputError for rows of another kind."""
    task, slash, rest = problem.rpartition("/")
    number, dash, phase = rest.partition("-")
    if not (slash and dash and number.isdecimal()):
        raise InvalidInputError(f"problem {problem!r} is no phase of a task, such as 3/5-carry")
    return PhaseName(task, int(number), phase)


def task_rows(rows: Iterable[ResultRow], phases: Collection[str] | None = None) -> list[ResultRow]:
    """One row for each task, planner, seed and backend: sums over the named phases, or all.

    ``t_total_s`` is planning and ``execution_time_s`` execution. A task is solved when all its phases
    are, the others too; the reason of a failure is that of its first failed phase.
    """
    groups: dict[tuple, list[ResultRow]] = {}
    for row in sorted_rows(rows):
        key = (row.suite, split_problem(row.problem).task, row.planner, row.seed, row.backend)
        groups.setdefault(key, []).append(row)
    return [_task_row(group, phases) for group in groups.values()]


def _task_row(group: Sequence[ResultRow], phases: Collection[str] | None) -> ResultRow:
    failed = next((row for row in group if not row.solved), None)
    counted = [row for row in group if phases is None or split_problem(row.problem).phase in phases]
    first = group[0]
    reason = None
    if failed is not None:
        reason = f"{split_problem(failed.problem).phase}: {failed.fail_reason}"
    return ResultRow(
        suite=first.suite,
        problem=split_problem(first.problem).task,
        planner=first.planner,
        seed=first.seed,
        backend=first.backend,
        status="solved" if failed is None else failed.status,
        fail_reason=reason,
        solved=failed is None,
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
    "planning_time": ("Planning", lambda row: row.t_total_s),
    "execution_time": ("Execution", lambda row: row.execution_time_s),
    "total_time": ("Total", total_time),
}
"""Metrics of the paper's table: published name, label, value of a row."""


@dataclass(frozen=True)
class Statement:
    """A sentence of the paper about its times: `planner` needs `reduction` (a fraction) less than `baseline`."""

    text: str
    metric: str
    reduction: float
    planner: str = "opt-cvq-mpt"
    baselines: tuple[str, ...] = ("ompl-projected", "atlas-rrt", "tb-rrt")


STATEMENTS = (
    Statement("reduces planning time by 45 %", "planning_time", 0.45),
    Statement("reduces execution time by 18 %", "execution_time", 0.18),
)


@dataclass(frozen=True)
class Verdict:
    """A statement against one baseline: the paper's own numbers, ours with interval [fractions], in words."""

    statement: Statement
    baseline: str
    paper: float | None
    ours: Interval
    verdict: str


@dataclass(frozen=True)
class PlannerTimes:
    """One planner: the paper's values, ours by (part, metric), success, why tasks failed.

    Attributes
    ----------
    means, medians: by part ("paper" or "all" phases) and metric of `TIMES` [s].
    phases: by phase, then metric of `PHASE_COLUMNS`.
    instead: (phase, sampler) of phases in which another planner took over.
    """

    name: str
    paper_name: str | None
    n_runs: int
    success: Interval
    published: Mapping[str, PublishedValue]
    means: Mapping[tuple[str, str], Interval]
    medians: Mapping[tuple[str, str], Interval]
    phases: Mapping[str, Mapping[str, Interval]]
    failures: tuple[tuple[str, int], ...]
    instead: tuple[tuple[str, str], ...]


PHASE_COLUMNS: Mapping[str, tuple[str, Value]] = {
    "success": ("solved [%]", lambda row: None),
    "goals": ("goals [s]", lambda row: row.t_goals_s),
    "networks": (
        "networks [s]",
        lambda row: sum(t or 0.0 for t in (row.t_encode_s, row.t_predict_s, row.t_optimize_s)),
    ),
    "search": ("search [s]", lambda row: row.t_plan_s),
    "simplify": ("simplify [s]", lambda row: row.t_simplify_s),
    "planning": ("planning [s]", lambda row: row.t_total_s),
    "execution": ("execution [s]", lambda row: row.execution_time_s),
    "length": ("path length [rad]", lambda row: row.path_length_rad),
}


@dataclass(frozen=True)
class PhasesTable:
    """Everything a rendering needs."""

    suite: str
    n_tasks: int
    phases: tuple[str, ...]
    planners: tuple[PlannerTimes, ...]
    verdicts: tuple[Verdict, ...]


def build_phases_table(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> PhasesTable:
    """Summarise the rows of the multi-sequence task beside the paper's numbers.

    Raises
    ------
    InvalidInputError: rows of several suites, or that are no phases.
    """
    rows = sorted_rows(rows)
    suites = sorted({row.suite for row in rows})
    if len(suites) != 1:
        raise InvalidInputError(f"a table needs the rows of one suite, got {len(suites)}: {suites}")
    names = [split_problem(row.problem) for row in rows]
    ordered = sorted({(name.number, name.phase) for name in names})
    phases = tuple(phase for _, phase in ordered)
    papers = list(dict.fromkeys(value.planner for value in published))
    own = {row.planner for row in rows}
    planners = [*papers, *sorted(own - set(papers))]
    return PhasesTable(
        suite=suites[0],
        n_tasks=len({name.task for name in names}),
        phases=phases,
        planners=tuple(
            _planner_times(name, [row for row in rows if row.planner == name], phases, published)
            for name in planners
        ),
        verdicts=tuple(
            _verdict(statement, baseline, rows, published)
            for statement in STATEMENTS
            for baseline in statement.baselines
        ),
    )


def _planner_times(
    name: str, rows: Sequence[ResultRow], phases: Sequence[str], published: Sequence[PublishedValue]
) -> PlannerTimes:
    values = {value.metric: value for value in published if value.planner == name}
    tasks = {"paper": task_rows(rows, PAPER_PHASES), "all": task_rows(rows)}
    solved = sum(row.solved for row in tasks["all"])
    means, medians = {}, {}
    for part, group in tasks.items():
        for metric, (_, value) in TIMES.items():
            times = censored(group, value)
            means[part, metric] = mean_of_solved(times, np.random.default_rng(0), confidence=CONFIDENCE)
            medians[part, metric] = median_interval(times, CONFIDENCE)
    failures = Counter(row.fail_reason or row.status for row in tasks["all"] if not row.solved)
    instead = {
        (split_problem(row.problem).phase, row.sampler_used)
        for row in rows
        if row.sampler_used and "instead" in row.sampler_used
    }
    return PlannerTimes(
        name=name,
        paper_name=next((value.paper_name for value in values.values()), None),
        n_runs=len(tasks["all"]),
        success=wilson_interval(solved, len(tasks["all"]), CONFIDENCE),
        published=values,
        means=means,
        medians=medians,
        phases={
            phase: _phase_columns([row for row in rows if split_problem(row.problem).phase == phase])
            for phase in phases
        },
        failures=tuple(sorted(failures.items())),
        instead=tuple(sorted(instead)),
    )


def _phase_columns(rows: Sequence[ResultRow]) -> dict[str, Interval]:
    """Success, and medians over the runs that reached the phase, failures as infinite."""
    reached = [row for row in rows if row.status != "not_reached"]
    columns = {
        name: median_interval(censored(reached, value), CONFIDENCE)
        for name, (_, value) in PHASE_COLUMNS.items()
        if name != "success"
    }
    success = wilson_interval(sum(row.solved for row in reached), len(reached), CONFIDENCE)
    return {"success": success.scaled(100.0), **columns}


def _verdict(
    statement: Statement, baseline: str, rows: Sequence[ResultRow], published: Sequence[PublishedValue]
) -> Verdict:
    """The ratio over tasks and seeds that both solved, of the phases that the paper times."""
    numbers = {value.planner: float(value.printed) for value in published if value.metric == statement.metric}
    paper = None
    if statement.planner in numbers and baseline in numbers:
        paper = 1.0 - numbers[statement.planner] / numbers[baseline]
    tasks = task_rows(rows, PAPER_PHASES)
    ratio = paired_ratio(
        [row for row in tasks if row.planner == statement.planner],
        [row for row in tasks if row.planner == baseline],
        TIMES[statement.metric][1],
        CONFIDENCE,
    )
    ours = Interval(_less(ratio.estimate), _less(ratio.high), _less(ratio.low), ratio.n)
    return Verdict(statement, baseline, paper, ours, _in_words(statement, ours))


def _less(ratio: float | None) -> float | None:
    return None if ratio is None else 1.0 - ratio


def _in_words(statement: Statement, ours: Interval) -> str:
    if ours.estimate is None or ours.low is None or ours.high is None:
        return "not judged: too few tasks that both solved"
    if ours.low >= statement.reduction:
        return "confirmed"
    if ours.high >= statement.reduction:
        return "compatible: the interval contains it"
    if ours.low > 0.0:
        return "less than stated"
    return "not confirmed: slower" if ours.high < 0.0 else "not confirmed: no clear difference"
