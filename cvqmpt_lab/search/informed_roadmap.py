"""Shorter paths by small roadmaps of the configurations that a shorter path can pass through, one
after another.

A path of length c from start to goal passes through configurations x with |x - start| + |x - goal|
< c, an informed set (Gammell, Srinivasa and Barfoot 2014). Each roadmap has its own draws from it,
put on the manifold and free, and its edges are judged and checked lazily, as in any roadmap search.
Raw paths through random nodes are longer than what shortening makes of them: those up to `slack`
times as long as the best path are given to it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.search.anytime import short_ways
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.lazy_roadmap import FREE, keep_short_ways
from cvqmpt_lab.search.query import Deadline
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.roadmap import (
    FEWEST,
    Roadmap,
    RoadmapQuery,
    RoadmapSearchSettings,
    nearest_rows,
    scene_costs,
)
from cvqmpt_lab.search.space import ConstrainedSpace

# times the straight line's length, up to the best path's, in turn
STRETCHES = (1.6, 2.0, 1.3, 2.6, np.inf)
SETTINGS = RoadmapSearchSettings(links=40, penalty=0.0, searches=20, greed=1.5)


@dataclass(frozen=True, eq=False)
class InformedRoadmaps:
    """Roadmaps near the straight lines to the goals, narrow and wide ones in turn;
    defaults from tuning problems.
    """

    draws: int = 100  # configurations a roadmap; half of them are free in the kitchen
    neighbours: int = 20
    slack: float = 2.0  # times the best length that a raw path may be long
    weight: float = 1.0  # [rad] of -log P(free), see `EdgeCosts`
    settings: RoadmapSearchSettings = SETTINGS
    costs: Callable[[ConstrainedSpace], EdgeCosts] = scene_costs

    def next_path(
        self,
        space: ConstrainedSpace,
        best: JointPath,
        deadline: Deadline,
        rng: np.random.Generator,
        number: int,
    ) -> JointPath | None:
        """Search a new roadmap; see `query.Ways`."""
        start = space.problem.start
        goals, samples = short_ways(space, best.length, STRETCHES[number % len(STRETCHES)])
        draws = samples.sample(rng, self.draws)
        nodes = draws[: keep_short_ways.unchecked(space.arrays, draws, start, goals, best.length)]
        space.reraise()
        if len(nodes) < FEWEST:
            return None
        near = nearest_rows(nodes, nodes, min(self.neighbours, len(nodes) - 1), apart=True)
        costs, longest = self.costs(space), self.slack * best.length
        if costs.weight > 0.0:
            costs = costs._replace(weight=self.weight)
        roadmap = Roadmap(nodes, near.astype(np.int32))
        asked = RoadmapQuery(space, roadmap, start, goals, self.settings, costs, longest, FREE)
        found = asked.next_path(deadline)
        return found if found is not None and found.length < longest else None
