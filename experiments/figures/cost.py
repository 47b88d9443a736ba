"""What methods are worth at the price of a state check: from ours to the paper's, and where each breaks even."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, read_rows
from cvqmpt_lab.results.statistics import Interval
from experiments.figures.drawing import save_figure
from experiments.figures.histogram import write_csv
from experiments.figures.lines import Line, Panel, panels_figure
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

OURS = 1e-6
"""A free state of the kitchen, kinematics included (`cvqmpt bench collision`) [s]."""
PRICES = tuple(float(price) for price in np.geomspace(OURS, STATE_CHECK_COST, 29))
"""Of a state check [s]."""


def time_at(price: float, row: ResultRow) -> float | None:
    """Time without goals if the search's state checks had cost so much [s]; everything else is as it was measured."""
    own = own_time(row)
    return None if own is None or row.n_state_checks is None else own + row.n_state_checks * (price - OURS)


def break_even(ratios: Sequence[Interval]) -> float | None:
    """The least of `PRICES` [s], interpolated, from which on a method needs less time than uniform samples."""
    estimates = [ratio.estimate for ratio in ratios if ratio.estimate is not None]
    if not estimates or len(estimates) < len(ratios) or estimates[-1] >= 1.0:
        return None
    logs = np.log(estimates)
    dearer = np.flatnonzero(logs >= 0.0)
    if not len(dearer):
        return PRICES[0]
    last = int(dearer[-1])
    share = logs[last] / (logs[last] - logs[last + 1])
    return float(PRICES[last] * (PRICES[last + 1] / PRICES[last]) ** share)


def draw_cost(folder: Path) -> list[Path]:
    """Draw the rows of a folder, beside them; RunStoreError or InvalidInputError when they cannot be read."""
    groups = by_planner(rows_of_one_suite(read_rows(folder / RUNS_FILE)), ())
    reference = groups.get(REFERENCE, [])
    ratios = {
        name: [paired_ratio(rows, reference, partial(time_at, price)) for price in PRICES]
        for name, rows in groups.items()
        if name != REFERENCE
    }
    times = {
        name: [problem_median(censored(rows, partial(time_at, price))) for price in PRICES]
        for name, rows in groups.items()
    }
    microseconds = [1e6 * price for price in PRICES]
    label = "cost of a state check [µs]"
    figure = panels_figure(
        [
            Panel(
                "median time without goals",
                label,
                "time [s]",
                [Line(name, microseconds, values) for name, values in times.items()],
            ),
            Panel(
                f"time / {REFERENCE}, geometric mean",
                label,
                "ratio",
                [Line(name, microseconds, values) for name, values in ratios.items()],
                level=1.0,
            ),
        ]
    )
    lines = [_cells(name, groups[name], reference, values, times[name]) for name, values in ratios.items()]
    return [*save_figure(figure, folder, "cost"), write_csv(folder / "cost.csv", lines)]


def _cells(
    name: str,
    rows: Sequence[ResultRow],
    reference: Sequence[ResultRow],
    ratios: Sequence[Interval],
    times: Sequence[Interval],
) -> dict[str, object]:
    """A method's line of the table; no break-even is empty, one at our price means at any."""
    cells: dict[str, object] = {"planner": name, "break_even_us": ""}
    price = break_even(ratios)
    if price is not None:
        cells["break_even_us"] = 1e6 * price
    compared = {
        "work": paired_ratio(rows, reference, work),
        "time_at_ours": ratios[0],
        "time_at_papers": ratios[-1],
    }
    for what, interval in compared.items():
        cells |= {what: interval.estimate, f"{what}_low": interval.low, f"{what}_high": interval.high}
    return cells | {"median_s_at_ours": times[0].estimate, "median_s_at_papers": times[-1].estimate}
