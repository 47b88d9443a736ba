"""What more training data is worth: numbers beside a model's weights, drawn."""

import csv
import io
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_text
from cvqmpt_lab.results.statistics import Interval
from experiments.figures.drawing import save_figure
from experiments.figures.lines import Line, Panel, panels_figure

CURVE_FILE = "learning_curve.csv"
BOUNDS = ("_low", "_high")


def draw_learning_curve(folder: Path) -> list[Path]:
    """Draw `CURVE_FILE` of a folder: its first column against every other one, a panel each.

    Columns X_low and X_high are the interval of X.

    Raises
    ------
    InvalidInputError
        When there is no such file, or a cell is no number.
    """
    path = folder / CURVE_FILE
    rows = list(csv.DictReader(io.StringIO(read_text(path))))
    if not rows:
        raise InvalidInputError(
            f"{path} has no rows; write a header and a line for each size of training set"
        )
    try:
        columns = {name: [float(row[name]) for row in rows] for name in rows[0]}
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{path}: {error}; every cell must be a number") from None
    size, *others = columns
    panels = [
        Panel(name, size, name, [Line(name, columns[size], _intervals(columns, name))], log=(True, False))
        for name in others
        if not name.endswith(BOUNDS)
    ]
    return save_figure(panels_figure(panels), folder, "learning_curve")


def _intervals(columns: dict[str, list[float]], name: str) -> list[Interval]:
    low, high = (columns.get(name + end) for end in BOUNDS)
    return [
        Interval(value, low[k] if low else None, high[k] if high else None, 1)
        for k, value in enumerate(columns[name])
    ]
