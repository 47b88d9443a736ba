"""Shorter paths after a first one (`improve`), and near-shortest paths as labels of training data.

A path of length c from q_start to q_goal passes through configurations of the informed set
(Gammell, Srinivasa and Barfoot 2014), a prolate hyperspheroid with both as foci:

    { q : |q - q_start| + |q - q_goal| < c }

`restarted` repeats the search with samples from this set. `informed_roadmap_path` searches small
roadmaps of it. The paths that they find are shortened.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.jit import entry, placed
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.lazy_roadmap import CHECKED_FREE
from cvqmpt_lab.search.motion import (
    SAME_STATE_RAD,
    Space,
    distance,
    posed_state_valid,
    project_state,
)
from cvqmpt_lab.search.planner_interface import (
    PathSource,
    Query,
    SamplingDistribution,
    Search,
    Uniform,
)
from cvqmpt_lab.search.result import Budget, JointPath, PlanResult
from cvqmpt_lab.search.roadmap import (
    Roadmap,
    RoadmapQuery,
    RoadmapSearchSettings,
)
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace


@entry
def keep_informed(
    space: Space,
    draws: Annotated[np.ndarray, "count n"],
    start: Annotated[np.ndarray, "n"],
    goals: Annotated[np.ndarray, "goals n"],
    longest: float,
):
    """Project draws, and move the free ones in the informed set to the front, in order.

    The set is { q : |q - start| + min_g |q - g| < longest }.

    Args:
        space: the planning space.
        draws: configurations [rad or m], changed in place.
        start: (n,) [rad or m].
        goals: (k, n) [rad or m].
        longest: length of the longest path [rad].

    Returns:
        Number of draws at the front.
    """
    space = placed(space)
    kept = 0
    for i in range(draws.shape[0]):
        for j in range(draws.shape[1]):
            draws[kept, j] = draws[i, j]
        if not project_state(space, draws[kept]):
            continue
        to_go = np.inf
        for g in range(goals.shape[0]):
            to_go = min(to_go, distance(draws[kept], goals[g]))
        if distance(start, draws[kept]) + to_go < longest and posed_state_valid(space, draws[kept]):
            kept += 1
    return kept


@dataclass(frozen=True, eq=False)
class Improvement:
    """Result of `improve`."""

    budget: Budget  # seconds or iterations that were allowed
    seconds: float  # wall time used [s]
    iterations: int  # iterations used
    searches: int  # number of searches for other paths
    # of the first path and each better one: seconds after the first path, and length [rad]
    lengths: tuple[tuple[float, float], ...]

    @property
    def gained(self) -> float:
        """Relative reduction of the first path's length, 1 - c_last / c_first."""
        first = self.lengths[0][1]
        return 1.0 - self.lengths[-1][1] / first if first else 0.0


def check_units(budget: Budget, optimize: Budget) -> None:
    """Refuse an optimization budget in seconds for a run whose budget has no seconds."""
    if budget.seconds is None and optimize.seconds is not None:
        limit = f"{budget.iterations} iterations"
        if budget.iterations is None:
            limit = f"a cost of {budget.cost:g} s"
        raise InvalidInputError(
            f"optimize: {optimize.seconds:g} s in a run of {limit}, which must not depend on the "
            "clock; give optimize in iterations or as a cost, or the run a budget in seconds"
        )


def improve(
    query: Query, source: PathSource, first: JointPath, gain: float = 0.002
) -> tuple[JointPath, Improvement]:
    """Find other paths and shorten them within a budget; the best is never longer than the first.

    Args:
        query: start, goals, space, random numbers, and the budget of this optimization.
        source: finds other paths.
        first: a path on the manifold, free and shortened.
        gain: a path is shortened again while this reduces its length by more than this share.

    Returns:
        The best path, and a record of the optimization.
    """
    deadline = query.deadline
    straight = np.linalg.norm(query.goals - query.start, axis=1)
    nearest = max(float(straight.min()), SAME_STATE_RAD)
    best, lengths, searches, shortening = first, [(0.0, first.length)], 0, True
    while deadline.spent() is None:
        found: JointPath | None = best
        if not shortening:
            if nearest >= best.length:
                break  # the path is straight
            found = source(query, best, searches)
            searches += 1
        deadline.count()  # a round without iterations must use up the budget, too
        if found is None:
            continue
        found = simplify(
            query.space, found, query.rng, seconds=deadline.rest().seconds or np.inf
        ).path
        shortening = found.length < (1.0 - gain) * best.length
        if found.length < best.length:
            best = found
            lengths.append((deadline.seconds, best.length))
    return best, Improvement(
        deadline.budget, deadline.seconds, deadline.counters.iterations, searches, tuple(lengths)
    )


