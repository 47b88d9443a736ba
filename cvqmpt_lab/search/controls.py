"""Proposals that need no network, the controls of learned ones:
straight lines, unconstrained or solved paths.
"""

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

LINES = 3  # to the nearest goals
SOLVED_PATHS = 6  # of which the shortest is taken


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
        return GaussianMixture.equal(
            means, covariance, query.uniform, self.uniform_share, self.name
        )


def straight_line(around: AroundPath, query: Query, observation: Observation) -> Proposal:
    """Gaussians along the straight lines to the goals nearest to the start; nothing is checked."""
    lines = [JointPath(np.stack([query.start, goal])) for goal in query.nearest_goals(LINES)]
    return Proposal(around.mixture(query, *lines))


def solved_paths(around: AroundPath, query: Query, observation: Observation) -> Proposal:
    """Around the shortest of several paths that solve the very problem, found beforehand: the bound
    of all mixtures.

    Uniform samples where no path is found. The work of finding them is not counted, their time is.
    """
    aside, best = ConstrainedSpace(query.space.problem, query.space.backend), None
    for _ in range(SOLVED_PATHS):
        if query.deadline.spent():
            break
        budget = query.deadline.rest()
        path = (
            BiRRT().search(aside, query.start, query.goals, query.uniform, budget, query.rng).path
        )
        shorter = None if path is None else simplify(aside, path, query.rng).path
        if shorter is not None and (best is None or shorter.length < best.length):
            best = shorter
    return Proposal(query.uniform if best is None else around.mixture(query, best))


def unconstrained_guide(around: AroundPath, query: Query, observation: Observation) -> Proposal:
    """Around an unconstrained path, which is planned and paid for first."""
    path, found = unconstrained_path(query)
    if path is None:
        detail = "no unconstrained path"
        return Proposal(query.uniform, detail=detail, vertices=found.vertices, failure=found.status)
    return Proposal(around.mixture(query, path), vertices=found.vertices)


def unconstrained_path(query: Query) -> tuple[JointPath | None, PlanResult]:
    """A path of a query without its constraint, shortened, or None; and the search that found it."""
    free = query.space.unconstrained()
    found = BiRRT().search(
        free, query.start, query.goals, query.uniform, query.deadline.budget, query.rng
    )
    return None if found.path is None else simplify(free, found.path, query.rng).path, found
