"""The planner interface: query, sampling distribution, proposal, stages, and the search for a path.

A planner has up to four stages: `observe` a scene, `predict` a sampling distribution, `update` it
towards the constraint (paper, Algorithm 2), and `search` a path (paper, Algorithm 3).
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.motion import ITERATIONS
from cvqmpt_lab.search.result import (
    Budget,
    Counters,
    JointPath,
    PlanResult,
    PlanStatus,
    Timings,
    Tree,
)
from cvqmpt_lab.search.space import ConstrainedSpace


class SamplingDistribution(Protocol):
    """A distribution of configurations."""

    @property
    def name(self) -> str:
        """Name in result rows."""

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n) [rad or m]."""


@runtime_checkable
class DrawsOfTrees(Protocol):
    """A distribution with draws of its own for each of two trees."""

    def of_tree(self, tree: int) -> SamplingDistribution:
        """Return the distribution of the tree from the start (0) or from the goal (1)."""


@dataclass(frozen=True, eq=False)
class Uniform:
    """Uniform distribution between the joint limits."""

    lower: np.ndarray  # (n,) [rad or m]
    upper: np.ndarray  # (n,) [rad or m]
    name: str = "uniform"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        return rng.uniform(self.lower, self.upper, (count, len(self.lower)))


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """Mixture of Gaussians and, optionally, a uniform distribution U (paper, eqn. sample_dist).

    p(q) = (1 - u) sum_i w_i N(q; mu_i, Sigma_i) + u U(q), with the uniform share u.
    """

    means: np.ndarray  # (k, n) [rad or m]
    covariances: np.ndarray  # (k, n, n) [rad^2]
    weights: np.ndarray  # (k,), summing to 1
    uniform: Uniform | None = None
    # u in [0, 1]; with 0, a planner is not probabilistically complete
    uniform_share: float = 0.0
    name: str = "gaussian-mixture"

    @classmethod
    def equal(
        cls,
        means: np.ndarray,
        covariances: np.ndarray,
        uniform: Uniform,
        uniform_share: float,
        name: str,
    ) -> "GaussianMixture | Uniform":
        """Return a mixture of Gaussians of equal weight; the uniform distribution if k is 0.

        Args:
            means: (k, n) [rad or m].
            covariances: (k, n, n) [rad^2], or one (n, n) for all means.
            uniform: distribution U.
            uniform_share: its share u in [0, 1].
            name: name in result rows.
        """
        k = len(means)
        if k == 0:
            return replace(uniform, name=f"{name}: uniform")
        covariances = np.broadcast_to(covariances, (k, *np.shape(covariances)[-2:]))
        return cls(means, covariances, np.full(k, 1.0 / k), uniform, uniform_share, name)

    def __post_init__(self) -> None:
        k, n = self.means.shape
        if self.covariances.shape != (k, n, n) or self.weights.shape != (k,):
            raise InvalidInputError(
                f"mixture of {k} means of {n} joints: covariances {self.covariances.shape} must be "
                f"({k}, {n}, {n}), weights {self.weights.shape} must be ({k},)"
            )
        if not np.isclose(self.weights.sum(), 1.0) or (self.weights < 0).any():
            raise InvalidInputError(
                f"mixture weights must be non-negative and sum to 1, not {self.weights.sum()}"
            )
        if not np.isfinite(self.means).all():
            raise InvalidInputError("mixture means must be finite")
        if (
            not np.isfinite(self.covariances).all()
            or (np.linalg.eigvalsh(self.covariances) <= 0).any()
        ):
            raise InvalidInputError("mixture covariances must be positive definite")
        if not 0.0 <= self.uniform_share <= 1.0 or (
            self.uniform_share > 0 and self.uniform is None
        ):
            raise InvalidInputError(
                f"uniform share {self.uniform_share}: give 0 to 1, with a uniform distribution"
            )

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw q = mu_i + L_i eps (count, n), Sigma_i = L_i L_i^T; q may be outside the limits."""
        component = rng.choice(len(self.weights), count, p=self.weights)
        noise = rng.standard_normal((count, self.means.shape[1]))
        factors = np.linalg.cholesky(self.covariances)
        draws = self.means[component] + np.einsum("kij,kj->ki", factors[component], noise)
        if self.uniform is not None and self.uniform_share > 0:
            elsewhere = rng.random(count) < self.uniform_share
            draws[elsewhere] = self.uniform.sample(rng, int(elsewhere.sum()))
        return draws


def widened(covariances: np.ndarray, std: float) -> np.ndarray:
    """Return V max(Lambda, std^2) V^T (c, n, n) of covariances V Lambda V^T [rad^2]."""
    values, vectors = np.linalg.eigh(covariances)
    narrow = values[:, 0] < std * std
    if not narrow.any():
        return covariances
    values, vectors = np.maximum(values[narrow], std * std), vectors[narrow]
    result = covariances.copy()
    result[narrow] = (vectors * values[:, None, :]) @ vectors.swapaxes(1, 2)
    return result


class Deadline:
    """A budget whose time starts when this object is made; the space counts its iterations."""

    def __init__(self, budget: Budget, space: ConstrainedSpace) -> None:
        self.budget, self._space = budget, space
        self._began = time.perf_counter()
        # value of time.perf_counter() at which no seconds are left [s]
        self.clock = self._began + (np.inf if budget.seconds is None else budget.seconds)
        self._counters = space.counters

    @property
    def seconds(self) -> float:
        """Wall time used so far [s]."""
        return time.perf_counter() - self._began

    @property
    def counters(self) -> Counters:
        """Work done so far."""
        return self._space.counters_since(self._counters)

    @property
    def iterations_left(self) -> float:
        """Number of iterations that are left; inf: no limit."""
        limit = self.budget.iterations
        return np.inf if limit is None else limit - self.counters.iterations

    @property
    def late(self) -> bool:
        """Whether no seconds or no cost are left, or the search was asked to end."""
        if self._space.stopped or time.perf_counter() >= self.clock:
            return True
        cost = self.budget.cost
        return cost is not None and self.counters.cost(self.budget.prices) >= cost

    def count(self, iterations: int = 1) -> None:
        """Count iterations that no search counts."""
        self._space.arrays.counters[ITERATIONS] += iterations

    def spent(self) -> PlanStatus | None:
        """Return the status of a run without any budget left; None if budget is left."""
        seconds, iterations = self.budget.seconds, self.budget.iterations
        if seconds is not None and self.seconds >= seconds:
            return PlanStatus.TIMEOUT
        if iterations is not None and self.counters.iterations >= iterations:
            return PlanStatus.ITERATION_LIMIT
        return PlanStatus.COST_LIMIT if self.late else None

    def rest(self, share: float = 1.0) -> Budget:
        """Return a share of the whole budget, at most what is left of it; call `spent` first."""
        seconds, iterations, cost = self.budget.seconds, self.budget.iterations, self.budget.cost
        if seconds is not None:
            # `Budget` refuses 0 seconds
            seconds = max(min(share * seconds, seconds - self.seconds), 1e-3)
        if iterations is not None:
            left = iterations - self.counters.iterations
            iterations = max(min(math.ceil(share * iterations), left), 1)
        if cost is not None:
            cost = max(min(share * cost, cost - self.counters.cost(self.budget.prices)), 1e-9)
        return replace(self.budget, seconds=seconds, iterations=iterations, cost=cost)

    def result(
        self, path: JointPath | None, trees: tuple[Tree, Tree], sampler: str, detail: str = ""
    ) -> PlanResult:
        """Return the result of a tree search that ends now.

        Args:
            path: path that was found; None: the budget is used up.
            trees: from the start and from the goals.
            sampler: name of the sampling distribution.
            detail: see `PlanResult.detail`.
        """
        failed = self.spent() or PlanStatus.ITERATION_LIMIT
        return PlanResult(
            status=PlanStatus.SOLVED if path is not None else failed,
            path=path,
            seconds=self.seconds,
            counters=self.counters,
            vertices=sum(len(tree.nodes) for tree in trees),
            sampler=sampler,
            detail=detail,
            trees=trees,
            roots=sum(int((tree.parent < 0).sum()) for tree in trees),
        )


@dataclass(frozen=True, eq=False)
class Query:
    """One planning query: start, goals, space, budget and random numbers."""

    space: ConstrainedSpace
    start: np.ndarray  # (n,) [rad or m]
    goals: np.ndarray  # (k, n) [rad or m]; a path must reach one of them
    deadline: Deadline  # shared by prediction and search; its time starts with the query
    rng: np.random.Generator
    seed: int = 0  # seed of `rng`, for planners with another random number generator
    share: float = 1.0  # share of the budget for one search
    limit: Budget | None = None  # of one search; None: the share of the budget

    @classmethod
    def of(
        cls,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        budget: Budget,
        rng: np.random.Generator,
        seed: int = 0,
    ) -> "Query":
        """Return a query whose time starts now.

        Args:
            space: the planning space.
            start: (n,) [rad or m].
            goals: (k, n) [rad or m].
            budget: budget of prediction and search.
            rng: random number generator.
            seed: seed of `rng`.
        """
        return cls(space, start, goals, Deadline(budget, space), rng, seed)

    def limited(self, budget: Budget, **changes: Any) -> "Query":
        """Return this query with a new budget, whose time starts now, and with changed fields."""
        changed = replace(self, **changes)
        return replace(changed, deadline=Deadline(budget, changed.space))

    def one_by_one(self, limit: Budget | None = None) -> list["Query"]:
        """Return a query for each goal, with a limit or an equal share of the budget."""
        share = 1.0 if limit is not None else 1.0 / len(self.goals)
        return [replace(self, goals=goal[None], share=share, limit=limit) for goal in self.goals]

    @property
    def uniform(self) -> Uniform:
        """Uniform distribution between the robot's limits."""
        return Uniform(self.space.robot.lower, self.space.robot.upper)

    def nearest_goals(self, count: int) -> np.ndarray:
        """Return the `count` goals (count, n) nearest to the start, nearest first."""
        distances = np.linalg.norm(self.goals - self.start, axis=1)
        return self.goals[np.argsort(distances, kind="stable")[:count]]


