"""Errors are one printable line, whatever they quote."""

import pickle

import pytest

from cvqmpt_lab.errors import LONGEST_LINE, InvalidInputError, RunStoreError, UnknownChoiceError


@pytest.mark.parametrize(
    "error",
    [
        InvalidInputError(f"cannot read scene {'x' * 9000}: File name too long; choose another"),
        RunStoreError("a\nb\x1b[31m\ud800; choose another"),
        UnknownChoiceError("thing", "é\n" * 5000, ["a" * 3000, "another"]),
    ],
)
def test_an_error_is_one_printable_line_that_keeps_its_end(error):
    assert str(error).isprintable() and len(str(error)) <= LONGEST_LINE and "another" in str(error)[-60:]
    str(error).encode()


@pytest.mark.parametrize(
    "error",
    [
        InvalidInputError("cannot write a  b; choose a folder"),
        UnknownChoiceError("planner", "birt", ["birrt", "mpnet"]),
    ],
)
def test_an_error_of_a_worker_arrives(error):
    arrived = pickle.loads(pickle.dumps(error))
    assert type(arrived) is type(error) and str(arrived) == str(error)
