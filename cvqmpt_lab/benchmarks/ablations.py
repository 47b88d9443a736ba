"""Controls: each differs from a planner in one part, to measure what this part contributes.

`planners` declares them.
"""

from functools import partial

import numpy as np

from cvqmpt_lab.collision.arrays import scene_arrays
from cvqmpt_lab.collision.carried import reach_with
from cvqmpt_lab.search.anytime import unconstrained_path
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import (
    GaussianMixture,
    Observation,
    Proposal,
    Query,
)
from cvqmpt_lab.search.portfolio import roadmap_planner, spread_nodes
from cvqmpt_lab.search.roadmap import scene_costs
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.learned_planners import on_dictionary, product
from cvqmpt_lab.vqmpt.sampler_choice import PREFIX, SamplerChoice


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


def no_costs(space: ConstrainedSpace) -> EdgeCosts:
    """Edges cost their length, whatever the scene."""
    return scene_costs(space)._replace(weight=0.0)


def other_costs(space: ConstrainedSpace) -> EdgeCosts:
    """Edge costs in another scene than the space's."""
    reach = reach_with(space.robot, space.world.attachments)
    from cvqmpt_lab.benchmarks.families import another_scene  # no plan but an ablation needs it

    return scene_costs(space)._replace(grid=scene_arrays(another_scene(), reach).grid)


def planner_of(name: str) -> Method | None:
    """The learned planner of a name with ``other-cloud``, which sees another scene, or None."""
    if not name.startswith(PREFIX):
        return None
    choice = SamplerChoice.of(name.removeprefix(PREFIX))
    if choice.cloud != "other-cloud":
        return None
    from cvqmpt_lab.benchmarks.families import another_scene

    return product(name, choice, another_scene())


def control(name: str) -> Method:
    """Return a control by its name."""
    kind = name.removeprefix("roadmap-")
    if kind.startswith("uniform-"):
        return roadmap_planner(name, partial(spread_nodes, draw=int(kind[-1])))
    if kind == name:
        return Method.simple(name, predict=guided)
    costs = other_costs if kind == "wrong-scene" else no_costs
    return on_dictionary(name, costs=costs, oracle=kind == "true-edges")
