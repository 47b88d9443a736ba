"""The paper's place-task table beside our own, as plain data built from rows.

The same rows give the same `Table`, whatever their order; ``paper_tables/render.py`` prints it.
"""

import csv
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.statistics import (
    Interval,
    ProblemKey,
    jointly_solved,
    mean_of_solved,
    median_interval,
    problem_key,
    wilson_interval,
)
from cvqmpt_lab.results.store import ResultRow, sorted_rows
from paper_tables.comparison import (
    RATIOS,
    REFERENCE,
    PaperCosts,
    Split,
    censored,
    paired_ratio,
    split_by_work,
    split_metric,
)

BASELINE = "ompl-projected"
CONFIDENCE = 0.95
CURVE_TIMES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
PUBLISHED_COLUMNS = ("table", "environment", "planner", "paper_name", "metric", "value", "unit", "note")


@dataclass(frozen=True)
class PublishedValue:
    """One number of the paper; ``printed`` is its text there."""

    environment: str
    planner: str
    paper_name: str
    metric: str
    printed: str
    unit: str
    note: str


@dataclass(frozen=True)
class Headline:
    """A row of the paper's table: its metric there, and ours that answer it (the paper gives means)."""

    label: str
    unit: str
    published: str
    typical: str
    mean: str | None


@dataclass(frozen=True)
class PlannerSummary:
    """One planner of a table: the paper's values, ours by metric name, and why runs failed."""

    name: str
    paper_name: str | None
    n_runs: int
    published: Mapping[str, PublishedValue]
    measured: Mapping[str, Interval]
    failures: tuple[tuple[str, str, int], ...]  # (status, fail reason or "", runs)


@dataclass(frozen=True)
class Table:
    """Everything a rendering needs, for one suite."""

    suite: str
    n_problems: int
    n_joint: int
    curve_times: tuple[float, ...]  # [s]
    planners: tuple[PlannerSummary, ...]
    footnotes: tuple[str, ...]
    published_notes: tuple[str, ...]
    n_easy: int  # problems by the work of `comparison.REFERENCE`; 0 and 0 where that was not run
    n_hard: int


HEADLINES = (
    Headline("Accuracy", "%", "accuracy", "accuracy", None),
    Headline("Time", "s", "time", "time_median", "time_mean"),
    Headline("Vertices", "1", "vertices", "vertices_median", "vertices_mean"),
    Headline("Path length", "rad", "path_length", "path_length_median", "path_length_mean"),
)
EFFORT = {
    "path_length_raw_median": ("raw length [rad]", "rad"),
    "projections_median": ("projections", "1"),
    "newton_iterations_median": ("Newton iterations", "1"),
    "state_checks_median": ("state checks", "1"),
    "time_ratio": (f"time / {BASELINE}", "1"),
}
COSTS = PaperCosts()
COST_RATIO_BASELINES = (REFERENCE, BASELINE)
PAPER_COST = {
    "paper_cost_median": ("time at the paper's cost [s]", "s"),
    **{f"paper_cost_ratio_{name}": (f"the same / {name}", "1") for name in COST_RATIO_BASELINES},
}
METHOD_NOTES = (
    "Ours: estimate [95 % interval]; round brackets mark the whole range: too few runs for 95 %.",
    "Accuracy: certified paths / runs, Wilson interval; a path that fails its certificate is a failure.",
    "Time: total wall time, goal inverse kinematics and networks included, making point clouds not. Median over "
    "all runs with failures counted as infinite, order-statistic interval; the mean, because the paper gives "
    "means, leaves failures out (bootstrap interval).",
    "Vertices: median and mean over solved runs. Path length: final path, Euclidean in joint space; "
    "raw length: before simplification; both over the jointly solved runs.",
    "Projections, Newton iterations, state checks: medians over all runs with failures counted as infinite.",
    f"Time / {BASELINE}: geometric mean of the ratio over problems solved by both, bootstrap interval.",
    f"At the paper's cost: {1e3 * COSTS.state_check:g} ms a state check (PyBullet, itself and obstacles), "
    f"{1e3 * COSTS.projection:g} ms a projection (Newton's method in Python; a lower bound), networks as measured "
    "here, goals and simplification left out. Median with failures as infinite; ratios as above.",
    f"Easy and hard: hard are the problems in the top third by the work (projections + state checks) of {REFERENCE} "
    "with uniform samples, median over seeds. Ratios are geometric means over problems that both solved, bootstrap "
    "intervals; time includes goal inverse kinematics, which is the same for all.",
)


