"""Work of an external planner: what it calls of this package is counted, the rest it may report."""

import functools
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError, shown
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints import region_constraint
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.search.result import Counters

REPORTED = ("projections", "newton_iterations", "state_checks")
MOST = 2**53  # json represents larger numbers inexactly


@dataclass
class Work:
    """Counts of one call of a planner."""

    projections: int = 0
    newton_iterations: int = 0
    state_checks: int = 0


@contextmanager
def counted() -> Iterator[Work]:
    """Count `manifold.project`, `in_collision` and `in_collision_batch` in this process.

    Only calls from outside this package count: `solve` and the like make such calls, too, and
    count their own work.
    """
    work, steps = Work(), region_constraint.project

    def project(of: Any, method: Callable[..., Any], *args: Any, **named: Any) -> Any:
        def stepping(*inner: Any) -> int:
            taken = int(steps(*inner))
            work.newton_iterations += taken if taken >= 0 else -1 - taken
            return taken

        work.projections += 1
        region_constraint.project = stepping
        try:
            return method(of, *args, **named)
        finally:
            region_constraint.project = steps

    def check(of: Any, method: Callable[..., Any], *args: Any, **named: Any) -> Any:
        work.state_checks += 1
        return method(of, *args, **named)

    def check_batch(of: Any, method: Callable[..., Any], *args: Any, **named: Any) -> Any:
        found = method(of, *args, **named)
        work.state_checks += len(found)
        return found

    with (
        _replaced(RegionConstraint, "project", project),
        _replaced(CollisionChecker, "in_collision", check),
        _replaced(CollisionChecker, "in_collision_batch", check_batch),
    ):
        yield work


@contextmanager
def _replaced(owner: type, name: str, count: Callable[..., Any]) -> Iterator[None]:
    """Replace a method of a class by one that counts calls from outside this package."""
    original = getattr(owner, name)
    setattr(owner, name, _from_outside(original, count))
    try:
        yield
    finally:
        setattr(owner, name, original)


def _from_outside(method: Callable[..., Any], count: Callable[..., Any]) -> Callable[..., Any]:
    """Return a method that is counted where a module outside this package calls it."""

    @functools.wraps(method)
    def called(of: Any, *args: Any, **named: Any) -> Any:
        caller = str(sys._getframe(1).f_globals.get("__name__"))
        if caller.partition(".")[0] == "cvqmpt_lab":
            return method(of, *args, **named)
        return count(of, method, *args, **named)

    return called


def with_reported(work: Mapping[str, Any], reported: Mapping[Any, Any]) -> dict[str, int]:
    """Return counts, where what a planner reports replaces what was counted.

    Args:
        work: counts by name.
        reported: the planner's own, some of `REPORTED`.

    Raises:
        InvalidInputError: another name, or no whole number from 0 to 2^53.
    """
    counts = dict(work)
    for name, value in reported.items():
        if name not in REPORTED:
            raise InvalidInputError(
                f"it reported {shown(name)}: valid counts are {', '.join(REPORTED)}"
            )
        try:
            whole = int(value)
        except (TypeError, ValueError, OverflowError):
            whole = -1
        if whole != value or not 0 <= whole <= MOST:
            raise InvalidInputError(
                f"it reported {name} {shown(value)}: give a whole number, 0 or more"
            )
        counts[name] = whole
    return {name: counts[name] for name in REPORTED}


def counters_of(words: Mapping[str, Any]) -> Counters:
    """Return the counts of a reply; InvalidInputError if they are none."""
    found = words.get("counts", {})
    if not isinstance(found, Mapping):
        raise InvalidInputError(f"it reported {shown(found)}: give counts by name")
    return Counters(**with_reported(dict.fromkeys(REPORTED, 0), found))
