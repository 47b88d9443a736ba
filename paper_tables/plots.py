"""Plots of rows and verdicts, by matplotlib without a display; how figures draw a planner."""

import io
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any
from zlib import crc32

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from cvqmpt_lab.benchmarks.results.row import ResultRow
from cvqmpt_lab.benchmarks.results.statistics import (
    CONFIDENCE,
    Interval,
    ProblemKey,
    problem_key,
)
from cvqmpt_lab.paper_tables.claims import JudgedClaim
from cvqmpt_lab.paper_tables.measures import (
    PUBLISHED_PRICES,
    REFERENCE,
    VALUES,
    mean_ratio,
    paired,
    time_at,
)
from cvqmpt_lab.paper_tables.ompl_table import PAPER_CUTOFF_S, capped
from cvqmpt_lab.paper_tables.rule import Word
from cvqmpt_lab.paper_tables.statements import CBIRRT, CVQ, OPT, UNIFORM
from cvqmpt_lab.paper_tables.within import MARGIN, curve_half_band, gain_band
from cvqmpt_lab.planning.by_name import declared
from cvqmpt_lab.vqmpt.sampler_choice import PREFIX

Groups = Mapping[str, Sequence[ResultRow]]  # rows by planner
STYLE: Any = {
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Helvetica", "Arial"],
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
WORD_COLOURS = {
    Word.REPLICATED: "#1a7f37",
    Word.SMALLER: "#7cae3c",
    Word.SAME: "#70757d",
    Word.OPPOSITE: "#b42318",
    Word.OPEN: "#c98a1b",
    Word.STATISTIC: "#7a5195",
    Word.HARDWARE: "#2f6f9f",
}
OURS = "roadmap"  # drawn with a thick line
WIDTH = 7.6  # [inches]
LEGEND_LINE = 0.18  # [inches] of height a planner in a legend


def line_style(name: str) -> dict[str, Any]:
    """Arguments of matplotlib's `plot` for a planner, or for a variant of it: "birrt improved".

    Variants have the planner's colour and dashes, products of a learned sampler have dots, and
    planners of users are thick. Colours that are not declared follow from the name.
    """
    planner, *variant = name.split()
    known = declared().get(planner)
    colour = known.colour if known and known.colour else _colour(planner)
    if is_own(name):
        return {"color": colour, "linestyle": "-", "linewidth": 3.2}
    dash = ":" if known is None else "--" if variant else "-"
    return {"color": colour, "linestyle": dash, "linewidth": 2.6 if planner == OURS else 1.4}


def is_own(name: str) -> bool:
    """Return whether a planner is a user's: the toolkit does not have it."""
    planner = name.split()[0]
    known = declared() | declared("control", "unshipped")
    return planner not in known and not planner.startswith(PREFIX)


def _colour(name: str) -> str:
    """Return a colour of medium lightness, whose hue is the checksum of a name."""
    hue: Any = hsv_to_rgb((crc32(name.encode()) % 997 / 997, 0.6, 0.7))
    return to_hex(hue)


def figure_bytes(figure: Figure, kind: str, dpi: int = 160) -> bytes:
    """A figure as the content of a file: "png", "svg" or "pdf". Equal figures give equal bytes."""
    buffer = io.BytesIO()
    # without metadata and hashsalt a file would contain the date and random identifiers
    dated = {"svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None}}
    metadata = dated.get(kind)
    with matplotlib.rc_context({"svg.hashsalt": "cvqmpt"}):
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata)
    return buffer.getvalue()


@matplotlib.rc_context(STYLE)
def profile(groups: Groups, kind: str) -> Figure:
    """Return a performance profile; planners that the toolkit does not have are thick.

    Args:
        groups: rows by planner.
        kind: "solved": share of runs that are solved within a time. "work" or "length": share of
            runs that are solved with at most a factor times the smallest value of all planners.
    """
    value = {"solved": VALUES["time"], "work": VALUES["work"], "length": VALUES["path_length"]}[
        kind
    ]
    known = {
        name: {problem_key(row): x for row in rows if row.solved and (x := value(row))}
        for name, rows in groups.items()
    }
    best: dict[ProblemKey, float] = {}
    for values in known.values() if kind != "solved" else ():
        best |= {key: min(x, best.get(key, x)) for key, x in values.items()}
    figure, axes = _axes(max(3.4, LEGEND_LINE * len(groups)))
    for place, (name, values) in enumerate(known.items()):
        if not values:
            continue
        factors = sorted(x / best.get(key, 1.0) for key, x in values.items())
        shares = 100.0 * np.arange(1, len(factors) + 1) / len(groups[name])
        style = line_style(name)
        if is_own(name):
            style["color"] = matplotlib.colormaps["tab10"](place % 10)
        axes.step(factors, shares, where="post", label=name, **style)
    label = f"{kind} / smallest {kind} of all planners"
    _finish(axes, "time, everything counted [s]" if kind == "solved" else label, "solved [%]")
    axes.set_ylim(0.0, 102.0)
    return figure


@matplotlib.rc_context(STYLE)
def forest(claims: Sequence[JudgedClaim], committed: Sequence[JudgedClaim] = ()) -> bytes:
    """Return the first ratio of each claim with its interval and the paper's number, as png.

    committed: the same claims judged by committed rows, whose ratios are added as squares.
    """
    lines = [
        (item.claim.title, first, first.shown)
        for item in claims
        if (first := next(iter(item.comparisons), None)) and first.effect and first.shown
    ]
    known = {
        item.claim.title: item.comparisons[0].shown
        for item in committed
        if item.comparisons and item.comparisons[0].effect
    }
    figure = Figure(figsize=(WIDTH, 1.3 + 0.34 * len(lines)), layout="constrained")
    axes = figure.subplots()
    for place, (title, first, ratio) in enumerate(lines):
        colour = WORD_COLOURS[first.word]
        ends = np.array([ratio.low, ratio.estimate, ratio.high], dtype=float)
        axes.plot(ends[[0, 2]], [place] * 2, color=colour, linewidth=3.0)
        axes.plot(ends[1], place, "o", color=colour)
        if first.paper is not None:
            axes.plot(first.paper, place, "D", color="black", markersize=6, fillstyle="none")
        other = known.get(title)
        if other and other.estimate is not None:
            axes.plot(other.estimate, place, "s", color="black", markersize=5)
    names = [f"{title}\n{x.planner} / {x.baseline}" for title, x, _ in lines]
    axes.set_yticks(range(len(lines)), names, fontsize=8)
    axes.set_ylim(len(lines) - 0.4, -0.6)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.axvspan(0.9, 1.0 / 0.9, color="0.92", zorder=0)
    _finish(axes, "planner / baseline, ratio of means; below 1 is what the paper says", "", False)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    used = dict.fromkeys(first.word for _, first, _ in lines)
    marks = [Line2D([], [], color=WORD_COLOURS[w], marker="o", label=w) for w in used]
    style: Any = {"color": "black", "linestyle": "none"}
    marks.append(Line2D([], [], marker="D", fillstyle="none", label="the paper's number", **style))
    if known:
        marks.append(Line2D([], [], marker="s", label="committed rows", **style))
    figure.legend(handles=marks, loc="outside upper center", ncols=3, frameon=False)
    return figure_bytes(figure, "png", 140)


@matplotlib.rc_context(STYLE)
def curves(groups: Groups, limit: float) -> bytes:
    """Share solved against the paper's time by planner, and CVQ-MPT less CBiRRT, as png.

    Simultaneous bands of 95 %.

    Args:
        groups: rows by planner, those of one suite with one seed.
        limit: the smaller of the limits of CVQ-MPT and CBiRRT [s].
    """
    cost = capped("search_cost")
    times = {
        name: {row.problem: cost(row) if row.solved else np.nan for row in groups[name]}
        for name in (CBIRRT, UNIFORM, CVQ, OPT)
        if name in groups
    }
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for name, known in times.items():
        values = np.array([*known.values()], dtype=float)
        ends = np.append(np.sort(values[np.isfinite(values)]), PAPER_CUTOFF_S)
        shares = np.append(np.arange(1, len(ends)), len(ends) - 1) / len(values)
        half = curve_half_band(len(values), 1.0 - CONFIDENCE)
        style = line_style(name)
        above.step(ends, 100.0 * shares, where="post", label=name, **style)
        band = [100.0 * np.clip(shares + side, 0.0, 1.0) for side in (-half, half)]
        above.fill_between(ends, *band, step="post", color=style["color"], alpha=0.1, linewidth=0)
    both = [name for name in times[CVQ] if name in times[CBIRRT]]
    own, other = (np.array([times[x][name] for name in both], float) for x in (CVQ, CBIRRT))
    at, gains, low, high = gain_band(own, other, limit, 1.0 - CONFIDENCE)
    below.step(at, 100.0 * gains, where="post", color="black", linewidth=1.4)
    below.fill_between(at, 100.0 * low, 100.0 * high, step="post", color="0.8", linewidth=0)
    below.axhline(0.0, color="black", linewidth=0.8)
    below.axhline(-100.0 * MARGIN, color="black", linewidth=0.8, linestyle="--")
    for axes in (above, below):
        axes.axvline(limit, color="0.6", linewidth=0.8)
    above.set_xlim(0.5, PAPER_CUTOFF_S)
    _finish(above, "", "solved [%]")
    _finish(below, "time at the prices of the published code [s]", f"{CVQ} less\n{CBIRRT} [points]")
    return figure_bytes(figure, "png", 140)


@matplotlib.rc_context(STYLE)
def advice(lines: Mapping[str, Interval]) -> bytes:
    """Return the time over that of `birrt` with its interval, one line a use, as png."""
    figure, axes = _axes(0.8 + 0.34 * len(lines))
    colours = {True: WORD_COLOURS[Word.REPLICATED], False: WORD_COLOURS[Word.SAME]}
    for place, ratio in enumerate(lines.values()):
        middle, low, high = ratio[:3]
        colour = colours[high is not None and high < 1.0]
        ends = np.array([low, middle, high], dtype=float)
        axes.plot(ends[[0, 2]], [place] * 2, color=colour, linewidth=3.0)
        axes.plot(ends[1], place, "o", color=colour)
        above: Any = {"textcoords": "offset points", "ha": "center"}
        axes.annotate(f"{middle:.2f}", (middle, place), (0, 5), **above)
    axes.set_yticks(range(len(lines)), list(lines))
    axes.set_ylim(len(lines) - 0.5, -0.8)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xlim(0.0, 1.2)
    _finish(axes, f"time / {REFERENCE}; left of the line is faster", "", legend=False, log=False)
    return figure_bytes(figure, "png", 140)


@matplotlib.rc_context(STYLE)
def cost_curves(groups: Groups) -> bytes:
    """Time over that of `birrt` against the additional cost of a state check, as png.

    Projections and Newton steps cost more in proportion; at the right end the published code's
    prices are added. Clearances cost nothing more: the paper's planners read none.
    """
    figure, axes = _axes(4.2)
    prices = np.geomspace(1e-6, PUBLISHED_PRICES.state_check, 15)
    for name, rows in groups.items():
        found = [
            mean_ratio(paired(rows, groups[REFERENCE], partial(time_at, check=price)))
            for price in prices
        ]
        if all(ratio.low for ratio in found) and name != REFERENCE:
            middle, low, high = zip(*(ratio[:3] for ratio in found), strict=True)
            style = line_style(name)
            axes.plot(1e6 * prices, middle, label=name, **style)
            axes.fill_between(
                1e6 * prices, low, high, color=style["color"], alpha=0.12, linewidth=0
            )
    axes.axhline(1.0, color="black", linewidth=0.8)
    axes.set_yscale("log")
    _finish(
        axes,
        "additional cost of a state check [µs], projections in proportion",
        f"time / {REFERENCE}",
    )
    return figure_bytes(figure, "png", 140)


def _axes(height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots()


def _finish(axes: Axes, x: str, y: str, legend: bool = True, log: bool = True) -> None:
    if log:
        axes.set_xscale("log")
    for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
        if scale == "log":  # powers of ten as plain numbers
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(axis="both" if legend and log else "x", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    if legend and axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
