"""Rows of named numbers, as text or binary, of which x, y and z are wanted."""

import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError

AXES = ("x", "y", "z")
MOST_COLUMNS = 1000  # of a row


@dataclass(frozen=True)
class Column:
    """A number of each row."""

    name: str
    kind: str
    """As numpy writes it, without byte order: "f4"."""


def three(columns: Sequence[Column], values: Callable[[int], np.ndarray]) -> np.ndarray:
    """The columns x, y and z as points (m, 3); values gives column k."""
    return np.stack([values(k).astype(np.float64) for k in places(columns)], axis=1)


def places(columns: Sequence[Column]) -> list[int]:
    """Which columns are x, y and z; each must occur once."""
    names = [column.name for column in columns]
    for axis in AXES:
        if names.count(axis) != 1:
            raise InvalidInputError(
                f"it has no single column {axis!r}; columns: {', '.join(names) or 'none'}"
            )
    return [names.index(axis) for axis in AXES]


def row_bytes(columns: Sequence[Column]) -> int:
    """Size of a binary row."""
    return sum(np.dtype(column.kind).itemsize for column in columns)


def from_rows(body: bytes, columns: Sequence[Column], count: int, order: str) -> np.ndarray:
    """Points of the first `count` binary rows; order: of their bytes, "<" or ">"."""
    size = row_bytes(columns)
    if count < 0 or count * size > len(body):
        raise InvalidInputError(
            f"its header says {count} points, the file holds {len(body) // max(1, size)}: cut short?"
        )
    rows = np.frombuffer(
        body, np.dtype([(f"{k}", order + item.kind) for k, item in enumerate(columns)]), count
    )
    return three(columns, lambda k: rows[f"{k}"])


def from_text(text: str, columns: Sequence[Column]) -> np.ndarray:
    """Points of lines of numbers."""
    return numbers_in(text, places(columns))


def numbers_in(text: str, chosen: Sequence[int]) -> np.ndarray:
    """Some columns of lines of numbers (m, k)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no data, which callers say themselves
        found = np.loadtxt(io.StringIO(text), usecols=chosen, ndmin=2, comments=("#", "//"))
    return found.reshape(-1, len(chosen))


def as_counted(points: np.ndarray, count: int) -> np.ndarray:
    """The points, if they are as many as the header says."""
    if len(points) != count:
        raise InvalidInputError(f"its header says {count} points, the file holds {len(points)}")
    return points
