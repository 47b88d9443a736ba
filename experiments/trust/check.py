"""What a promise is put to: so many trials, and the faults that they found."""

import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple


class Trial(NamedTuple):
    """What came of a check."""

    tried: int
    """Trials made, in the check's unit."""
    faults: Sequence[str]
    """One line each: what was tried, so that it can be tried again, and what went wrong."""


@dataclass(frozen=True)
class Check:
    """One promise."""

    promise: str
    """In a few words, as docs/guarantees.md lists it."""
    unit: str
    """What is counted, in the plural."""
    short: int
    """Trials in the tests of every commit; 0 to leave it out there."""
    long: int
    """Trials of `make trust`."""
    attack: Callable[[int], Trial]
    """Makes about so many trials."""


@dataclass(frozen=True)
class Finding:
    """A check that was made."""

    part: str
    check: Check
    trial: Trial
    seconds: float
    """Wall time [s]."""
    processor: float
    """Processor time [s] of this process and those that it began and that ended."""

    def __str__(self) -> str:
        verdict = f"{len(self.trial.faults)} faults" if self.trial.faults else "no fault"
        return (
            f"{self.part:14} {self.check.promise}: {self.trial.tried} {self.check.unit}, {verdict} "
            f"({self.seconds:.0f} s, {self.processor:.0f} s of a processor)"
        )


def made(part: str, check: Check, trials: int) -> Finding:
    """Make a check; what it cannot bear is a fault, and the next one is made."""
    began, worked = time.perf_counter(), _processor()
    try:
        trial = check.attack(trials)
    except Exception as error:
        trial = Trial(0, [f"ended by {type(error).__name__}: {' '.join(str(error).split())}"])
    return Finding(part, check, trial, time.perf_counter() - began, _processor() - worked)


def _processor() -> float:
    uses = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(use.ru_utime + use.ru_stime for use in uses)
