"""Points that show a planner at work: nodes of its search, its point cloud, its Gaussians."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from cvqmpt_lab.features.pictures.bodies import BODY_COLOURS
from cvqmpt_lab.features.pictures.meshes import Colour
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.planner_interface import GaussianMixture, Observation, Query
from cvqmpt_lab.search.portfolio import Portfolio
from cvqmpt_lab.search.result import Budget, Tree
from cvqmpt_lab.search.space import ConstrainedSpace


def sampled_hands(
    problem: PlanningProblem, planner: str, trees: Sequence[Tree]
) -> Iterator[tuple[str, np.ndarray, Colour]]:
    """Yield layer, points (k, 3) [m] and colour of each set of points.

    Layer "search" has the hand's positions at nodes of roadmap and trees, "cloud" the observed
    point cloud, "Gaussians" the hand's positions at samples before and after Algorithm 2.

    Args:
        problem: the problem with its goals.
        planner: name of the planner.
        trees: trees of its search.
    """
    robot, rng = problem.robot, np.random.default_rng(0)
    method = planner_named(planner)
    stages = method.stages(problem)
    if isinstance(stages.search, Portfolio) and stages.search.roadmap is not None:
        yield "search", robot.poses(stages.search.roadmap.nodes)[:, :3, 3], BODY_COLOURS["ghost"]
    for tree in trees:
        yield "search", robot.poses(tree.nodes)[:, :3, 3], BODY_COLOURS["goal"]
    cloud = None if stages.observe is None else stages.observe(problem.scene)
    if cloud is not None:
        yield "cloud", cloud, BODY_COLOURS["ghost"]
    if method.sampler is not None and len(problem.goals):
        space, budget = ConstrainedSpace.of(problem), Budget(seconds=1.0)
        query = Query.of(space, problem.start, problem.goals[:1], budget, rng)
        found = stages.predict(query, Observation(cloud))
        updated = found if stages.update is None else stages.update(query, found)
        for part, colour in ((found, BODY_COLOURS["ghost"]), (updated, BODY_COLOURS["trace"])):
            if isinstance(part.distribution, GaussianMixture):
                draws = replace(part.distribution, uniform_share=0.0).sample(rng, 400)
                yield "Gaussians", robot.poses(draws)[:, :3, 3], colour
