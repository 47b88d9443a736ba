"""The paper's place-task table beside our own, as plain data built from rows.

The same rows give the same `PlaceTable`, whatever their order.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import NamedTuple

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import (
    Interval,
    jointly_solved,
    problem_key,
)
from paper_tables.comparison import (
    PROJECTION_COST,
    RATIOS,
    REFERENCE,
    STATE_CHECK_COST,
    Statistic,
    Value,
    censored,
    mean,
    paired_ratio,
    paper_cost,
    share,
    split_by_work,
    split_metric,
    typical,
    values_of,
)
from paper_tables.paper_numbers import PublishedValue, notes_on
from paper_tables.summary import (
    Metric,
    PlannerSummary,
    Runs,
    by_planner,
    rows_of_one_suite,
    seed_notes,
    summarised,
)

BASELINE = "ompl-projected"
CURVE_TIMES = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
COST_RATIO_BASELINES = (REFERENCE, BASELINE)


def _over_all(statistic: Statistic, value: Value) -> Callable[[Runs], Interval]:
    """Over all runs, failures as infinite."""
    return lambda runs: statistic(censored(runs.rows, value))


def _over_solved(statistic: Statistic, value: Value, joint: bool = False) -> Callable[[Runs], Interval]:
    """Over solved runs, or those that every planner solved."""

    def measure(runs: Runs) -> Interval:
        rows = [row for row in runs.rows if row.solved and (not joint or problem_key(row) in runs.joint)]
        return statistic(values_of(rows, value))

    return measure


def _share(counted: Callable[[ResultRow], bool]) -> Callable[[Runs], Interval]:
    """Percentage of all runs."""
    return lambda runs: share(runs.rows, counted)


def _ratio(value: Value, baseline: str, part: str | None = None) -> Callable[[Runs], Interval]:
    """Against a baseline, on a part of the split or everywhere."""

    def measure(runs: Runs) -> Interval:
        counted = None if part is None else runs.split.parts[part]
        return paired_ratio(
            runs.rows,
            runs.baselines.get(baseline, ()),
            value,
            None if counted is None else lambda row: problem_key(row) in counted,
        )

    return measure


def _within(time: float, row: ResultRow) -> bool:
    return row.solved and row.t_total_s is not None and row.t_total_s <= time


def curve_metric(time: float) -> str:
    """Name of the metric "solved within `time` [s]"."""
    return f"solved_within_{time:g}_s"


_time, _length, _raw = (
    attrgetter("t_total_s"),
    attrgetter("path_length_rad"),
    attrgetter("path_length_raw_rad"),
)
_vertices = attrgetter("vertices")

METRICS: Mapping[str, Metric] = {
    "accuracy": Metric("Accuracy", "%", _share(attrgetter("solved")), "accuracy"),
    "time_median": Metric("Time", "s", _over_all(typical, _time)),
    "time_mean": Metric("Time", "s", _over_all(mean, _time), "time"),
    "vertices_median": Metric("Vertices", "1", _over_solved(typical, _vertices)),
    "vertices_mean": Metric("Vertices", "1", _over_solved(mean, _vertices), "vertices"),
    "path_length_median": Metric("Path length", "rad", _over_solved(typical, _length, joint=True)),
    "path_length_mean": Metric("Path length", "rad", _over_solved(mean, _length, joint=True), "path_length"),
    "path_length_raw_median": Metric("raw length [rad]", "rad", _over_solved(typical, _raw, joint=True)),
    "projections_median": Metric("projections", "1", _over_all(typical, attrgetter("n_projections"))),
    "newton_iterations_median": Metric(
        "Newton iterations", "1", _over_all(typical, attrgetter("n_newton_iterations"))
    ),
    "state_checks_median": Metric("state checks", "1", _over_all(typical, attrgetter("n_state_checks"))),
    "time_ratio": Metric(f"time / {BASELINE}", "1", _ratio(_time, BASELINE)),
    "fallbacks": Metric("by fallback [%]", "%", _share(lambda row: row.fallback is not None)),
    "paper_cost_median": Metric("time at the paper's cost [s]", "s", _over_all(typical, paper_cost)),
    **{
        f"paper_cost_ratio_{name}": Metric(f"the same / {name}", "1", _ratio(paper_cost, name))
        for name in COST_RATIO_BASELINES
    },
    **{
        split_metric(name, part): Metric(label, "1", _ratio(value, REFERENCE, part))
        for name, (label, value) in RATIOS.items()
        for part in ("all", "easy", "hard")
    },
    **{
        curve_metric(time): Metric(f"{time:g} s", "%", _share(partial(_within, time))) for time in CURVE_TIMES
    },
}


class Headline(NamedTuple):
    """A row of the paper's table: its metric there, and ours that answer it."""

    published: str
    typical: str
    mean: str | None = None


