"""What figures share:
panels of lines with bands, one colour a planner in all of them, pictures and tables in files.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from cvqmpt_lab.files import write_bytes, write_text
from cvqmpt_lab.results.statistics import Interval
from paper_tables.planner_styles import line_style

FORMATS = ("png", "svg")
DPI = 160
FEW = 12  # points, each of which is marked
LONG = 2.2  # powers of ten: a longer x axis is labelled at these alone
REFERENCE_COLOUR = "0.55"


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as png or svg; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "cvqmpt"}):
        figure.savefig(
            buffer, format=kind, dpi=DPI, metadata={"Date": None} if kind == "svg" else None
        )
    return buffer.getvalue()


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write name.png and name.svg, each at once or not at all."""
    paths = [folder / f"{name}.{kind}" for kind in FORMATS]
    for path, kind in zip(paths, FORMATS, strict=True):
        write_bytes(path, figure_bytes(figure, kind))
    return paths


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> Path:
    """Write a table whose rows are cells by column, numbers to 6 digits, at once or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow(
            {name: f"{x:.6g}" if isinstance(x, float) else x for name, x in row.items()}
        )
    write_text(path, text.getvalue())
    return path


@dataclass(frozen=True)
class Panel:
    """A pair of axes with a line of intervals for each planner;
    a line is broken where there is no estimate.
    """

    title: str
    x_label: str  # with unit
    y_label: str
    x: Sequence[float]
    lines: Mapping[str, Sequence[Interval]]
    log: tuple[bool, bool] = (True, True)  # whether x and y are logarithmic
    level: float | None = None  # height of a dotted line, such as 1 for ratios
    bands: bool = True  # show intervals, where there are any


def panels_figure(panels: Sequence[Panel], columns: int = 2) -> Figure:
    """The panels row by row, with one legend below."""
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.8 * columns, 3.6 * rows + 0.5), layout="constrained")
    axes_of = figure.subplots(rows, columns, squeeze=False).ravel()
    names = list(dict.fromkeys(name for panel in panels for name in panel.lines))
    for axes, panel in zip(axes_of, panels, strict=False):
        _draw(axes, panel)
    for axes in axes_of[len(panels) :]:
        axes.axis("off")
    labelled = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in axes_of]
    handles = {label: handle for pairs in labelled for handle, label in pairs}
    figure.legend(
        [handles[name] for name in names],
        names,
        loc="outside lower center",
        ncols=min(len(names), 4),
        frameon=False,
        fontsize="small",
    )
    return figure


def _draw(axes: Axes, panel: Panel) -> None:
    for name, line in panel.lines.items():
        style = line_style(name)
        known = [(x, i) for x, i in zip(panel.x, line, strict=True) if i.estimate is not None]
        x, y = [at for at, _ in known], [float(i.estimate or 0.0) for _, i in known]
        marker = "." if len(x) < FEW else ""
        axes.plot(x, y, marker=marker, label=name, **style)
        low = [i.low for _, i in known if i.low is not None]
        high = [i.high for _, i in known if i.high is not None]
        if panel.bands and len(low) == len(high) == len(x):
            axes.fill_between(x, low, high, color=style["color"], alpha=0.09, linewidth=0.0)
    if panel.level is not None:
        axes.axhline(panel.level, linestyle=":", color=REFERENCE_COLOUR, linewidth=1.0)
    axes.set(title=panel.title, xlabel=panel.x_label, ylabel=panel.y_label)
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
