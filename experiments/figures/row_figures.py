"""Figures of rows and of trainings: times against the cost of a state check; learning curves."""

import csv
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_bytes, read_json_object
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, read_rows
from cvqmpt_lab.results.statistics import Interval
from experiments.figures.drawing import label_log_axis, legend_below, save_figure, write_csv
from paper_tables.measures import (
    REFERENCE,
    STATE_CHECK_COST,
    censored,
    mean_ratio,
    own_time,
    paired,
    problem_median,
    work,
)
from paper_tables.plots import line_style
from paper_tables.table_engine import by_planner, rows_of_one_suite

OURS = 1e-6  # [s] a free state of the kitchen, kinematics included (docs/performance.md)
# of a state check [s]
COSTS = tuple(float(cost) for cost in np.geomspace(OURS, STATE_CHECK_COST, 29))
# start of its column's name, dash and words of the cloud that a model saw
CLOUDS = {
    "own": ("", "-", "own cloud"),
    "wrong": ("wrong_cloud_", "--", "another scene's"),
    "none": ("no_cloud_", ":", "no cloud"),
}
MEASURES = {"ways": "over the ways on", "all": "over all codes"}
COLOURS = {
    "transformer": ("#1f6fb4", "#7fb0dc", "#3aa3a0"),
    "published": ("#d1662a", "#8c6d1f", "#b8336a"),
}


def draw_cost(folder: Path, out: Path) -> list[Path]:
    """Times and ratios over a state check's cost; RunStoreError, InvalidInputError: unusable."""
    groups = by_planner(rows_of_one_suite(read_rows(folder / RUNS_FILE)), ())
    reference = groups.get(REFERENCE, [])
    values = [partial(time_at, cost) for cost in COSTS]
    times, ratios, lines = {}, {}, []
    for name, rows in groups.items():
        times[name] = [problem_median(censored(rows, value)) for value in values]
        if name == REFERENCE:
            continue
        ratios[name] = [mean_ratio(paired(rows, reference, value)) for value in values]
        even = break_even(ratios[name])
        cells: dict[str, object] = {"planner": name, "break_even_us": even and 1e6 * even}
        shown = mean_ratio(paired(rows, reference, work)), ratios[name][0], ratios[name][-1]
        for what, interval in zip(("work", "time_at_ours", "time_at_papers"), shown, strict=True):
            cells[what] = interval.estimate
            cells |= {f"{what}_low": interval.low, f"{what}_high": interval.high}
        cells["median_s_at_ours"] = times[name][0].estimate
        cells["median_s_at_papers"] = times[name][-1].estimate
        lines.append(cells)
    return [
        *save_figure(cost_figure(times, ratios), out, "cost"),
        write_csv(out / "cost.csv", lines),
    ]


def cost_figure(
    times: Mapping[str, Sequence[Interval]], ratios: Mapping[str, Sequence[Interval]]
) -> Figure:
    """Panels of times and ratios; a line and band for each planner, gaps where unknown."""
    figure = Figure(figsize=(9.6, 4.1), layout="constrained")
    panels = {
        "median time without goals": ("time [s]", times),
        f"time / {REFERENCE}, geometric mean": ("ratio", ratios),
    }
    for axes, (title, (label, lines)) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        for name, line in lines.items():
            style = line_style(name)
            known = [
                (1e6 * x, i) for x, i in zip(COSTS, line, strict=True) if i.estimate is not None
            ]
            x, y = [at for at, _ in known], [i.estimate for _, i in known]
            axes.plot(x, y, label=name, **style)
            low = [i.low for _, i in known if i.low is not None]
            high = [i.high for _, i in known if i.high is not None]
            if len(low) == len(high) == len(x):
                axes.fill_between(x, low, high, color=style["color"], alpha=0.09, linewidth=0.0)
        if lines is ratios:
            axes.axhline(1.0, linestyle=":", color="0.55", linewidth=1.0)
        axes.set(title=title, xlabel="cost of a state check [µs]", ylabel=label)
        axes.set(xscale="log", yscale="log")
        label_log_axis(axes.xaxis, (1.0,))
        label_log_axis(axes.yaxis)
        axes.grid(visible=True, which="major", color="0.92", linewidth=0.6)
        axes.set_axisbelow(True)
    legend_below(figure, min(len(times), 4))
    return figure


