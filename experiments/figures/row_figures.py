"""Figure of the rows of a folder: times and ratios against the cost of a state check."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, read_rows
from cvqmpt_lab.results.statistics import Interval
from experiments.figures.drawing import Panel, panels_figure, save_figure, write_csv
from paper_tables.measures import (
    REFERENCE,
    STATE_CHECK_COST,
    censored,
    own_time,
    paired_ratio,
    problem_median,
    work,
)
from paper_tables.table_engine import by_planner, rows_of_one_suite

OURS = 1e-6  # [s] a free state of the kitchen, kinematics included (docs/performance.md)
# of a state check [s]
COSTS = tuple(float(cost) for cost in np.geomspace(OURS, STATE_CHECK_COST, 29))


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
