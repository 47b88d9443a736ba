"""What a roadmap proposes: a path on the manifold at once, or where to sample."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture
from cvqmpt_lab.planning.proposal import Observation, Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.roadmap import Roadmap, RoadmapQuery, RoadmapSettings


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Where to sample instead of at the roadmap's own nodes."""

    means: np.ndarray
    """(r, n) [rad]."""
    covariances: np.ndarray
    """(r, n, n) [rad^2]."""


@dataclass(frozen=True, eq=False)
class RoadmapPath:
    """A path through the roadmap, projected node by node; samples around the nodes found free when there is none."""

    roadmap: Roadmap
    name: str = "roadmap-cvq"
    settings: RoadmapSettings = field(default_factory=RoadmapSettings)
    uniform_share: float = 0.3
    """Of the samples that a search gets when the roadmap holds no path."""

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Search the roadmap with the query's constraint."""
        asked = RoadmapQuery(query.space, self.roadmap, query.start, query.goals, self.settings)
        path, _ = asked.next_path(query.allowance)
        free = asked.free_nodes
        around = GaussianMixture.equal(
            asked.configurations(free),
            self.roadmap.covariances[free],
            query.uniform,
            self.uniform_share,
            self.name,
        )
        if path is not None:
            return Proposal(around, vertices=len(free) + 2, path=path)
        lost = f"birrt around {len(free)} free nodes: no roadmap path after {asked.searches} searches"
        return Proposal(around, vertices=len(free), fallback=lost)


@dataclass(frozen=True, eq=False)
class RoadmapMixture:
    """Gaussians at the nodes of several diverse roadmap paths, searched without the constraint."""

    roadmap: Roadmap
    name: str = "roadmap-sampler"
    check: bool = True
    """Nodes and edges are checked exactly when a path needs them; otherwise the roadmap is blind."""
    paths: int = 6
    """Number of diverse paths."""
    uniform_share: float = 0.15
    blocked: Callable[[Query, Observation], np.ndarray] | None = None
    """Tells which nodes (N,) bool to leave out, without checking them."""
    move: Callable[[Query, np.ndarray], Gaussians] | None = None
    """Gives other Gaussians for nodes (r,)."""
    settings: RoadmapSettings = field(default_factory=lambda: RoadmapSettings(penalty=0.0))

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Search paths, then sample around all their nodes."""
        blocked = self.blocked(query, observation) if self.blocked else None
        free = query.space.unconstrained()
        asked = RoadmapQuery(free, self.roadmap, query.start, query.goals, self.settings, blocked)
        rows = [asked.next_path(query.allowance, self.check)[1] for _ in range(self.paths)]
        chosen = np.unique(np.concatenate(rows))
        gaussians = Gaussians(asked.configurations(chosen), self.roadmap.covariances[chosen])
        if self.move and len(chosen):
            gaussians = self.move(query, chosen)
        mixture = GaussianMixture.equal(
            gaussians.means, gaussians.covariances, query.uniform, self.uniform_share, self.name
        )
        found = sum(len(nodes) > 0 for nodes in rows)
        return Proposal(mixture, detail=f"{len(chosen)} nodes on {found} roadmap paths")
