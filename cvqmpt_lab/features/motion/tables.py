"""Tables of motions in text: separators, the header, and the unit of the times.

Columns are separated by semicolons, commas, tabs or blanks. Numbers between other separators than
commas may have decimal commas. The column of times is called ``time``, ``timestamp`` or ``t``,
perhaps with a unit: ``time_ms``, ``time [us]``.
"""

import csv
import logging
import re
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, few, shown

log = logging.getLogger("cvqmpt")
# seconds in a unit of time, by the names that headers give it
UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "micros", "microseconds", "\u00b5s", "\u03bcs"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanos", "nanoseconds"), 1e-9),
}
_TIME = re.compile(
    r"_*(?:times?|t|time_?stamp|time_from_start)"
    rf"(?:(?:[ _]+|[ _]*[\[(])({'|'.join(UNITS)})[\])]?)?",
    re.IGNORECASE,
)
# columns of positions in recordings of the RTDE interface of Universal Robots, the first one found
RECORDED = ("actual_q", "target_q")


class Table(NamedTuple):
    """Numbers of a table, and the names of its columns."""

    header: tuple[str, ...] | None  # k names, "time" is the column of times [s]; None: no header
    values: np.ndarray  # (m, k)
    in_seconds: bool = False  # whether the header states the unit of the times
    named: bool = True  # whether the header has names of joints; else columns have their order


def read_table(text: str) -> Table:
    """Return the table of a text, with times in seconds."""
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise InvalidInputError("it is empty")
    lines[0] = lines[0].lstrip("# ")
    separator = next((sign for sign in ";,\t" if sign in lines[0]), None)
    if separator is None:
        rows = [line.split() for line in lines]
    else:
        rows = list(csv.reader(lines, delimiter=separator))
    header = None
    try:
        _ = [float(_decimal(cell, separator)) for cell in rows[0]]
    except ValueError:
        header, rows = tuple(name.strip(" \t\"'") for name in rows[0]), rows[1:]
    if not rows:
        raise InvalidInputError("it has a header, but no states under it")
    cells = [[_number(cell, separator) for cell in row] for row in rows]
    values = np.array(cells).reshape(len(rows), -1)
    if header is None:
        return Table(None, values)
    if values.shape[1] != len(header):
        raise InvalidInputError(
            f"{len(header)} names in its header, {values.shape[1]} values a row"
        )
    return _recorded(_timed(_counted(Table(header, values))))


def _decimal(cell: str, separator: str | None) -> str:
    """Return the text of a cell with a decimal point."""
    return cell.strip(" \t") if separator == "," else cell.strip(" \t").replace(",", ".")


def _number(cell: str, separator: str | None) -> float:
    """Return the number in a cell; refuse what only `float` accepts: 1_0, other scripts."""
    decimal = r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf)"
    text = _decimal(cell, separator)
    if re.fullmatch(decimal, text, re.ASCII | re.IGNORECASE) is None:
        raise InvalidInputError(
            f"{shown(cell)}: give a decimal number, such as 0.25 or -1e-3, in columns separated by "
            "commas, semicolons or blanks"
        )
    return float(text)


def _counted(table: Table) -> Table:
    """Return a table without a first column that has no name and counts the rows."""
    assert table.header is not None
    first = table.values[:, 0]
    unnamed = table.header[0] == "" or table.header[0].startswith("Unnamed")
    if not unnamed or not np.array_equal(first - first[0], np.arange(len(first))):
        return table
    log.warning("the first column of the motion has no name and counts the rows: it is left out")
    return Table(table.header[1:], table.values[:, 1:])


def _timed(table: Table) -> Table:
    """Return a table whose column of times is called "time", with its values in seconds."""
    assert table.header is not None
    found = {k: _TIME.fullmatch(name) for k, name in enumerate(table.header)}
    columns = [k for k, match in found.items() if match]
    if "time" in table.header or len(columns) != 1:
        return table
    (column,) = columns
    unit = next(filter(None, (match[1] for match in found.values() if match)), None)
    header = [*table.header]
    header[column] = "time"
    values = table.values.copy()
    values[:, column] *= UNITS[unit.lower()] if unit else 1.0
    return Table(tuple(header), values, unit is not None)


def _recorded(table: Table) -> Table:
    """Return a recording of Universal Robots with the columns of positions and times alone."""
    assert table.header is not None
    places = {name: k for k, name in enumerate(table.header)}
    kind = next((kind for kind in RECORDED if f"{kind}_0" in places), None)
    if kind is None:
        return table
    count = next(k for k in range(len(places) + 1) if f"{kind}_{k}" not in places)
    kept = [name for name in ("time", *(f"{kind}_{k}" for k in range(count))) if name in places]
    left = [name for name in places if name not in kept]
    said = f"; left out: {few(left)}" if left else ""
    log.warning(
        f"columns {kind}_0 to {kind}_{count - 1} are read as the positions of the robot's joints "
        f"in their order{said}"
    )
    values = table.values[:, [places[name] for name in kept]]
    return Table(tuple(kept), values, in_seconds=True, named=False)
