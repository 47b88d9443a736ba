"""What becomes of success, truth and length on scanned scenes when one thing is varied: a column for each."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cvqmpt_lab.results.row import RUNS_FILE, read_rows
from experiments.figures.drawing import save_figure
from paper_tables.robustness_table import DEFAULT, TITLES, levels_of
from paper_tables.table_engine import Entry

SPREAD = 0.12  # [levels] between planners' marks at a level


def draw_robustness(folder: Path) -> list[Path]:
    """Draw the rows of a folder, beside them; RunStoreError or InvalidInputError when they cannot be read."""
    levels = levels_of(read_rows(folder / RUNS_FILE))
    return save_figure(robustness_figure(levels), folder, "robustness")


def robustness_figure(levels: Sequence[Entry]) -> Figure:
    """A column for each thing that is varied: solved above, free in truth in the middle, length below."""
    factors = tuple(dict.fromkeys(level.group[0] for level in levels))
    figure = Figure(figsize=(3.2 * len(factors), 7.2), layout="constrained")
    rows = figure.subplots(3, len(factors), squeeze=False, sharex="col", sharey="row")
    for column, factor in enumerate(factors):
        chosen = [level for level in levels if level.group[0] == factor]
        for axes, what in zip(rows[:, column], ("solved", "true_free", "length"), strict=True):
            _draw(axes, chosen, what)
        rows[-1, column].set_xlabel(TITLES.get(factor, factor), fontsize="small", wrap=True)
    for axes, label in zip(rows[:, 0], ("solved [%]", "free in truth [%]", "length [rad]"), strict=True):
        axes.set_ylabel(label)
    rows[0, 0].legend(frameon=False, fontsize="x-small", loc="lower left")
    return figure


def _draw(axes: Axes, levels: Sequence[Entry], what: str) -> None:
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
        shift = SPREAD * (k - 0.5 * (len(planners) - 1))
        x, y, low, high = (list(column) for column in zip(*known, strict=True))
        below = [at - (bound if bound is not None else at) for at, bound in zip(y, low, strict=True)]
        above = [(bound if bound is not None else at) - at for at, bound in zip(y, high, strict=True)]
        places = [at + shift for at in x]
        axes.errorbar(
            places, y, (below, above), fmt=".-", linewidth=1.0, elinewidth=0.7, capsize=2.0, label=planner
        )
    default = next(k for k, value in enumerate(values) if value.endswith(DEFAULT))
    axes.axvline(default, linestyle=":", color="0.6")
    axes.set_xticks(range(len(values)), [value.removesuffix(DEFAULT) for value in values])
