"""The planner interface: query, sampling distribution, proposal, stages, and the search for a path.

A planner is up to four stages: `observe` a scene, `predict` where to sample, `update` that towards
the constraint (paper, Algorithm 2), `search` (paper, Algorithm 3).
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeAlias

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
    """Anything that draws configurations."""

    @property
    def name(self) -> str:
        """Its name in result rows."""

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n) [rad or m]."""


@dataclass(frozen=True, eq=False)
class Uniform:
    """Uniform between the joint limits."""

    lower: np.ndarray  # (n,) [rad or m]
    upper: np.ndarray  # (n,) [rad or m]
    name: str = "uniform"

    def sample(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw configurations (count, n)."""
        return rng.uniform(self.lower, self.upper, (count, len(self.lower)))


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """Gaussians, optionally mixed with a uniform distribution U (paper, eqn. sample_dist).

    p(q) = (1 - u) sum_i w_i N(q; mu_i, Sigma_i) + u U(q), with the uniform share u.
    """

    means: np.ndarray  # (k, n) [rad or m]
    covariances: np.ndarray  # (k, n, n) [rad^2]
    weights: np.ndarray  # (k,), summing to 1
    uniform: Uniform | None = None  # distribution mixed in
    # its share in [0, 1]; at 0 a planner is not probabilistically complete
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
        """Gaussians of equal weight and a uniform share; uniform alone when there are none.

        Args:
            means: (k, n) [rad or m].
            covariances: (k, n, n), or one (n, n) for all means.
            uniform: distribution mixed in.
            uniform_share: its share in [0, 1].
            name: for result rows.
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
                f"mixture of {k} means in {n} joints: covariances {self.covariances.shape}, "
                f"weights {self.weights.shape}"
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
        """Draw q = mu_i + L_i eps (count, n), Sigma_i = L_i L_i^T; draws may leave the limits."""
        component = rng.choice(len(self.weights), count, p=self.weights)
        noise = rng.standard_normal((count, self.means.shape[1]))
        factors = np.linalg.cholesky(self.covariances)
        draws = self.means[component] + np.einsum("kij,kj->ki", factors[component], noise)
        if self.uniform is not None and self.uniform_share > 0:
            elsewhere = rng.random(count) < self.uniform_share
            draws[elsewhere] = self.uniform.sample(rng, int(elsewhere.sum()))
        return draws


def widened(covariances: np.ndarray, std: float) -> np.ndarray:
    """V max(Lambda, std^2) V^T (c, n, n) of covariances V Lambda V^T."""
    values, vectors = np.linalg.eigh(covariances)
    narrow = values[:, 0] < std * std
    if not narrow.any():
        return covariances
    values, vectors = np.maximum(values[narrow], std * std), vectors[narrow]
    result = covariances.copy()
    result[narrow] = (vectors * values[:, None, :]) @ vectors.swapaxes(1, 2)
    return result


class Deadline:
    """A budget whose clock runs since this object was made; the space counts its iterations."""

    def __init__(self, budget: Budget, space: ConstrainedSpace) -> None:
        self.budget, self._space = budget, space
        self._began = time.perf_counter()
        # [s] of time.perf_counter(), when seconds are spent
        self.clock = self._began + (np.inf if budget.seconds is None else budget.seconds)
        self._counters = space.counters

    @property
    def seconds(self) -> float:
        """Used so far [s]."""
        return time.perf_counter() - self._began

    @property
    def counters(self) -> Counters:
        """Work done so far."""
        return self._space.counters_since(self._counters)

    def count(self, iterations: int = 1) -> None:
        """Use iterations that no search counts."""
        self._space.arrays.counters[ITERATIONS] += iterations

    def spent(self) -> PlanStatus | None:
        """The status of a run that has used up its budget; None while something is left."""
        seconds, iterations = self.budget.seconds, self.budget.iterations
        if seconds is not None and self.seconds >= seconds:
            return PlanStatus.TIMEOUT
        if iterations is not None and self.counters.iterations >= iterations:
            return PlanStatus.ITERATION_LIMIT
        return None

    def rest(self, share: float = 1.0) -> Budget:
        """A share of the whole budget, or what is left if less; call `spent` first."""
        seconds, iterations = self.budget.seconds, self.budget.iterations
        if seconds is not None:
            # a budget of zero seconds is none
            seconds = max(min(share * seconds, seconds - self.seconds), 1e-3)
        if iterations is not None:
            left = iterations - self.counters.iterations
            iterations = max(min(math.ceil(share * iterations), left), 1)
        return Budget(seconds, iterations)

    def result(
        self, path: JointPath | None, trees: tuple[Tree, Tree], sampler: str, detail: str = ""
    ) -> PlanResult:
        """The result of a search by trees that ends now, for one of the budget's two reasons."""
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
        )


