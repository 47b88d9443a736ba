"""What a roadmap proposes: a path on the manifold at once."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.proposal import Observation, Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Timings
from cvqmpt_lab.planning.roadmap import Roadmap, RoadmapQuery, RoadmapSettings
from cvqmpt_lab.planning.sight import Sight
from cvqmpt_lab.planning.space import ConstrainedSpace


@dataclass(frozen=True, eq=False)
class RoadmapPath:
    """A path through the roadmap, projected node by node; samples around the nodes found free when there is none.

    While there is none, nodes near start and goals are added, which a dictionary may have none of.
    """

    roadmap: Roadmap
    name: str = "roadmap-cvq"
    settings: RoadmapSettings = field(
        default_factory=lambda: RoadmapSettings(links=40, penalty=0.5, drift=1.5)
    )
    uniform_share: float = 0.3
    """Of the samples that a search gets when the roadmap holds no path."""
    draws: int = 3
    """How often nodes near start and goals are added while there is no path."""
    drawn: int = 128
    """Nodes added at once."""
    spread: float = 1.0
    """Largest standard deviation of those from an end [rad]."""
    see: Callable[[Query, Observation], Sight] | None = None
    """Tells what the robot sees, by which edges are priced; None to go blindly."""
    told: bool = False
    """Nodes and edges that are blocked on the way are known beforehand, from a search that costs no work: the bound of
    all roadmaps."""

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Search the roadmap with the query's constraint."""
        began = query.allowance.seconds
        sight = self.see(query, observation) if self.see else None
        timings = Timings(encode=query.allowance.seconds - began)
        asked = RoadmapQuery(query.space, self.roadmap, query.start, query.goals, self.settings, sight=sight)
        if self.told:
            asked.avoid(self._searched_before(query))
        path, _ = asked.next_path(query.allowance)
        for _ in range(self.draws):
            if path is not None or query.allowance.spent():
                break
            asked.add_nodes(self._near_ends(query))
            path, _ = asked.next_path(query.allowance)
        free = asked.free_nodes
        free = free[free < len(self.roadmap.nodes)]
        around = GaussianMixture.equal(
            asked.configurations(free),
            self.roadmap.covariances[free],
            query.uniform,
            self.uniform_share,
            self.name,
        )
        if path is not None:
            return Proposal(around, timings, vertices=len(free) + 2, path=path)
        lost = f"birrt around {len(free)} free nodes: no roadmap path after {asked.searches} searches"
        return Proposal(around, timings, vertices=len(free), fallback=lost)

    def _searched_before(self, query: Query) -> RoadmapQuery:
        """A query that has found its path, or that there is none, in a space of its own."""
        aside = ConstrainedSpace(query.space.problem, query.space.backend)
        before = RoadmapQuery(aside, self.roadmap, query.start, query.goals, self.settings)
        before.next_path(Allowance(query.allowance.budget, aside))
        return before

    def _near_ends(self, query: Query) -> np.ndarray:
        """Configurations on the manifold (at most `drawn`, n), half of them around the start, half around goals."""
        rng, robot = query.rng, query.space.robot
        centres = np.tile(query.start, (self.drawn, 1))
        centres[::2] = query.goals[rng.integers(len(query.goals), size=len(centres[::2]))]
        widths = rng.uniform(0.0, self.spread, (self.drawn, 1))
        draws = np.clip(centres + widths * rng.standard_normal(centres.shape), robot.lower, robot.upper)
        return draws[[query.space.project(q) for q in draws]]
