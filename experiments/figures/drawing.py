"""What figures share: pictures and tables in files."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from cvqmpt_lab.files import write_bytes, write_text


def figure_bytes(figure: Figure, kind: str) -> bytes:
    """A figure as png or svg; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    dated = {"Date": None} if kind == "svg" else None
    with matplotlib.rc_context({"svg.hashsalt": "cvqmpt"}):
        figure.savefig(buffer, format=kind, dpi=160, metadata=dated)
    return buffer.getvalue()


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write name.png and name.svg, each at once or not at all."""
    paths = [folder / f"{name}.{kind}" for kind in ("png", "svg")]
    for path in paths:
        write_bytes(path, figure_bytes(figure, path.suffix[1:]))
    return paths


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> Path:
    """Write a table whose rows are cells by column, numbers to 6 digits, at once or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        cells = {name: f"{x:.6g}" if isinstance(x, float) else x for name, x in row.items()}
        writer.writerow(cells)
    write_text(path, text.getvalue())
    return path
