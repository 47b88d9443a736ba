"""Figures of the rows of a folder:
against the cost of a state check, against difficulty, and of robustness.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, natural_key, read_rows
from cvqmpt_lab.results.statistics import Interval
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.query import Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from experiments.figures.drawing import Panel, panels_figure, save_figure, write_csv
from experiments.suites.suite import suite_named
from paper_tables.measures import (
    RATIOS,
    REFERENCE,
    STATE_CHECK_COST,
    censored,
    fraction,
    own_time,
    paired_ratio,
    problem_median,
    solved,
    work,
)
from paper_tables.planner_styles import line_style
from paper_tables.robustness_table import DEFAULT, TITLES, levels_of
from paper_tables.table_engine import Entry, by_planner, rows_of_one_suite

OURS = 1e-6  # [s] a free state of the kitchen, kinematics included (`cvqmpt bench collision`)
# of a state check [s]
COSTS = tuple(float(cost) for cost in np.geomspace(OURS, STATE_CHECK_COST, 29))
# of the uniform searches that say how hard a problem is; tables use small ones
SEEDS = range(100, 105)
ENOUGH = Budget(iterations=20_000)
BINS = 5
COMPARED = ("work_ratio", "own_time_ratio", "length_ratio")
SHIFT = 0.12  # [levels] between planners' marks at a level


def draw_cost(folder: Path, out: Path) -> list[Path]:
    """Times and ratios against the cost of a state check;
    RunStoreError or InvalidInputError for unusable rows.
    """
    groups = by_planner(rows_of_one_suite(read_rows(folder / RUNS_FILE)), ())
    reference = groups.get(REFERENCE, [])
    times = {
        name: [problem_median(censored(rows, partial(time_at, cost))) for cost in COSTS]
        for name, rows in groups.items()
    }
    ratios = {
        name: [paired_ratio(rows, reference, partial(time_at, cost)) for cost in COSTS]
        for name, rows in groups.items()
        if name != REFERENCE
    }
    microseconds, label = [1e6 * cost for cost in COSTS], "cost of a state check [µs]"
    figure = panels_figure(
        [
            Panel("median time without goals", label, "time [s]", microseconds, times),
            Panel(
                f"time / {REFERENCE}, geometric mean",
                label,
                "ratio",
                microseconds,
                ratios,
                level=1.0,
            ),
        ]
    )
    lines = []
    for name, values in ratios.items():
        even = break_even(values)
        cells: dict[str, object] = {
            "planner": name,
            "break_even_us": "" if even is None else 1e6 * even,
        }
        own_work = paired_ratio(groups[name], reference, work)
        for what, (middle, low, high, *_) in {
            "work": own_work,
            "time_at_ours": values[0],
            "time_at_papers": values[-1],
        }.items():
            cells |= {what: middle, f"{what}_low": low, f"{what}_high": high}
        first, *_, last = times[name]
        lines.append(
            cells | {"median_s_at_ours": first.estimate, "median_s_at_papers": last.estimate}
        )
    return [*save_figure(figure, out, "cost"), write_csv(out / "cost.csv", lines)]


def time_at(cost: float, row: ResultRow) -> float | None:
    """Time without goals if the search's state checks had cost so much [s];
    everything else is as it was measured.
    """
    own = own_time(row)
    return (
        None
        if own is None or row.n_state_checks is None
        else own + row.n_state_checks * (cost - OURS)
    )


def break_even(ratios: Sequence[Interval]) -> float | None:
    """The least of `COSTS` [s], interpolated, from which on a method needs less time than uniform
    samples, if any.
    """
    estimates = [ratio.estimate for ratio in ratios if ratio.estimate is not None]
    if not estimates or len(estimates) < len(ratios) or estimates[-1] >= 1.0:
        return None
    logs = np.log(estimates)
    slower = np.flatnonzero(logs >= 0.0)
    if not len(slower):
        return COSTS[0]
    last = int(slower[-1])
    share = logs[last] / (logs[last] - logs[last + 1])
    return float(COSTS[last] * (COSTS[last + 1] / COSTS[last]) ** share)


def draw_difficulty(folder: Path, out: Path) -> list[Path]:
    """Search with other seeds, then draw ratios and success by how hard problems are;
    errors as of `read_rows`.
    """
    rows = rows_of_one_suite(read_rows(folder / RUNS_FILE))
    suite = suite_named(rows[0].suite)
    named = {
        row.problem: suite.solvable(int(row.item))
        for row in rows
        if row.planner == REFERENCE and row.solved
    }
    hard = {
        name: difficulty(item) for name, item in named.items() if isinstance(item, PlanningProblem)
    }
    groups, parts = by_planner(rows, ()), bins_of(hard)
    centres = [float(median(hard[name] for name in part)) for part in parts]
    by_part = {
        name: [[row for row in group if row.problem in part] for part in parts]
        for name, group in groups.items()
    }
    found: dict[str, dict[str, list[Interval]]] = {
        what: {
            name: [
                paired_ratio(chosen, groups[REFERENCE], RATIOS[what][1]) for chosen in by_part[name]
            ]
            for name in groups
            if name != REFERENCE
        }
        for what in COMPARED
    }
    label = f"median work of {REFERENCE} with other seeds"
    panels = [
        Panel(
            f"{RATIOS[what][0]} / {REFERENCE}",
            label,
            "ratio",
            centres,
            lines,
            log=(True, what != "length_ratio"),
            level=1.0,
        )
        for what, lines in found.items()
    ]
    found["solved"] = {
        name: [fraction(chosen, solved).scaled(100) for chosen in by_part[name]] for name in groups
    }
    # no bands: many lie upon each other at 100 %
    panels.append(
        Panel("solved [%]", label, "%", centres, found["solved"], log=(True, False), bands=False)
    )
    lines = [
        {
            "measure": what,
            "planner": name,
            "bin": k + 1,
            "problems": len(parts[k]),
            "work_of_birrt": centres[k],
            "value": interval.estimate,
            "low": interval.low,
            "high": interval.high,
            "n": interval.n,
        }
        for what, by_name in found.items()
        for name, values in by_name.items()
        for k, interval in enumerate(values)
    ]
    table = write_csv(out / "difficulty.csv", lines)
    return [*save_figure(panels_figure(panels), out, "difficulty"), table]


def difficulty(problem: PlanningProblem) -> float:
    """Median work of uniform `birrt` over `SEEDS`; infinite where most fail."""
    problem = with_sampled_goals(problem)[0]
    space, uniform = ConstrainedSpace(problem), Uniform(problem.robot.lower, problem.robot.upper)
    efforts = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        plan = BiRRT().search(space, problem.start, problem.goals, uniform, ENOUGH, rng)
        efforts.append(
            plan.counters.projections + plan.counters.state_checks if plan.path else math.inf
        )
    return float(median(efforts))


def bins_of(difficulties: Mapping[str, float], bins: int = BINS) -> list[list[str]]:
    """Names of problems from easy to hard in groups of nearly equal size; ties go by name."""
    ordered = sorted(difficulties, key=lambda name: (difficulties[name], natural_key(name)))
    return [
        list(part)
        for part in np.array_split(np.array(ordered, dtype=object), min(bins, len(ordered)))
    ]


def draw_robustness(folder: Path, out: Path) -> list[Path]:
    """Draw the rows of a folder into another;
    RunStoreError or InvalidInputError when they cannot be read.
    """
    levels = levels_of(read_rows(folder / RUNS_FILE))
    return save_figure(robustness_figure(levels), out, "robustness")


def robustness_figure(levels: Sequence[Entry]) -> Figure:
    """A column for each thing that is varied:
    solved above, free in truth in the middle, length below.
    """
    factors = tuple(dict.fromkeys(level.group[0] for level in levels))
    figure = Figure(figsize=(3.2 * len(factors), 7.2), layout="constrained")
    rows = figure.subplots(3, len(factors), squeeze=False, sharex="col", sharey="row")
    for column, factor in enumerate(factors):
        chosen = [level for level in levels if level.group[0] == factor]
        for axes, what in zip(rows[:, column], ("solved", "true_free", "length"), strict=True):
            _draw_level(axes, chosen, what)
        rows[-1, column].set_xlabel(TITLES.get(factor, factor), fontsize="small", wrap=True)
    for axes, label in zip(
        rows[:, 0], ("solved [%]", "free in truth [%]", "length [rad]"), strict=True
    ):
        axes.set_ylabel(label)
    rows[0, 0].legend(frameon=False, fontsize="x-small", loc="lower left")
    return figure


def _draw_level(axes: Axes, levels: Sequence[Entry], what: str) -> None:
    """A line of marks with intervals for each planner; the default value is dotted."""
    values = list(dict.fromkeys(level.group[1] for level in levels))
    planners = list(dict.fromkeys(level.planner for level in levels))
    for k, planner in enumerate(planners):
        found = [
            (values.index(level.group[1]), level.measured[what])
            for level in levels
            if level.planner == planner
        ]
        known = [(x, i.estimate, i.low, i.high) for x, i in found if i.estimate is not None]
        if not known:
            continue
        shift = SHIFT * (k - 0.5 * (len(planners) - 1))
        x, y, low, high = (list(column) for column in zip(*known, strict=True))
        below = [
            at - (bound if bound is not None else at) for at, bound in zip(y, low, strict=True)
        ]
        above = [
            (bound if bound is not None else at) - at for at, bound in zip(y, high, strict=True)
        ]
        places = [at + shift for at in x]
        look = {"marker": ".", "elinewidth": 0.7, "capsize": 2.0, **line_style(planner)}
        axes.errorbar(places, y, (below, above), label=planner, **look)
    default = next(k for k, value in enumerate(values) if value.endswith(DEFAULT))
    axes.axvline(default, linestyle=":", color="0.6")
    axes.set_xticks(range(len(values)), [value.removesuffix(DEFAULT) for value in values])
