"""Calls that must be refused, and tables of them."""

import csv
from pathlib import Path

import pytest

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError

DATA = Path(__file__).resolve().parents[1] / "data"
REFUSALS = (InvalidInputError, UnknownChoiceError)  # their lines tell them apart


def table(name):
    """Rows of `tests/data/NAME.csv`, by the names in its first line."""
    with (DATA / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def refused(pattern, call, *args, error=REFUSALS, **kwargs):
    """Return the error's message, which must be one printable line that matches a pattern."""
    with pytest.raises(error, match=pattern) as caught:
        call(*args, **kwargs)
        pytest.fail(f"not refused, though {pattern!r} was expected: {args} {kwargs}")
    assert str(caught.value).isprintable()
    return str(caught.value)
