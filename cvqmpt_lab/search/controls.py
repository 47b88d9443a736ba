"""Controls: Gaussians around paths that need no network; edge costs that do not see the scene."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.collision.arrays import scene_arrays
from cvqmpt_lab.collision.solids import reach_with
from cvqmpt_lab.scene.families import another_scene
from cvqmpt_lab.search.birrt import BiRRT
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.planner_interface import (
    GaussianMixture,
    Observation,
    Proposal,
    Query,
    SamplingDistribution,
)
from cvqmpt_lab.search.result import Budget, JointPath, PlanResult
from cvqmpt_lab.search.roadmap import scene_costs
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace


@dataclass(frozen=True)
class AroundPath:
    """Gaussians of equal weight at waypoints along paths, and a uniform share."""

    name: str
    std: float = 0.5  # [rad] of each Gaussian, in every joint
    uniform_share: float = 0.15

    def mixture(self, query: Query, *paths: JointPath) -> SamplingDistribution:
        """The distribution around waypoints that are 0.5 rad apart."""
        means = np.concatenate([path.spaced(0.5) for path in paths])
        covariance = self.std**2 * np.eye(means.shape[1])
        return GaussianMixture.equal(
            means, covariance, query.uniform, self.uniform_share, self.name
        )

    def straight_line(self, query: Query, observation: Observation) -> Proposal:
        """Gaussians along the straight lines to the three nearest goals; nothing is checked."""
        lines = [JointPath(np.stack([query.start, goal])) for goal in query.nearest_goals(3)]
        return Proposal(self.mixture(query, *lines))

    def solved_paths(self, query: Query, observation: Observation) -> Proposal:
        """Gaussians around the shortest of six solutions of the problem: a bound of mixtures.

        Uniform samples if no path is found. Finding the paths counts as time, not as work.
        """
        aside, best = ConstrainedSpace(query.space.problem, query.space.backend), None
        for _ in range(6):
            if query.deadline.spent():
                break
            shorter, _ = short_path(aside, query, query.deadline.rest())
            if shorter is not None and (best is None or shorter.length < best.length):
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
    return short_path(query.space.unconstrained(), query, query.deadline.budget)


def short_path(
    space: ConstrainedSpace, query: Query, budget: Budget
) -> tuple[JointPath | None, PlanResult]:
    """A shortened path from a query's start to a goal, or None; and the search for it."""
    found = BiRRT().search(space, query.start, query.goals, query.uniform, budget, query.rng)
    return None if found.path is None else simplify(space, found.path, query.rng).path, found


def no_costs(space: ConstrainedSpace) -> EdgeCosts:
    """Edges cost their length, whatever the scene."""
    return scene_costs(space)._replace(weight=0.0)


def other_costs(space: ConstrainedSpace) -> EdgeCosts:
    """Edge costs in another scene than the space's."""
    reach = reach_with(space.robot, space.problem.attachments)
    return scene_costs(space)._replace(grid=scene_arrays(another_scene(), reach).grid)
