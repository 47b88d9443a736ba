"""Calls that must be refused."""

import pytest

from cvqmpt_lab.errors import InvalidInputError


def refused(pattern, call, *args, error=InvalidInputError, **kwargs):
    """The error's one line, which matches a pattern."""
    with pytest.raises(error, match=pattern) as caught:
        call(*args, **kwargs)
        pytest.fail(f"not refused, though {pattern!r} was expected: {args} {kwargs}")
    assert "\n" not in str(caught.value)
    return str(caught.value)