def time_at(cost: float, row: ResultRow) -> float | None:
    """Time t + n (cost - OURS) [s]: measured t without goals, had n state checks cost so much."""
    own = own_time(row)
    if own is None or row.n_state_checks is None:
        return None
    return own + row.n_state_checks * (cost - OURS)


def break_even(ratios: Sequence[Interval]) -> float | None:
    """The least cost [s] (interpolated) above which a method needs less time than `birrt`."""
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


def draw_training(folder: Path, out: Path) -> list[Path]:
    """Draw the trainings in a folder (`*/curves.csv`), or its training.csv, and write that table.

    A model that sees the scene is better with its own cloud than with another scene's or none; a
    blind one is not. InvalidInputError: there is neither.
    """
    found = [row for path in sorted(folder.glob("*/curves.csv")) for row in _curve(path)]
    table = folder / "training.csv"
    if not found and table.is_file():
        found = list(csv.DictReader(read_bytes(table).decode().splitlines()))
    if not found:
        raise InvalidInputError(
            f"{folder} has no curves of cvqmpt train transformer or published; name the folder "
            "above those of --out"
        )
    return [
        *save_figure(training_figure(found), out, "training"),
        write_csv(out / table.name, found),
    ]


def _curve(path: Path) -> list[Mapping[str, object]]:
    """Rows of one training; none of one that learns no sequences from labels."""
    settings = read_json_object(path.parent / "training.json")
    stage = settings["stage"]
    if stage not in COLOURS:
        return []
    batch = settings["profile"][stage]["scenes"] * settings["profile"][stage]["paths"]
    lines = csv.DictReader(read_bytes(path).decode().splitlines())
    # sequences of encoded paths follow no roadmap
    if "validation_cross_entropy_ways" not in (lines.fieldnames or ()):
        return []
    return [
        {
            "training": path.parent.name,
            "stage": stage,
            "sequences": int(line["step"]) * batch,
            "seconds": float(line["seconds"]),
            **{
                f"{cloud}_{which}": float(line[f"validation_{prefix}cross_entropy_{which}"])
                for cloud, (prefix, _, _) in CLOUDS.items()
                for which in MEASURES
            },
        }
        for line in lines
    ]


def training_figure(rows: Sequence[Mapping[str, object]]) -> Figure:
    """A panel for each cross entropy; a colour for each training, a dash for each cloud."""
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    names = list(dict.fromkeys(str(row["training"]) for row in rows))
    for axes, (which, words) in zip(figure.subplots(1, 2), MEASURES.items(), strict=True):
        turns = dict.fromkeys(COLOURS, 0)
        for name in names:
            own = [row for row in rows if row["training"] == name]
            stage = str(own[0]["stage"])
            colour = COLOURS[stage][turns[stage] % len(COLOURS[stage])]
            turns[stage] += 1
            x = [1e-6 * float(str(row["sequences"])) for row in own]
            for cloud, (_, dash, seen) in CLOUDS.items():
                y = [float(str(row[f"{cloud}_{which}"])) for row in own]
                axes.plot(x, y, dash, color=colour, marker=".", label=f"{name}, {seen}")
        axes.set(
            title=f"cross entropy {words}", xlabel="sequences seen [million]", ylabel="nats a code"
        )
        axes.set_ylim(bottom=0.0)
        axes.grid(visible=True, color="0.92", linewidth=0.6)
    legend_below(figure, min(len(names), 3))
    return figure
