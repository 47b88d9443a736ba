"""Write figures and their tables to files."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from cvqmpt_lab.files import csv_table, write_bytes, write_text


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as the content of a file; kind: "png" or "svg". Equal figures give equal bytes."""
    buffer = io.BytesIO()
    # without metadata and hashsalt an svg file would contain the date and random identifiers
    metadata = {"Date": None} if kind == "svg" else None
    with matplotlib.rc_context({"svg.hashsalt": "cvqmpt"}):
        figure.savefig(buffer, format=kind, dpi=160, metadata=metadata)
    return buffer.getvalue()


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.svg into a folder, each atomically; returns their paths."""
    paths = [folder / f"{name}.{kind}" for kind in ("png", "svg")]
    for path in paths:
        write_bytes(path, figure_bytes(figure, path.suffix[1:]))
    return paths


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> Path:
    """Write a table atomically; returns its path.

    Args:
        path: of the csv file.
        rows: one or more, each with its cells by name of the column; the first one gives the
            order of the columns. Floats are written with 6 significant digits.
    """
    cells = [[f"{x:.6g}" if isinstance(x, float) else x for x in row.values()] for row in rows]
    write_text(path, csv_table([rows[0], *cells]))
    return path
