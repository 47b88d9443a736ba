"""Shorter paths: time left after a first path (`improve`), restarts for it, and near-shortest
labels of training data.

Of length c, a path can only pass through configurations x with |x - start| + |x - goal| < c, a
prolate hyperspheroid (Gammell, Srinivasa and Barfoot 2014); restarts sample there, and what they
find is shortened. Planners with a roadmap look for other ways by small roadmaps instead
(`informed_roadmap`).
"""

from dataclasses import dataclass, replace

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.query import Deadline, SamplingDistribution, Search, Uniform, Ways
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.shortcut import SWEEP, SimplifySettings, simplify
from cvqmpt_lab.search.space import ConstrainedSpace

STRETCHES = (1.1, 1.3, 1.6, 2.0, 2.6, np.inf)
"""Times the straight line's length, up to the best path's:
short ways to each goal are looked for in this order.
"""
# iterations of a search among all that may be shorter, and of one for short ways
AMONG, NARROW = 200, 60
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
        first = self.lengths[0][1]
        return 1.0 - self.lengths[-1][1] / first if first else 0.0


def check_units(budget: Budget, optimize: Budget) -> None:
    """Refuse a clock in a run that has none: InvalidInputError."""
    if budget.seconds is None and optimize.seconds is not None:
        raise InvalidInputError(
            f"optimize: {optimize.seconds:g} s in a run of {budget.iterations} iterations, which "
            f"knows no clock and "
            f"so repeats; give optimize in iterations, or the run a budget in seconds"
        )


def improve(
    space: ConstrainedSpace,
    ways: Ways,
    first: JointPath,
    budget: Budget,
    rng: np.random.Generator,
    settings: SimplifySettings | None = None,
) -> tuple[JointPath, Improvement]:
    """The best path that other ways and shortening find within a budget, never longer than the
    first; what it took.

    first: a path on the manifold, free and shortened.
    """
    deadline = Deadline(budget, space)
    nearest = max(
        float(np.linalg.norm(space.problem.goals - space.problem.start, axis=1).min()), LEAST
    )
    best, lengths, searches, fresh = first, [(0.0, first.length)], 0, True
    while deadline.spent() is None:
        found: JointPath | None = best
        if not fresh:
            if nearest >= best.length:
                break  # the path is straight
            found = ways.next_path(space, best, deadline, rng, searches)
            searches += 1
        deadline.count()  # so that a round without iterations ends, too
        if found is None:
            continue
        sweep = replace(
            settings or SimplifySettings(), attempts=SWEEP, seconds=deadline.rest().seconds
        )
        found = simplify(space, found, rng, sweep).path
        fresh = found.length < (1.0 - GAIN) * best.length
        if found.length < best.length:
            best = found
            lengths.append((deadline.seconds, best.length))
    return best, Improvement(
        budget, deadline.seconds, deadline.counters.iterations, searches, tuple(lengths)
    )


@dataclass(frozen=True, eq=False)
class Restarts:
    """Other searches by the same method;
    every other one looks for short ways near straight lines to the goals.
    """

    method: Search
    distribution: SamplingDistribution  # of the first search

    def next_path(
        self,
        space: ConstrainedSpace,
        best: JointPath,
        deadline: Deadline,
        rng: np.random.Generator,
        number: int,
    ) -> JointPath | None:
        """Search with new samples; see `query.Ways`."""
        start, rest = space.problem.start, deadline.rest()
        if number % 2 == 0:
            goals = nearer_goals(space, best.length)
            samples: SamplingDistribution = Detours(self.distribution, start, goals, best.length)
            most = AMONG
        else:
            stretch = STRETCHES[number // 2 % len(STRETCHES)]
            goals, samples = short_ways(space, best.length, stretch)
            most = NARROW
        bounded = replace(rest, iterations=min(most, rest.iterations or most))
        return self.method.search(space, start, goals, samples, bounded, rng).path


def nearer_goals(space: ConstrainedSpace, length: float) -> np.ndarray:
    """Goals (k, n) that a path shorter than `length` [rad] may end at."""
    goals = space.problem.goals
    return goals[np.maximum(np.linalg.norm(goals - space.problem.start, axis=1), LEAST) < length]


def short_ways(
    space: ConstrainedSpace, length: float, stretch: float
) -> tuple[np.ndarray, "ShortWays"]:
    """Goals (k, n) for paths shorter than `length` [rad], and samples near the straight lines to
    them.

    stretch: what such a path is longer than straight, at most; goals that this rules nothing out
        for are left out.
    """
    start, goals = space.problem.start, nearer_goals(space, length)
    reach = np.minimum(stretch * np.maximum(np.linalg.norm(goals - start, axis=1), LEAST), length)
    short = reach < length
    if short.any():
        goals, reach = goals[short], reach[short]
    return goals, ShortWays(start, goals, reach, space.robot.lower, space.robot.upper)


@dataclass(frozen=True, eq=False)
class ShortWays:
    """Uniform over configurations on motions from start to a goal no longer than its reach, clipped
    to the limits.

    Such configurations fill a prolate hyperspheroid with both as foci; each goal's is as likely as
    the others'.
    """

    start: np.ndarray  # (n,)
    goals: np.ndarray  # (k, n)
    reach: np.ndarray  # (k,) [rad]
    lower: np.ndarray  # (n,)
    upper: np.ndarray  # (n,)
    name: str = "short-ways"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        n, k = len(self.start), len(self.goals)
        to = rng.integers(k, size=count) if k > 1 else np.zeros(count, dtype=int)
        along = (self.goals - self.start)[to]
        straight = np.sqrt((along**2).sum(axis=1, keepdims=True))
        ball = rng.normal(size=(count, n))
        ball *= rng.random((count, 1)) ** (1.0 / n) / np.sqrt((ball**2).sum(axis=1, keepdims=True))
        length, axis = self.reach[to, None], along / np.maximum(straight, LEAST)
        across = 0.5 * np.sqrt(np.maximum(length**2 - straight**2, 0.0))
        onwards = (0.5 * length - across) * (ball * axis).sum(axis=1, keepdims=True)
        middle = self.start + 0.5 * along
        return np.clip(middle + across * ball + onwards * axis, self.lower, self.upper)


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
    """The shortest free path (on the manifold) found from start to goal (n,), or None when none was
    found.
    """
    settings = settings or NearShortestSettings()
    trees, lower, upper = BiRRT(), space.robot.lower, space.robot.upper
    best: JointPath | None = None
    tries = 0
    while tries < (settings.restarts + 1 if best else 2):
        tries += 1
        sampler: SamplingDistribution = Uniform(lower, upper)
        if best is not None:
            sampler = ShortWays(start, goal[None], np.array([best.length]), lower, upper)
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