def restarted(
    method: Search,
    distribution: SamplingDistribution,
    query: Query,
    best: JointPath,
    number: int,
) -> JointPath | None:
    """Return a path of another search by the same method; see `PathSource`.

    Searches with even numbers draw from the first search's distribution, informed samples first;
    the others draw from informed sets.

    Args:
        method: searches.
        distribution: of the first search.
        query: start, goals and space.
        best: the shortest path so far.
        number: number of earlier calls.
    """
    start, rest = query.start, query.deadline.rest()
    if number % 2 == 0:
        goals = nearer_goals(query, best.length)
        samples: SamplingDistribution = InformedFirst(distribution, start, goals, best.length)
        most = 200  # largest number of iterations
    else:
        stretches = (1.1, 1.3, 1.6, 2.0, 2.6, np.inf)
        goals, samples = informed_samples(query, best.length, stretches[number // 2 % 6])
        most = 60
    bounded = replace(rest, iterations=min(most, rest.iterations or most))
    return method.search(query.limited(bounded, goals=goals), samples).path


def informed_roadmap_path(
    edge_costs: Callable[[ConstrainedSpace], EdgeCosts],
    query: Query,
    best: JointPath,
    number: int,
) -> JointPath | None:
    """Return a path through a small roadmap of draws from the informed set; see `PathSource`.

    Edges are checked lazily. Paths through random nodes become shorter when they are shortened, so
    paths up to twice as long as the best one are accepted. Numbers were chosen on tuning problems.

    Args:
        edge_costs: makes the edge costs in a space.
        query: start, goals and space.
        best: the shortest path so far.
        number: number of earlier calls.
    """
    space, start = query.space, query.start
    stretch = (1.6, 2.0, 1.3, 2.6, np.inf)[number % 5]
    goals, samples = informed_samples(query, best.length, stretch)
    draws = samples.sample(query.rng, 100)  # in the kitchen, half of them are free
    nodes = draws[: keep_informed.unchecked(space.arrays, draws, start, goals, best.length)]
    space.reraise()
    if len(nodes) < 2:
        return None
    costs, longest = edge_costs(space), 2.0 * best.length
    if costs.weight > 0.0:
        costs = costs._replace(weight=1.0)
    roadmap = Roadmap.of(nodes, min(20, len(nodes) - 1))
    settings = RoadmapSearchSettings(penalty=0.0, searches=20, greed=1.5)
    search = RoadmapQuery(space, roadmap, start, goals, settings, costs, longest, CHECKED_FREE)
    found = search.next_path(query.deadline)
    return found if found is not None and found.length < longest else None


def nearer_goals(query: Query, length: float) -> np.ndarray:
    """Return the goals (k, n) whose straight line from the start is shorter than `length` [rad]."""
    straight = np.linalg.norm(query.goals - query.start, axis=1)
    return query.goals[np.maximum(straight, SAME_STATE_RAD) < length]


def informed_samples(
    query: Query, length: float, stretch: float
) -> tuple[np.ndarray, "InformedSamples"]:
    """Return goals (k, n) and samples from the informed sets of paths to them.

    Args:
        query: start, goals and space.
        length: upper bound of path lengths [rad].
        stretch: upper bound of path length / straight length. If it is the smaller bound for some
            goals, the other goals are left out.
    """
    start, goals, robot = query.start, nearer_goals(query, length), query.space.robot
    straight = np.maximum(np.linalg.norm(goals - start, axis=1), SAME_STATE_RAD)
    longest = np.minimum(stretch * straight, length)
    short = longest < length
    if short.any():
        goals, longest = goals[short], longest[short]
    return goals, InformedSamples(start, goals, longest, robot.lower, robot.upper)


@dataclass(frozen=True, eq=False)
class InformedSamples:
    """Informed sampling: uniform in a prolate hyperspheroid, clipped to the joint limits.

    Its foci are the start and a random goal. With their distance c_min, the length c of the longest
    path and the unit vector e between the foci, a point x of the unit ball becomes

        q = (q_start + q_goal) / 2 + b x + (c / 2 - b) (x . e) e,   b = sqrt(c^2 - c_min^2) / 2.
    """

    start: np.ndarray  # (n,)
    goals: np.ndarray  # (k, n)
    longest: np.ndarray  # (k,) c, length of the longest path to each goal [rad]
    lower: np.ndarray  # (n,)
    upper: np.ndarray  # (n,)
    name: str = "informed"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        n, k = len(self.start), len(self.goals)
        to = rng.integers(k, size=count) if k > 1 else np.zeros(count, dtype=int)
        along = (self.goals - self.start)[to]
        straight = np.sqrt((along**2).sum(axis=1, keepdims=True))
        ball = rng.normal(size=(count, n))
        ball *= rng.random((count, 1)) ** (1.0 / n) / np.sqrt((ball**2).sum(axis=1, keepdims=True))
        length, axis = self.longest[to, None], along / np.maximum(straight, SAME_STATE_RAD)
        across = 0.5 * np.sqrt(np.maximum(length**2 - straight**2, 0.0))
        onwards = (0.5 * length - across) * (ball * axis).sum(axis=1, keepdims=True)
        middle = self.start + 0.5 * along
        return np.clip(middle + across * ball + onwards * axis, self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class InformedFirst:
    """Samples of another distribution; samples in the informed set come first."""

    base: SamplingDistribution
    start: np.ndarray  # (n,) [rad or m]
    goals: np.ndarray  # (k, n) [rad or m]
    length: float  # of the best path so far [rad]
    crowd: int = 4  # number of draws for each sample

    @property
    def name(self) -> str:
        """Name of the other distribution, for result rows."""
        return self.base.name

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        drawn = self.base.sample(rng, self.crowd * count)
        to_goal = np.linalg.norm(drawn[:, None] - self.goals, axis=2).min(axis=1)
        too_long = np.linalg.norm(drawn - self.start, axis=1) + to_goal > self.length
        return drawn[np.argsort(too_long, kind="stable")[:count]]


def unconstrained_path(query: Query) -> tuple[JointPath | None, PlanResult]:
    """Return a shortened path of a query without its constraint, or None; and the search result."""
    return short_path(query.space.unconstrained(), query, query.deadline.budget)


def short_path(
    space: ConstrainedSpace, query: Query, budget: Budget
) -> tuple[JointPath | None, PlanResult]:
    """Return a shortened path from a query's start to a goal, or None; and the search result."""
    found = BiRRT().search(query.limited(budget, space=space), query.uniform)
    return None if found.path is None else simplify(space, found.path, query.rng).path, found


@dataclass(frozen=True)
class NearShortestSettings:
    """Limits of the work of `near_shortest`."""

    restarts: int = 12  # number of searches after the first path
    first: int = 1500  # iterations of the first search, made at most twice
    later: int = 200  # iterations of each restart
    finish: int = 512  # number of shortcuts that are tried on the best path at the end


def near_shortest(
    space: ConstrainedSpace,
    start: np.ndarray,
    goal: np.ndarray,
    rng: np.random.Generator,
    settings: NearShortestSettings | None = None,
) -> JointPath | None:
    """Return the shortest free path on the manifold that is found from start to goal, or None.

    Args:
        space: the planning space.
        start: (n,) [rad or m].
        goal: (n,) [rad or m].
        rng: random number generator.
        settings: limits of the work; None: the defaults.
    """
    settings = settings or NearShortestSettings()
    lower, upper = space.robot.lower, space.robot.upper
    best: JointPath | None = None
    tries = 0
    while tries < (settings.restarts + 1 if best else 2):
        tries += 1
        sampler: SamplingDistribution = Uniform(lower, upper)
        if best is not None:
            sampler = InformedSamples(start, goal[None], np.array([best.length]), lower, upper)
        budget = Budget(iterations=settings.later if best else settings.first)
        query = Query.of(space, start, goal[None], budget, rng)
        path = BiRRT().search(query, sampler).path
        if path is not None:
            path = simplify(space, path, rng).path
            best = path if best is None or path.length < best.length else best
        if best is not None and best.length < (1.0 + 1e-6) * np.linalg.norm(goal - start):
            return best  # the straight line
    if best is None:
        return None
    return simplify(space, best, rng, settings.finish, patience=8).path
