"""Time left after a first path: more searches with other luck where a shorter one can be, and more shortening."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.result import Budget, JointPath
from cvqmpt_lab.planning.search import Search
from cvqmpt_lab.planning.short_ways import LEAST, Detours, ShortWays, Spheroid
from cvqmpt_lab.planning.simplify import SWEEP, SimplifySettings, simplify
from cvqmpt_lab.planning.space import ConstrainedSpace

STRETCHES = (1.1, 1.3, 1.6, 2.0, 2.6, np.inf)
"""Times the straight line's length, up to the best path's: short ways to each goal are looked for in this order."""
AMONG, NARROW = 200, 60  # iterations of a search among all that may be shorter, and of one for short ways
GAIN = 0.002  # of its length that shortening must take off a path to be tried again


@dataclass(frozen=True, eq=False)
class Improvement:
    """What was made of time left after a first path."""

    budget: Budget
    """Seconds or iterations that there were."""
    seconds: float
    """Used, wall time [s]."""
    iterations: int
    """Used."""
    searches: int
    """Begun with other seeds."""
    lengths: tuple[tuple[float, float], ...]
    """Seconds since the first path and length [rad], of that path and each better one."""

    @property
    def gained(self) -> float:
        """Share of the first path's length that was taken off."""
        return 1.0 - self.lengths[-1][1] / self.lengths[0][1]


def check_units(budget: Budget, optimize: Budget) -> None:
    """Refuse a clock in a run that has none: InvalidInputError."""
    if budget.seconds is None and optimize.seconds is not None:
        raise InvalidInputError(
            f"optimize: {optimize.seconds:g} s in a run of {budget.iterations} iterations, which knows no clock and "
            f"so repeats; give optimize in iterations, or the run a budget in seconds"
        )


def improve(
    space: ConstrainedSpace,
    method: Search,
    distribution: SamplingDistribution,
    first: JointPath,
    budget: Budget,
    rng: np.random.Generator,
    settings: SimplifySettings | None = None,
) -> tuple[JointPath, Improvement]:
    """The best path that restarts and shortening find within a budget, never longer than the first; and what it took.

    Every other search looks for short ways near straight lines to the goals, which coarse samples miss.

    Parameters
    ----------
    distribution: what the first search drew from.
    first: on the manifold, free and shortened.
    """
    allowance = Allowance(budget, space)
    best, lengths, searches, fresh = first, [(0.0, first.length)], 0, True
    while allowance.spent() is None:
        found: JointPath | None = best
        if not fresh:
            attempt = _attempt(space, distribution, searches, best.length)
            if attempt is None:
                break  # the path is straight
            rest = allowance.rest()
            bounded = replace(rest, iterations=min(attempt.iterations, rest.iterations or attempt.iterations))
            found = method.search(
                space, space.problem.start, attempt.goals, attempt.samples, bounded, rng
            ).path
            searches += 1
        allowance.count()  # so that a round without iterations ends, too
        if found is None:
            continue
        sweep = replace(settings or SimplifySettings(), attempts=SWEEP, seconds=allowance.rest().seconds)
        found = simplify(space, found, rng, sweep).path
        fresh = found.length < (1.0 - GAIN) * best.length
        if found.length < best.length:
            best = found
            lengths.append((allowance.seconds, best.length))
    return best, Improvement(budget, allowance.seconds, allowance.iterations, searches, tuple(lengths))


class _Attempt(NamedTuple):
    """What one search is asked."""

    goals: np.ndarray
    """(k, n) [rad or m]."""
    samples: SamplingDistribution
    iterations: int
    """At most."""


def _attempt(
    space: ConstrainedSpace, distribution: SamplingDistribution, number: int, length: float
) -> _Attempt | None:
    """Where that search after the first path looks for one shorter than `length` [rad]; None if there is none."""
    problem, robot = space.problem, space.robot
    straight = np.maximum(np.linalg.norm(problem.goals - problem.start, axis=1), LEAST)
    nearer = straight < length
    if not nearer.any():
        return None
    if number % 2 == 0:
        goals = problem.goals[nearer]
        return _Attempt(goals, Detours(distribution, problem.start, goals, length), AMONG)
    reach = np.minimum(STRETCHES[number // 2 % len(STRETCHES)] * straight, length)
    short = reach < length
    goals, reach = (values[short if short.any() else nearer] for values in (problem.goals, reach))
    ways = (
        Spheroid(problem.start, goal, most, robot.lower, robot.upper)
        for goal, most in zip(goals, reach.tolist(), strict=True)
    )
    return _Attempt(goals, ShortWays(tuple(ways)), NARROW)
