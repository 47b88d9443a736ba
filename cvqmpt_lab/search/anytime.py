"""Shorter paths by restarts: time left after a first path (`improve`), and near-shortest labels of training data.

Of length c, a path can only pass through configurations x with |x - start| + |x - goal| < c, a prolate hyperspheroid
(Gammell, Srinivasa and Barfoot 2014); restarts sample there, and what they find is shortened.
"""

from dataclasses import dataclass, replace

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.query import Deadline, SamplingDistribution, Search, Uniform
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.shortcut import SWEEP, SimplifySettings, simplify
from cvqmpt_lab.search.space import ConstrainedSpace

STRETCHES = (1.1, 1.3, 1.6, 2.0, 2.6, np.inf)
"""Times the straight line's length, up to the best path's: short ways to each goal are looked for in this order."""
AMONG, NARROW = 200, 60  # iterations of a search among all that may be shorter, and of one for short ways
CROWD = 4  # samples drawn for one that is used
LEAST = 1e-9  # [rad or m] between start and goal, so that there is a direction
GAIN = 0.002  # of its length that shortening must take off a path to be tried again


@dataclass(frozen=True, eq=False)
class Improvement:
    """What was made of time left after a first path."""

    budget: Budget  # seconds or iterations that there were
    seconds: float  # used, wall time [s]
    iterations: int  # used
    searches: int  # begun with other seeds
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
    distribution: of the first search. first: its path, on the manifold, free and shortened.
    """
    deadline = Deadline(budget, space)
    best, lengths, searches, fresh = first, [(0.0, first.length)], 0, True
    while deadline.spent() is None:
        found: JointPath | None = best
        if not fresh:
            attempt = _attempt(space, distribution, searches, best.length)
            if attempt is None:
                break  # the path is straight
            goals, samples, most = attempt
            rest = deadline.rest()
            bounded = replace(rest, iterations=min(most, rest.iterations or most))
            found = method.search(space, space.problem.start, goals, samples, bounded, rng).path
            searches += 1
        deadline.count()  # so that a round without iterations ends, too
        if found is None:
            continue
        sweep = replace(settings or SimplifySettings(), attempts=SWEEP, seconds=deadline.rest().seconds)
        found = simplify(space, found, rng, sweep).path
        fresh = found.length < (1.0 - GAIN) * best.length
        if found.length < best.length:
            best = found
            lengths.append((deadline.seconds, best.length))
    return best, Improvement(budget, deadline.seconds, deadline.counters.iterations, searches, tuple(lengths))


def _attempt(
    space: ConstrainedSpace, distribution: SamplingDistribution, number: int, length: float
) -> tuple[np.ndarray, SamplingDistribution, int] | None:
    """Goals (k, n), samples and iterations of a search for a path shorter than `length` [rad]; None: there is none."""
    problem, robot = space.problem, space.robot
    straight = np.maximum(np.linalg.norm(problem.goals - problem.start, axis=1), LEAST)
    nearer = straight < length
    if not nearer.any():
        return None
    if number % 2 == 0:
        goals = problem.goals[nearer]
        return goals, Detours(distribution, problem.start, goals, length), AMONG
    reach = np.minimum(STRETCHES[number // 2 % len(STRETCHES)] * straight, length)
    short = reach < length
    goals, reach = (values[short if short.any() else nearer] for values in (problem.goals, reach))
    ways = (
        Spheroid(problem.start, goal, most, robot.lower, robot.upper)
        for goal, most in zip(goals, reach.tolist(), strict=True)
    )
    return goals, ShortWays(tuple(ways)), NARROW


@dataclass(frozen=True, eq=False)
class Spheroid:
    """Uniform over configurations on motions no longer than `length` from start to goal, clipped to the limits."""

    start: np.ndarray
    goal: np.ndarray
    length: float
    lower: np.ndarray
    upper: np.ndarray
    name: str = "spheroid"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        n, along = len(self.start), self.goal - self.start
        straight = float(np.linalg.norm(along))
        ball = rng.normal(size=(count, n))
        ball *= (rng.random((count, 1)) ** (1.0 / n)) / np.linalg.norm(ball, axis=1, keepdims=True)
        across = 0.5 * np.sqrt(max(self.length**2 - straight**2, 0.0))
        axis = along / max(straight, LEAST)
        stretched = across * ball + np.outer((0.5 * self.length - across) * (ball @ axis), axis)
        return np.clip(0.5 * (self.start + self.goal) + stretched, self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class Detours:
    """Samples of another distribution that may lie on a way shorter than `length` come first."""

    base: SamplingDistribution
    start: np.ndarray  # (n,) [rad or m]
    goals: np.ndarray  # (k, n) [rad or m]
    length: float  # of the best path known [rad]

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
class ShortWays:
    """Uniform in spheroids around straight lines, each as likely as the others."""

    spheroids: tuple[Spheroid, ...]
    name: str = "short-ways"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        counts = np.bincount(rng.integers(len(self.spheroids), size=count), minlength=len(self.spheroids))
        parts = [one.sample(rng, k) for one, k in zip(self.spheroids, counts.tolist(), strict=True)]
        return rng.permutation(np.concatenate(parts))


@dataclass(frozen=True)
class NearShortestSettings:
    """How hard to try."""

    restarts: int = 12  # searches after the first path
    first: int = 1500  # iterations that the first search may take; it is tried twice
    later: int = 200  # iterations that each restart may take
    finish: int = 512  # attempts to shorten the best path in the end


def near_shortest(
    space: ConstrainedSpace,
    start: np.ndarray,
    goal: np.ndarray,
    rng: np.random.Generator,
    settings: NearShortestSettings | None = None,
) -> JointPath | None:
    """The shortest free path (on the manifold) found from start to goal (n,), or None when none was found."""
    settings = settings or NearShortestSettings()
    trees, lower, upper = BiRRT(), space.robot.lower, space.robot.upper
    best: JointPath | None = None
    tries = 0
    while tries < (settings.restarts + 1 if best else 2):
        tries += 1
        sampler = Spheroid(start, goal, best.length, lower, upper) if best else Uniform(lower, upper)
        budget = Budget(iterations=settings.later if best else settings.first)
        path = trees.search(space, start, goal[None], sampler, budget, rng).path
        if path is not None:
            path = simplify(space, path, rng).path
            best = path if best is None or path.length < best.length else best
        if best is not None and best.length < (1.0 + 1e-6) * np.linalg.norm(goal - start):
            return best  # the straight line
    if best is None:
        return None
    return simplify(space, best, rng, SimplifySettings(attempts=settings.finish, patience=8)).path
