"""Errors that teach: each names the offending value, the valid choices and the cure, in one line.

Failing to plan is a result (`PlanStatus`), never an exception. The command line turns every
`CvqmptError` into that one line on standard error and exit code 2.
"""

from collections.abc import Iterable


class CvqmptError(Exception):
    """Base of every error this package raises on purpose."""


class UnknownChoiceError(CvqmptError):
    """A name that is not in a table of choices."""

    def __init__(self, kind: str, value: object, choices: Iterable[object]) -> None:
        listed = ", ".join(str(choice) for choice in choices)
        super().__init__(f"unknown {kind} {value!r}; valid choices: {listed}")


class InvalidInputError(CvqmptError):
    """A value, file or field that cannot be used as given."""


class InvalidProblemError(InvalidInputError):
    """A planning problem whose start, goals or constraint contradict each other."""


class RunStoreError(CvqmptError):
    """A results directory that cannot be read, written or continued."""
