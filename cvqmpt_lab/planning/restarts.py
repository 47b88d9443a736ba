"""Time left after a first path: more searches with other luck among ever shorter detours, and more shortening."""

from dataclasses import dataclass, replace

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.result import Budget, JointPath
from cvqmpt_lab.planning.search import Search
from cvqmpt_lab.planning.simplify import SWEEP, SimplifySettings, simplify
from cvqmpt_lab.planning.space import ConstrainedSpace

CROWD = 4  # samples drawn for one that is used
GAIN = 0.002  # of its length that shortening must take off a path to be tried again


@dataclass(frozen=True, eq=False)
class Detours:
    """Samples of another distribution that may lie on a way shorter than `length` come first."""

    base: SamplingDistribution
    start: np.ndarray
    """(n,) [rad or m]."""
    goals: np.ndarray
    """(k, n) [rad or m]."""
    length: float
    """Of the best path known [rad]."""

    @property
    def name(self) -> str:
        """That of the distribution."""
        return self.base.name

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        drawn = self.base.sample(rng, CROWD * count)
        to_goal = np.linalg.norm(drawn[:, None] - self.goals, axis=2).min(axis=1)
        too_long = np.linalg.norm(drawn - self.start, axis=1) + to_goal > self.length
        return drawn[np.argsort(too_long, kind="stable")[:count]]


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

    Parameters
    ----------
    distribution: what the first search drew from.
    first: on the manifold, free and shortened.
    """
    allowance, problem = Allowance(budget, space), space.problem
    best, lengths, searches, fresh = first, [(0.0, first.length)], 0, True
    while allowance.spent() is None:
        rest = allowance.rest()
        if fresh:
            found: JointPath | None = best
        else:
            nearer = problem.goals[np.linalg.norm(problem.goals - problem.start, axis=1) < best.length]
            if not len(nearer):
                break  # the path is straight
            shorter = Detours(distribution, problem.start, nearer, best.length)
            found = method.search(space, problem.start, nearer, shorter, rest, rng).path
            searches += 1
        allowance.count()  # so that a round without iterations ends, too
        if found is None:
            continue
        bounded = replace(settings or SimplifySettings(), attempts=SWEEP, seconds=allowance.rest().seconds)
        found = simplify(space, found, rng, bounded).path
        fresh = found.length < (1.0 - GAIN) * best.length
        if found.length < best.length:
            best = found
            lengths.append((allowance.seconds, best.length))
    return best, Improvement(budget, allowance.seconds, allowance.iterations, searches, tuple(lengths))
