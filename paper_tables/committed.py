"""Committed tables against a fresh rendering of the committed rows: they must be equal byte for byte."""

import csv
import io
import shutil
import tempfile
from itertools import zip_longest
from pathlib import Path

from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.results.provenance import PROVENANCE_FILE
from cvqmpt_lab.results.store import RUNS_FILE
from paper_tables.render import PUBLISHED, render_directory

RESULTS = PUBLISHED.parent / "results"
CELL_SEPARATORS = {".md": "|", ".tex": "&"}


def committed_directories(results: Path = RESULTS) -> list[Path]:
    """The directories below `results` that hold rows."""
    return sorted(path.parent for path in results.glob(f"*/{RUNS_FILE}"))


def differing_cells(directory: Path) -> list[str]:
    """A line for every table of a directory that is missing or differs: the file, row and cell."""
    with tempfile.TemporaryDirectory(prefix="cvqmpt-tables-") as scratch:
        for name in (RUNS_FILE, PROVENANCE_FILE):
            if (directory / name).is_file():
                shutil.copy(directory / name, scratch)
        try:
            fresh = render_directory(Path(scratch))
        except CvqmptError as error:
            return [f"{directory}: cannot be rendered: {str(error).replace(scratch, str(directory))}"]
        found = []
        for path in fresh:
            committed = directory / path.name
            if not committed.is_file():
                found.append(f"{committed}: missing; render it with: cvqmpt table {directory}")
            elif committed.read_bytes() != path.read_bytes():
                where = _first_difference(committed.read_bytes(), path.read_bytes(), path.suffix)
                found.append(f"{committed}, {where}; render it anew with: cvqmpt table {directory}")
        return found


def _first_difference(committed: bytes, fresh: bytes, suffix: str) -> str:
    """The first line, and cell of it, in which two texts differ."""
    old_lines = committed.decode("utf-8", "replace").splitlines()
    new_lines = fresh.decode("utf-8").splitlines()
    for number, (old, new) in enumerate(zip_longest(old_lines, new_lines, fillvalue=""), start=1):
        if old == new:
            continue
        cells = zip_longest(_cells(old, suffix), _cells(new, suffix), fillvalue="")
        for column, (was, now) in enumerate(cells, start=1):
            if was != now:
                row = next((cell for cell in _cells(new, suffix) if cell), "")
                return f"line {number}, row {row!r}, cell {column}: committed {was!r}, rendered {now!r}"
        return f"line {number}: spaces differ"
    return "line ends differ"


def _cells(line: str, suffix: str) -> list[str]:
    """The cells of one line of a table."""
    if suffix == ".csv":
        return next(csv.reader(io.StringIO(line)), [])
    return [cell.strip() for cell in line.split(CELL_SEPARATORS[suffix])]
