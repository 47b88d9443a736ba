"""Rows of an audit, one an episode, and their csv file, by which an audit is continued."""

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.files import csv_table, read_text, write_text

CERTIFIED, REFUSED, NOT_PROVEN = "certified", "refused", "not proven"
NOT_READ = "not read"
SHARES = ("position", "velocity", "acceleration", "jerk", "effort")


@dataclass(frozen=True)
class Row:
    """What an audit says of one episode; numbers that are not known are None."""

    file: str  # below the folder of the audit
    episode: str  # number in its data set, "" where a file has one
    verdict: str
    kinds: str = ""  # kinds of all faults, separated by blanks, the first in time first
    fault: str = ""  # the first fault in words, or why the episode was not read
    joint: str = ""  # joint or bodies of this fault
    time_s: float | None = None  # its time [s]
    states: int | None = None
    duration_s: float | None = None
    position: float | None = None  # used share of each limit, 1.0 is the limit
    velocity: float | None = None
    acceleration: float | None = None
    jerk: float | None = None
    effort: float | None = None
    self_mm: float | None = None  # least distance of the robot from itself [mm]
    self_proven_mm: float | None = None  # proven at every time [mm]
    obstacle_mm: float | None = None  # least distance from obstacles [mm]
    jumps: int | None = None
    gaps: int | None = None
    largest_gap_s: float | None = None
    repeated: int | None = None  # stamps that do not increase
    note: str = ""
    middle: str = ""  # median of each joint by name, as json [rad or m]
    key: str = ""  # digest of file and settings

    @property
    def name(self) -> str:
        """File and number of the episode."""
        return f"{self.file} {self.episode}".strip()

    @property
    def medians(self) -> dict[str, float]:
        """Median of each joint by name [rad or m]."""
        return dict(json.loads(self.middle)) if self.middle else {}


_NUMBERS = {field.name: int if "int" in str(field.type) else float for field in fields(Row)}
_TEXTS = {field.name for field in fields(Row) if field.type in (str, "str")}


def worst_first(rows: Iterable[Row]) -> list[Row]:
    """Return refused rows, then not proven ones, ones not read, and by the use of limits."""
    order = (REFUSED, NOT_PROVEN, NOT_READ, CERTIFIED)

    def rank(row: Row) -> tuple[int, int, float]:
        used = max((getattr(row, kind) or 0.0 for kind in SHARES), default=0.0)
        return order.index(row.verdict), -len(row.kinds.split()), -used

    return sorted(rows, key=rank)


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a csv file with a header."""
    names = [field.name for field in fields(Row)]
    table = [[asdict(row)[name] for name in names] for row in rows]
    write_text(path, csv_table([names, *table]))


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a csv file; none if there is no such file, or it is none of an audit."""
    if not path.is_file():
        return []
    lines = list(csv.DictReader(io.StringIO(read_text(path, "rows"))))
    found = list[Row]()
    for line in lines:
        try:
            values: dict[str, Any] = {
                name: (line[name] if name in _TEXTS else _number(name, line[name]))
                for name in _NUMBERS
            }
            row = Row(**values)
            _ = row.medians
        except (KeyError, ValueError, TypeError):
            continue  # of another version, or changed by hand: the episode is judged again
        if row.verdict in (CERTIFIED, REFUSED, NOT_PROVEN, NOT_READ):
            found.append(row)
    return found


def _number(name: str, text: str | None) -> float | int | None:
    """Return the number of a cell, None of an empty one."""
    return _NUMBERS[name](text) if text else None
