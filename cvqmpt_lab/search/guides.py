"""Proposals that need no network, the controls of learned ones: straight lines, unconstrained or solved paths."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.query import GaussianMixture, Observation, Proposal, Query, SamplingDistribution
from cvqmpt_lab.search.result import JointPath, PlanResult
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace


@dataclass(frozen=True)
class AroundPath:
    """Equal Gaussians at waypoints along paths, and a uniform share."""

    name: str
    std: float = 0.5  # [rad] of each Gaussian, in every joint
    uniform_share: float = 0.15
    spacing: float = 0.5  # [rad] between waypoints along a path

    def mixture(self, query: Query, *paths: JointPath) -> SamplingDistribution:
        """The distribution around paths."""
        means = np.concatenate([path.spaced(self.spacing) for path in paths])
        covariance = self.std**2 * np.eye(means.shape[1])
        return GaussianMixture.equal(means, covariance, query.uniform, self.uniform_share, self.name)


@dataclass(frozen=True)
class StraightLine:
    """Gaussians along the straight lines to the goals nearest to the start; nothing is checked."""

    around: AroundPath
    goals: int = 3  # of the nearest

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Propose."""
        lines = [JointPath(np.stack([query.start, goal])) for goal in query.nearest_goals(self.goals)]
        return Proposal(self.around.mixture(query, *lines))


@dataclass(frozen=True)
class SolvedPaths:
    """Around the shortest of several paths that solve the very problem, found beforehand: the bound of all mixtures.

    The work of finding them is not counted, their time is.
    """

    around: AroundPath
    paths: int = 6

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Solve with uniform samples, shorten, propose; uniform samples where nothing is found."""
        aside, best = ConstrainedSpace(query.space.problem, query.space.backend), None
        for _ in range(self.paths):
            if query.deadline.spent():
                break
            budget = query.deadline.rest()
            path = BiRRT().search(aside, query.start, query.goals, query.uniform, budget, query.rng).path
            shorter = None if path is None else simplify(aside, path, query.rng).path
            if shorter is not None and (best is None or shorter.length < best.length):
                best = shorter
        return Proposal(query.uniform if best is None else self.around.mixture(query, best))


@dataclass(frozen=True)
class UnconstrainedPath:
    """What an unconstrained path suggests, which is planned and paid for first."""

    around: AroundPath

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Plan without the constraint, shorten, propose."""
        path, found = unconstrained_path(query)
        if path is None:
            detail = "no unconstrained path"
            return Proposal(query.uniform, detail=detail, vertices=found.vertices, failure=found.status)
        return Proposal(self.around.mixture(query, path), vertices=found.vertices)


def unconstrained_path(query: Query) -> tuple[JointPath | None, PlanResult]:
    """A path of a query without its constraint, shortened, or None; and the search that found it."""
    free = query.space.unconstrained()
    found = BiRRT().search(free, query.start, query.goals, query.uniform, query.deadline.budget, query.rng)
    return None if found.path is None else simplify(free, found.path, query.rng).path, found
