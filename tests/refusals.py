"""Calls that must be refused."""

import pytest

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError

REFUSALS = (InvalidInputError, UnknownChoiceError)  # their lines tell them apart


def refused(pattern, call, *args, error=REFUSALS, **kwargs):
    """The error's one printable line, which matches a pattern."""
    with pytest.raises(error, match=pattern) as caught:
        call(*args, **kwargs)
        pytest.fail(f"not refused, though {pattern!r} was expected: {args} {kwargs}")
    assert str(caught.value).isprintable()
    return str(caught.value)