def read_published(path: Path, environment: str | None = None) -> tuple[PublishedValue, ...]:
    """Read the paper's numbers, those of one environment or all.

    Raises
    ------
    InvalidInputError
        When the columns are not `PUBLISHED_COLUMNS` or a value is not a number.
    """
    with Path(path).open(encoding="utf-8", newline="") as handle:
        reader = csv.DictReader(handle)
        if tuple(reader.fieldnames or ()) != PUBLISHED_COLUMNS:
            raise InvalidInputError(f"{path}, line 1: columns must be {','.join(PUBLISHED_COLUMNS)}")
        values = []
        for record in reader:
            try:
                float(record["value"])
            except (TypeError, ValueError):
                message = f"{path}, line {reader.line_num}, column value: {record['value']!r} is no number"
                raise InvalidInputError(message) from None
            if environment in (None, record["environment"]):
                fields = {name: record[name] for name in PUBLISHED_COLUMNS if name not in ("table", "value")}
                values.append(PublishedValue(printed=record["value"], **fields))
    return tuple(values)


def build_place_table(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> Table:
    """Summarise the rows of one suite beside the paper's numbers.

    Planners come in the paper's order, then any others by name. A planner with rows of several backends
    becomes one entry for each.

    Raises
    ------
    InvalidInputError
        Without rows, or with rows of more than one suite.
    """
    rows = sorted_rows(rows)
    suites = sorted({row.suite for row in rows})
    if len(suites) != 1:
        raise InvalidInputError(f"a table needs the rows of one suite, got {len(suites)}: {suites}")
    groups = _groups(rows)
    solving = {name: group for name, group in groups.items() if any(row.solved for row in group)}
    joint = jointly_solved(solving)
    baselines = {
        name: next((group for group in groups.values() if group[0].planner == name), [])
        for name in COST_RATIO_BASELINES
    }
    split = split_by_work(baselines[REFERENCE])
    slowest = max((row.t_total_s or 0.0 for row in rows), default=0.0)
    n_times = sum(time < slowest for time in CURVE_TIMES) + 1
    times = CURVE_TIMES[:n_times]
    order = list(dict.fromkeys(value.planner for value in published))
    summaries = []
    for planner in order + sorted({row.planner for row in rows} - set(order)):
        own = {name: group for name, group in groups.items() if group[0].planner == planner} or {planner: []}
        summaries += [_summary(name, own[name], published, joint, baselines, split, times) for name in own]
    return Table(
        suite=suites[0],
        n_problems=len({row.problem for row in rows}),
        n_joint=len(joint),
        curve_times=times,
        planners=tuple(summaries),
        footnotes=_footnotes(groups, solving, len(joint), summaries),
        published_notes=_published_notes(published),
        n_easy=len(split.easy),
        n_hard=len(split.hard),
    )


def _groups(rows: Sequence[ResultRow]) -> dict[str, list[ResultRow]]:
    """Rows by planner; by planner and backend where a planner ran with several."""
    backends: dict[str, set[str]] = {}
    for row in rows:
        backends.setdefault(row.planner, set()).add(row.backend)
    groups: dict[str, list[ResultRow]] = {}
    for row in sorted(rows, key=lambda row: (row.planner, row.backend)):  # stable: problems keep their order
        several = len(backends[row.planner]) > 1
        groups.setdefault(f"{row.planner} [{row.backend}]" if several else row.planner, []).append(row)
    return groups


def _summary(
    name: str,
    rows: Sequence[ResultRow],
    published: Iterable[PublishedValue],
    joint: Collection[ProblemKey],
    baselines: Mapping[str, Sequence[ResultRow]],
    split: Split,
    times: Sequence[float],
) -> PlannerSummary:
    planner = rows[0].planner if rows else name
    paper = {value.metric: value for value in published if value.planner == planner}
    failures = Counter((row.status, row.fail_reason or "") for row in rows if not row.solved)
    ordered = sorted(failures.items(), key=lambda item: (-item[1], item[0]))
    return PlannerSummary(
        name=name,
        paper_name=next((value.paper_name for value in paper.values()), None),
        n_runs=len(rows),
        published=paper,
        measured=_measured(rows, frozenset(joint), baselines, split, times) if rows else {},
        failures=tuple((status, reason, count) for (status, reason), count in ordered),
    )


def _measured(
    rows: Sequence[ResultRow],
    joint: Collection[ProblemKey],
    baselines: Mapping[str, Sequence[ResultRow]],
    split: Split,
    times: Sequence[float],
) -> dict[str, Interval]:
    """Every metric of one planner; each bootstrap starts from the same seed, so columns do not interact."""
    solved = [row for row in rows if row.solved]
    shared = [row for row in solved if problem_key(row) in joint]
    total = _censored(rows, "t_total_s")
    measured = {
        "accuracy": wilson_interval(len(solved), len(rows), CONFIDENCE).scaled(100),
        "time_median": median_interval(total, CONFIDENCE),
        "time_mean": _mean(total),
        "vertices_median": median_interval(_defined(solved, "vertices"), CONFIDENCE),
        "vertices_mean": _mean(_defined(solved, "vertices")),
        "path_length_median": median_interval(_defined(shared, "path_length_rad"), CONFIDENCE),
        "path_length_mean": _mean(_defined(shared, "path_length_rad")),
        "path_length_raw_median": median_interval(_defined(shared, "path_length_raw_rad"), CONFIDENCE),
        "projections_median": median_interval(_censored(rows, "n_projections"), CONFIDENCE),
        "newton_iterations_median": median_interval(_censored(rows, "n_newton_iterations"), CONFIDENCE),
        "state_checks_median": median_interval(_censored(rows, "n_state_checks"), CONFIDENCE),
        "time_ratio": paired_ratio(rows, baselines[BASELINE], lambda row: row.t_total_s, CONFIDENCE),
        "paper_cost_median": median_interval(censored(rows, COSTS.of), CONFIDENCE),
    }
    for name, reference in baselines.items():
        ratio = paired_ratio(rows, reference, COSTS.of, CONFIDENCE)
        measured[f"paper_cost_ratio_{name}"] = ratio
    for metric, (_, value) in RATIOS.items():
        for part, problems in split.parts.items():
            ratio = paired_ratio(rows, baselines[REFERENCE], value, CONFIDENCE, problems)
            measured[split_metric(metric, part)] = ratio
    for time in times:
        within = sum(value <= time for value in total)
        measured[curve_metric(time)] = wilson_interval(within, len(rows), CONFIDENCE).scaled(100)
    return measured


def curve_metric(time: float) -> str:
    """Name of the metric "solved within `time` [s]"."""
    return f"solved_within_{time:g}_s"


def _defined(rows: Iterable[ResultRow], column: str) -> list[float]:
    return [float(value) for value in (getattr(row, column) for row in rows) if value is not None]


def _censored(rows: Sequence[ResultRow], column: str) -> list[float]:
    return censored(rows, lambda row: getattr(row, column))


def _mean(values: Sequence[float]) -> Interval:
    return mean_of_solved(values, np.random.default_rng(0), confidence=CONFIDENCE)


def _footnotes(
    groups: Mapping[str, Sequence[ResultRow]],
    solving: Collection[str],
    n_joint: int,
    summaries: Iterable[PlannerSummary],
) -> tuple[str, ...]:
    names = ", ".join(solving) or "no planner"
    notes = [f"Jointly solved: {n_joint} runs (problem and seed), each solved by all of {names}."]
    silent = [name for name in groups if name not in solving]
    if silent:
        notes.append(f"Solved nothing, so left out of the jointly solved set: {', '.join(silent)}.")
    if len({frozenset(map(problem_key, group)) for group in groups.values()}) > 1:
        notes.append(
            "The planners did not all run the same problems and seeds: their columns do not compare."
        )
    if len({row.seed for group in groups.values() for row in group}) > 1:
        notes.append(
            "Several seeds: runs count one by one except in the time ratio; intervals may be narrow."
        )
    if len({row.seed for group in groups.values() for row in group if row.planner == REFERENCE}) == 1:
        notes.append(
            f"One seed of {REFERENCE}: a problem on which it was unlucky counts as hard, so every other planner's "
            "ratios look better on hard problems, and worse on easy ones, than several seeds would show."
        )
    missing = [summary.name for summary in summaries if summary.n_runs == 0]
    if missing:
        notes.append(f"{', '.join(missing)}: not run here.")
    return tuple(notes)


def _published_notes(published: Iterable[PublishedValue]) -> tuple[str, ...]:
    """Notes on the paper's numbers, each once, with the metric and the planners it belongs to."""
    owners: dict[tuple[str, str], list[str]] = {}
    for value in published:
        if value.note:
            owners.setdefault((value.metric, value.note), []).append(value.paper_name)
    return tuple(f"{metric} ({', '.join(names)}): {note}" for (metric, note), names in owners.items())
