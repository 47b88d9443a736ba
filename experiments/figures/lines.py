"""Panels of lines with bands, one colour a planner in all of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from cvqmpt_lab.results.statistics import Interval

COLOURS = ("#1f6fb4", "#d1662a", "#2e8b57", "#8a4fa3", "#b8336a", "#8c6d1f", "#3aa6a6", "#70757d")
DASHES = ("-", "--", ":")
FEW = 12  # points, each of which is marked
LONG = 2.2  # powers of ten: a longer x axis is labelled at these alone
REFERENCE_COLOUR = "0.55"


@dataclass(frozen=True)
class Line:
    """A planner's numbers."""

    name: str
    x: Sequence[float]
    y: Sequence[Interval]
    """Where an estimate is None or infinite, the line is broken."""


@dataclass(frozen=True)
class Panel:
    """A pair of axes."""

    title: str
    x: str
    """Label, with unit."""
    y: str
    lines: Sequence[Line]
    log: tuple[bool, bool] = (True, True)
    """Whether x and y are logarithmic."""
    level: float | None = None
    """Height of a dotted line, such as 1 for ratios."""
    bands: bool = True
    """Show intervals, where there are any."""


def panels_figure(panels: Sequence[Panel], columns: int = 2, *, legend: bool = True) -> Figure:
    """The panels row by row, with one legend below."""
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.8 * columns, 3.6 * rows + 0.5), layout="constrained")
    axes_of = figure.subplots(rows, columns, squeeze=False).ravel()
    names = list(dict.fromkeys(line.name for panel in panels for line in panel.lines))
    for axes, panel in zip(axes_of, panels, strict=False):
        _draw(axes, panel, names)
    for axes in axes_of[len(panels) :]:
        axes.axis("off")
    if not legend:
        return figure
    handles = {
        label: handle
        for axes in axes_of
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        [handles[name] for name in names],
        names,
        loc="outside lower center",
        ncols=min(len(names), 4),
        frameon=False,
        fontsize="small",
    )
    return figure


def _draw(axes: Axes, panel: Panel, names: Sequence[str]) -> None:
    for line in panel.lines:
        turn, colour = divmod(names.index(line.name), len(COLOURS))
        shade, dash = COLOURS[colour], DASHES[turn % len(DASHES)]
        known = [(x, i.estimate) for x, i in zip(line.x, line.y, strict=True) if i.estimate is not None]
        x, y = [at for at, _ in known], [value for _, value in known]
        marker = "." if len(x) < FEW else ""
        axes.plot(x, y, marker=marker, label=line.name, color=shade, linestyle=dash)
        low = [i.low for i in line.y if i.estimate is not None and i.low is not None]
        high = [i.high for i in line.y if i.estimate is not None and i.high is not None]
        if panel.bands and len(low) == len(high) == len(x):
            axes.fill_between(x, low, high, color=shade, alpha=0.09, linewidth=0.0)
    if panel.level is not None:
        axes.axhline(panel.level, linestyle=":", color=REFERENCE_COLOUR, linewidth=1.0)
    axes.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
    for axis, scale, longest, log in (
        (axes.xaxis, axes.set_xscale, LONG, panel.log[0]),
        (axes.yaxis, axes.set_yscale, math.inf, panel.log[1]),
    ):
        if log:
            scale("log")
            first, last = axis.get_view_interval()
            at = (1.0,) if math.log10(last / first) > longest else (1.0, 2.0, 5.0)
            axis.set_major_locator(LogLocator(subs=at, numticks=12))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="major", color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