@dataclass(frozen=True, eq=False)
class Query:
    """What is planned: start, goals, space, budget and random numbers."""

    space: ConstrainedSpace
    start: np.ndarray  # (n,) [rad or m]
    goals: np.ndarray  # (k, n) [rad or m]; any one will do
    deadline: Deadline  # shared by prediction and search; its clock runs since the query was made
    rng: np.random.Generator
    seed: int = 0  # that `rng` came from, for planners with random numbers of their own
    share: float = 1.0  # of the budget, for one search

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
        """A query whose clock starts now.

        Args:
            space: the planning space.
            start: (n,) [rad or m].
            goals: (k, n) [rad or m].
            budget: of prediction and search.
            rng: random numbers.
            seed: that `rng` came from.
        """
        return cls(space, start, goals, Deadline(budget, space), rng, seed)

    def one_by_one(self) -> list["Query"]:
        """A query for each goal, each with an equal share of the budget."""
        share = 1.0 / len(self.goals)
        return [replace(self, goals=goal[None], share=share) for goal in self.goals]

    @property
    def uniform(self) -> Uniform:
        """Between the robot's limits."""
        return Uniform(self.space.robot.lower, self.space.robot.upper)

    def nearest_goals(self, count: int) -> np.ndarray:
        """The goals (at most count, n) nearest to the start, nearest first."""
        distances = np.linalg.norm(self.goals - self.start, axis=1)
        return self.goals[np.argsort(distances, kind="stable")[:count]]


@dataclass(frozen=True, eq=False)
class Observation:
    """What a planner has seen of the world."""

    # (m, 3) [m, robot base frame]; None for planners without sensing
    cloud: np.ndarray | None = None
    # False: whatever is computed from the cloud is computed again, and charged
    use_cache: bool = True


@dataclass(frozen=True, eq=False)
class Proposal:
    """What a search starts from: where to sample, or a path at once."""

    distribution: SamplingDistribution
    timings: Timings = field(default_factory=Timings)
    detail: str = ""  # a few words about it for the result's row
    fallback: str = ""  # why this is not what the planner's name promises, or ""
    vertices: int = 0  # nodes of searches made on the way
    # on the manifold and free: nothing is searched
    path: JointPath | None = None
    failure: PlanStatus | None = None  # why searching is pointless, or None
    as_is: bool = False  # of an external planner, see `PlanResult.as_is`


def uniform(query: Query, observation: Observation) -> Proposal:
    """Sample anywhere between the joint limits."""
    return Proposal(query.uniform)


class Search(Protocol):
    """A search for a path on the constraint manifold."""

    def search(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        distribution: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n) [rad or m]."""


# A free path on the manifold that shortening may make shorter than the best one known, or None, of
# (query, best path, number of calls before this one). Called while the straight line to a goal is
# shorter than the best path.
PathSource: TypeAlias = Callable[[Query, JointPath, int], JointPath | None]


@dataclass(frozen=True, eq=False)
class Stages:
    """The stages of a planner for one robot's problems."""

    predict: Callable[[Query, Observation], Proposal] = uniform
    search: Search | None = None  # None: `BiRRT`
    # the cloud (m, 3) [m, base frame]; None: it needs none
    observe: Callable[[Scene], np.ndarray] | None = None
    # towards the constraint (paper, Algorithm 2)
    update: Callable[[Query, Proposal], Proposal] | None = None
    # of shorter paths once there is one; None: restarts of the search
    path_source: PathSource | None = None
    # whether goals are tried one after the other, each with a prediction of its own
    goals_apart: bool = False


def search(
    method: Search, query: Query, proposal: Proposal, near: int = 0, near_share: float = 0.25
) -> PlanResult:
    """Search from a proposal with the rest of the budget; time and work of both are added up.

    near: so many nearest goals are tried alone first, for near_share of the budget; 0: none are.
    """
    deadline, sampler = query.deadline, proposal.distribution.name
    if proposal.path is not None:
        result = PlanResult(PlanStatus.SOLVED, proposal.path, 0.0, Counters(), 0, sampler)
    elif (status := proposal.failure or deadline.spent()) is not None:
        result = PlanResult(status, None, 0.0, Counters(), 0, sampler)
    else:
        vertices, shares = 0, ((near, near_share),) if 0 < near < len(query.goals) else ()
        for count, share in (*shares, (len(query.goals), 1.0)):
            goals = query.goals if share == 1.0 else query.nearest_goals(count)
            result = method.search(
                query.space,
                query.start,
                goals,
                proposal.distribution,
                deadline.rest(share * query.share),
                query.rng,
            )
            vertices += result.vertices
            if result.path is not None or deadline.spent() is not None:
                break
        result = replace(result, vertices=vertices)
    return replace(
        result,
        seconds=deadline.seconds,
        counters=deadline.counters,
        vertices=proposal.vertices + result.vertices,
        timings=proposal.timings,
        detail="; ".join(filter(None, (proposal.detail, result.detail))),
        fallback=proposal.fallback or result.fallback,
        as_is=proposal.as_is,
    )