@dataclass(frozen=True, eq=False)
class Observation:
    """Sensor data for a planner."""

    # point cloud (m, 3) [m, robot base frame]; None for planners without sensing
    cloud: np.ndarray | None = None
    # False: results computed from the cloud earlier are computed again, and their time counts
    use_cache: bool = True


@dataclass(frozen=True, eq=False)
class Proposal:
    """Output of the prediction stage: a sampling distribution, or a path."""

    distribution: SamplingDistribution
    timings: Timings = field(default_factory=Timings)
    detail: str = ""  # short remark for the result row
    fallback: str = ""  # another method than the planner's name says, and the reason; or ""
    vertices: int = 0  # number of nodes of searches during the prediction
    path: JointPath | None = None  # on the manifold and free; no search follows
    failure: PlanStatus | None = None  # status of a prediction after which no search can succeed
    as_is: bool = False  # see `PlanResult.as_is`
    counters: Counters = field(default_factory=Counters)  # work of an external planner


def uniform(query: Query, observation: Observation) -> Proposal:
    """Propose the uniform distribution between the joint limits."""
    return Proposal(query.uniform)


class Search(Protocol):
    """A search for a path on the constraint manifold."""

    def search(self, query: Query, distribution: SamplingDistribution) -> PlanResult:
        """Search a path from the query's start to any of its goals with drawn samples."""