HEADLINES = (
    Headline("accuracy", "accuracy"),
    Headline("time", "time_median", "time_mean"),
    Headline("vertices", "vertices_median", "vertices_mean"),
    Headline("path_length", "path_length_median", "path_length_mean"),
)
EFFORT = (
    *("path_length_raw_median", "projections_median", "newton_iterations_median", "state_checks_median"),
    *("time_ratio", "fallbacks"),
)
PAPER_COST = ("paper_cost_median", *(f"paper_cost_ratio_{name}" for name in COST_RATIO_BASELINES))
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
    "By fallback: runs whose path did not come the way the planner's name promises; they count as its own.",
    f"At the paper's cost: {1e3 * STATE_CHECK_COST:g} ms a state check (PyBullet, itself and obstacles), "
    f"{1e3 * PROJECTION_COST:g} ms a projection (Newton's method in Python; a lower bound), networks as measured "
    "here, goals and simplification left out. Median with failures as infinite; ratios as above.",
    "Easy and hard: hard are runs of problems in the top third by the work (projections + state checks) of "
    f"{REFERENCE} with uniform samples, median over its other seeds. Ratios are geometric means over problems "
    "that both solved, bootstrap intervals; time includes goal inverse kinematics, which is the same for all.",
)


@dataclass(frozen=True)
class PlaceTable:
    """Everything a rendering needs, for one suite."""

    suite: str
    n_problems: int
    n_joint: int
    """Runs that every planner solved."""
    curve_times: tuple[float, ...]
    """Up to the slowest run [s]."""
    planners: tuple[PlannerSummary, ...]
    footnotes: tuple[str, ...]
    published_notes: tuple[str, ...]
    n_easy: int
    """Runs by the work of `comparison.REFERENCE`; 0 where that was not run."""
    n_hard: int


def build_place_table(
    rows: Iterable[ResultRow],
    published: Sequence[PublishedValue],
    metrics: Mapping[str, Metric] = METRICS,
) -> PlaceTable:
    """Summarise the rows of one suite beside the paper's numbers.

    Planners come in the paper's order, then any others by name; those that were not run are left out. A
    planner with rows of several backends becomes one entry for each.

    Raises
    ------
    InvalidInputError
        Without rows, or with rows of more than one suite.
    """
    rows = rows_of_one_suite(rows)
    groups = by_planner(rows, published)
    solving = sorted(name for name, group in groups.items() if any(row.solved for row in group))
    joint = jointly_solved({name: groups[name] for name in solving})
    baselines = {
        name: next((group for group in groups.values() if group[0].planner == name), [])
        for name in COST_RATIO_BASELINES
    }
    split = split_by_work(baselines[REFERENCE])
    slowest = max(row.t_total_s or 0.0 for row in rows)
    shown = [value for value in published if value.planner in {row.planner for row in rows}]
    return PlaceTable(
        suite=rows[0].suite,
        n_problems=len({row.problem for row in rows}),
        n_joint=len(joint),
        curve_times=CURVE_TIMES[: sum(time < slowest for time in CURVE_TIMES) + 1],
        planners=tuple(
            summarised(name, Runs(group, frozenset(joint), baselines, split), published, metrics)
            for name, group in groups.items()
        ),
        footnotes=tuple(_footnotes(groups, solving, len(joint))),
        published_notes=tuple(notes_on(shown)),
        n_easy=len(split.easy),
        n_hard=len(split.hard),
    )


def _footnotes(
    groups: Mapping[str, Sequence[ResultRow]], solving: Collection[str], n_joint: int
) -> Iterable[str]:
    names = ", ".join(solving) or "no planner"
    yield f"Jointly solved: {n_joint} runs (problem and seed), each solved by all of {names}."
    silent = sorted(name for name in groups if name not in solving)
    if silent:
        yield f"Solved nothing, so left out of the jointly solved set: {', '.join(silent)}."
    if len({frozenset(row.problem for row in group) for group in groups.values()}) > 1:
        yield "The planners did not all run the same problems: their columns do not compare."
    yield from seed_notes(groups)
    if len({row.seed for group in groups.values() for row in group if row.planner == REFERENCE}) == 1:
        yield (
            f"One seed of {REFERENCE}: a problem on which it was unlucky counts as hard, so every other planner's "
            "ratios look better on hard problems, and worse on easy ones, than several seeds would show."
        )
