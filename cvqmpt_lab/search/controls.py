"""Controls: Gaussians around paths that need no network; edge costs that do not see the scene."""

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
)
from cvqmpt_lab.search.result import Budget, JointPath, PlanResult
from cvqmpt_lab.search.roadmap import scene_costs
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace


def guided(query: Query, observation: Observation) -> Proposal:
    """Gaussians of 0.5 rad around waypoints of an unconstrained path, whose planning is counted."""
    path, found = unconstrained_path(query)
    if path is not None:
        means = path.spaced(0.5)
        covariance = 0.5**2 * np.eye(means.shape[1])
        mixture = GaussianMixture.equal(means, covariance, query.uniform, 0.15, "guide")
        return Proposal(mixture, vertices=found.vertices)
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