# Returns a free path on the manifold, which may become shorter than the best path after shortening,
# or None. Arguments: query, best path, number of earlier calls. It is called as long as the
# straight line to a goal is shorter than the best path.
PathSource: TypeAlias = Callable[[Query, JointPath, int], JointPath | None]


@dataclass(frozen=True, eq=False)
class Stages:
    """Stages of a planner for problems of one robot."""

    predict: Callable[[Query, Observation], Proposal] = uniform
    search: Search | None = None  # None: `BiRRT`
    # returns a point cloud (m, 3) [m, base frame]; None: the planner needs no cloud
    observe: Callable[[Scene], np.ndarray] | None = None
    # moves a proposal towards the constraint (paper, Algorithm 2)
    update: Callable[[Query, Proposal], Proposal] | None = None
    # finds other paths for an optimization; None: restarts of the search
    path_source: PathSource | None = None
    # whether goals are tried one after the other, with a separate prediction for each
    goals_apart: bool = False
    # limits of the searches for each of these goals: all goals are tried with the first one, then
    # all again with the second one, and so on; empty, or without a constraint: an equal share of
    # the budget
    goal_limits: tuple[Budget, ...] = ()
    # returns the goals (k, n) in the order in which they are tried, and the time that this took
    rank_goals: Callable[[Query, Observation], tuple[np.ndarray, Timings]] | None = None


def search(
    method: Search, query: Query, proposal: Proposal, near: int = 0, near_share: float = 0.25
) -> PlanResult:
    """Search from a proposal with the rest of the budget.

    The result contains time and work of both prediction and search.

    Args:
        method: the search.
        query: start, goals and budget.
        proposal: sampling distribution or path.
        near: number of nearest goals that are searched first; 0: all goals are searched at once.
        near_share: share of the budget for the nearest goals.
    """
    deadline, sampler = query.deadline, proposal.distribution.name
    if proposal.path is not None:
        result = PlanResult(PlanStatus.SOLVED, proposal.path, 0.0, Counters(), 0, sampler)
    elif (status := proposal.failure or deadline.spent()) is not None:
        result = PlanResult(status, None, 0.0, Counters(), 0, sampler)
    else:
        vertices = roots = 0
        parts = [(query.goals, 1.0)]  # goals, and share of the budget
        if 0 < near < len(query.goals):
            parts.insert(0, (query.nearest_goals(near), near_share))
        for goals, share in parts:
            budget = deadline.rest(share * query.share)
            if query.limit is not None:
                budget = budget.within(query.limit)
            part = query.limited(budget, goals=goals)
            result = method.search(part, proposal.distribution)
            vertices += result.vertices
            roots += result.roots
            if result.path is not None or deadline.spent() is not None:
                break
        result = replace(result, vertices=vertices, roots=roots)
    return replace(
        result,
        seconds=deadline.seconds,
        counters=deadline.counters + proposal.counters,
        vertices=proposal.vertices + result.vertices,
        timings=proposal.timings,
        detail="; ".join(filter(None, (proposal.detail, result.detail))),
        fallback=proposal.fallback or result.fallback,
        as_is=proposal.as_is,
    )
