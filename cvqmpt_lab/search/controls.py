"""Controls of learned distributions: Gaussians around paths that need no network."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.planner_interface import (
    GaussianMixture,
    Observation,
    Proposal,
    Query,
    SamplingDistribution,
)
from cvqmpt_lab.search.result import JointPath, PlanResult
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace


@dataclass(frozen=True)
class AroundPath:
    """Gaussians of equal weight at waypoints along paths, and a uniform share."""

    name: str
    std: float = 0.5  # [rad] of each Gaussian, in every joint
    uniform_share: float = 0.15
    spacing: float = 0.5  # [rad] between waypoints along a path
    lines: int = 3  # of `straight_line`, to the nearest goals
    tries: int = 6  # of `solved_paths`, of which the shortest path is taken

    def mixture(self, query: Query, *paths: JointPath) -> SamplingDistribution:
        """The distribution around paths."""
        means = np.concatenate([path.spaced(self.spacing) for path in paths])
        covariance = self.std**2 * np.eye(means.shape[1])
        return GaussianMixture.equal(
            means, covariance, query.uniform, self.uniform_share, self.name
        )

    def straight_line(self, query: Query, observation: Observation) -> Proposal:
        """Gaussians along the straight lines to the nearest goals; nothing is checked."""
        goals = query.nearest_goals(self.lines)
        lines = [JointPath(np.stack([query.start, goal])) for goal in goals]
        return Proposal(self.mixture(query, *lines))

    def solved_paths(self, query: Query, observation: Observation) -> Proposal:
        """Gaussians around the shortest of several solutions of the problem: a bound of mixtures.

        Uniform samples if no path is found. Finding the paths counts as time, not as work.
        """
        aside, best = ConstrainedSpace(query.space.problem, query.space.backend), None
        for _ in range(self.tries):
            if query.deadline.spent():
                break
            budget = query.deadline.rest()
            found = BiRRT().search(
                aside, query.start, query.goals, query.uniform, budget, query.rng
            )
            if found.path is not None:
                shorter = simplify(aside, found.path, query.rng).path
                if best is None or shorter.length < best.length:
                    best = shorter
        return Proposal(query.uniform if best is None else self.mixture(query, best))

    def unconstrained(self, query: Query, observation: Observation) -> Proposal:
        """Gaussians around an unconstrained path, whose planning is counted."""
        path, found = unconstrained_path(query)
        if path is not None:
            return Proposal(self.mixture(query, path), vertices=found.vertices)
        return Proposal(
            query.uniform,
            detail="no unconstrained path",
            vertices=found.vertices,
            failure=found.status,
        )


def unconstrained_path(query: Query) -> tuple[JointPath | None, PlanResult]:
    """A shortened path of a query without its constraint, or None; and the search for it."""
    free = query.space.unconstrained()
    found = BiRRT().search(
        free, query.start, query.goals, query.uniform, query.deadline.budget, query.rng
    )
    return None if found.path is None else simplify(free, found.path, query.rng).path, found
