"""The parts of a planner: what it observes, proposes and searches for, and with how much of a budget left."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution, Uniform
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.result import Budget, Counters, JointPath, PlanResult, PlanStatus, Timings
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.search.space_arrays import ITERATIONS

LEAST_SECONDS = 1e-3


class Deadline:
    """A budget in use since this object was made; iterations are read from the space's counters."""

    def __init__(self, budget: Budget, space: ConstrainedSpace) -> None:
        self.budget, self._space = budget, space
        self._began = time.perf_counter()
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
        """How the run ends if nothing is left; None while something is."""
        if self.budget.seconds is not None and self.seconds >= self.budget.seconds:
            return PlanStatus.TIMEOUT
        if self.budget.iterations is not None and self.counters.iterations >= self.budget.iterations:
            return PlanStatus.ITERATION_LIMIT
        return None

    def rest(self, share: float = 1.0) -> Budget:
        """A share of the whole budget, or what is left if that is less; ask `spent` first."""
        seconds, iterations = self.budget.seconds, self.budget.iterations
        if seconds is not None:
            seconds = max(min(share * seconds, seconds - self.seconds), LEAST_SECONDS)
        if iterations is not None:
            left = iterations - self.counters.iterations
            iterations = max(min(math.ceil(share * iterations), left), 1)
        return Budget(seconds, iterations)


@dataclass(frozen=True, eq=False)
class Query:
    """From where to where, in which space, within which budget and with which random numbers."""

    space: ConstrainedSpace
    start: np.ndarray  # (n,) [rad or m]
    goals: np.ndarray  # (k, n) [rad or m]; any one will do
    deadline: Deadline  # shared by prediction and search; its clock runs since the query was made
    rng: np.random.Generator

    @classmethod
    def of(cls, space: ConstrainedSpace, budget: Budget, rng: np.random.Generator) -> "Query":
        """The question that a space's problem asks; the clock starts now."""
        return cls(space, space.problem.start, space.problem.goals, Deadline(budget, space), rng)

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

    cloud: np.ndarray | None = None  # (m, 3) [m, robot base frame]; None for planners without sensing
    seconds: float = 0.0  # of rendering or reading the cloud; charged to nobody
    use_cache: bool = True  # False: whatever is computed from the cloud is computed again, and charged


@dataclass(frozen=True, eq=False)
class Proposal:
    """What a search starts from: where to sample, or a path at once."""

    distribution: SamplingDistribution
    timings: Timings = field(default_factory=Timings)
    detail: str = ""  # a few words about it for the result's row
    fallback: str = ""  # why this is not what the planner's name promises, or ""
    vertices: int = 0  # nodes of searches made on the way
    path: JointPath | None = None  # on the manifold and free; the search then has nothing left to do
    failure: PlanStatus | None = None  # why searching is pointless, or None


Proposer = Callable[[Query, Observation], Proposal]


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


Observe = Callable[[Scene], np.ndarray]  # gives the cloud (m, 3) [m, robot base frame] of a scene


@dataclass(frozen=True, eq=False)
class Stages:
    """What a planner does with one robot's problems, stage by stage."""

    predict: Proposer = uniform
    search: Search = field(default_factory=BiRRT)
    observe: Observe | None = None  # None: it needs no cloud
    update: Callable[[Query, Proposal], Proposal] | None = None  # towards the constraint (paper, Algorithm 2)


def search(method: Search, query: Query, proposal: Proposal) -> PlanResult:
    """Search where a proposal says, with what is left of the budget; time and work of both are added up."""
    deadline, sampler = query.deadline, proposal.distribution.name
    if proposal.path is not None:
        result = PlanResult(PlanStatus.SOLVED, proposal.path, 0.0, Counters(), 0, sampler)
    elif (status := proposal.failure or deadline.spent()) is not None:
        result = PlanResult(status, None, 0.0, Counters(), 0, sampler)
    else:
        result = method.search(
            query.space, query.start, query.goals, proposal.distribution, deadline.rest(), query.rng
        )
    return replace(
        result,
        seconds=deadline.seconds,
        counters=deadline.counters,
        vertices=proposal.vertices + result.vertices,
        timings=proposal.timings,
        detail="; ".join(filter(None, (proposal.detail, result.detail))),
        fallback=proposal.fallback,
    )
