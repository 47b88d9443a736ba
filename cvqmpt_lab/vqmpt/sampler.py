"""From a query to a mixture: the cheapest sequences of codes on the dictionary's roadmap, one Gaussian a code.

Costs of edges are length + w * -log P(free | cloud). Paper: sequences of codes {d_1, d_2, ..} of the dictionary, whose
decoded Gaussians N(mu_k, Sigma_k) with equal weights are the sampling distribution (eqn. sample_dist).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture
from cvqmpt_lab.search.query import Observation, Proposal, Query
from cvqmpt_lab.search.result import Timings
from cvqmpt_lab.vqmpt.graph import CodeGraph, CodeRoadmap, cheapest_ways, nearest_rows

QUEUE = 40  # entries of the queue a node


@dataclass(frozen=True)
class SequenceSettings:
    """How sequences are searched."""

    sequences: int = 4  # at most
    entries: int = 40  # codes that the start leads to, the nearest ones
    exits: int = 20  # codes that lead to each goal, the nearest ones
    collision_weight: float = 4.0  # what -log P(free) adds to the cost of a motion [rad]
    penalty: float = 0.5
    """Motions at a code that is not on the manifold count 1 + penalty * |F| times their length."""
    drift: float = 1.5  # codes that lie further from the manifold are not used [rad]
    rounds: int = 8  # how often at most sequences are searched again because their codes were projected


@dataclass(frozen=True, eq=False)
class CodeProposal(Proposal):
    """A proposal that remembers the codes it was made of."""

    codes: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """(c,) of all sequences, each once."""


@dataclass(frozen=True, eq=False)
class PredictedSequences:
    """The codes of the cheapest sequences from start to goals as a mixture of Gaussians."""

    name: str
    roadmap_of: Callable[[Query], CodeRoadmap]  # for the query's robot and what it carries
    covariances: np.ndarray  # (N, n, n) [rad^2] of codes, wide enough to sample from
    settings: SequenceSettings = field(default_factory=SequenceSettings)
    uniform_share: float = 0.15
    project_first: bool = False  # project codes onto the manifold before sequences through them are chosen

    def __call__(self, query: Query, observation: Observation) -> CodeProposal:
        """Search sequences; the timings say what edge costs and sequences took."""
        assert observation.cloud is not None
        clock, began = query.deadline, query.deadline.seconds
        roadmap = self.roadmap_of(query)
        roadmap.edge_costs(observation.cloud, observation.use_cache)
        encoded = clock.seconds
        asked = CodeSequences(roadmap, observation.cloud, query, self.settings, self.project_first)
        found = asked.cheapest()
        for _ in range(self.settings.rounds if self.project_first else 0):
            if not asked.project(_codes_of(found)):
                break
            found = asked.cheapest()
        codes = _codes_of(found)
        mixture = GaussianMixture.equal(
            asked.graph.nodes[codes], self.covariances[codes], query.uniform, self.uniform_share, self.name
        )
        return CodeProposal(
            mixture,
            Timings(encode=encoded - began, predict=clock.seconds - encoded),
            f"{len(found)} sequences of {len(codes)} codes",
            fallback="" if found else "no code sequence reached a goal",
            codes=codes,
        )


def _codes_of(sequences: list[list[int]]) -> np.ndarray:
    """Codes (c,) of sequences, each once."""
    return np.array(sorted(set().union(*sequences)), dtype=np.int64)


class CodeSequences:
    """A query's start and goals, linked to a copy of the dictionary's roadmap."""

    def __init__(
        self,
        roadmap: CodeRoadmap,
        cloud: np.ndarray,
        query: Query,
        settings: SequenceSettings,
        project_first: bool,
    ) -> None:
        nodes, manifold = roadmap.roadmap.nodes.copy(), query.space.problem.manifold
        factor, links = np.ones(len(nodes)), roadmap.links
        if project_first and query.space.dim > 0:
            factor += settings.penalty * np.linalg.norm(manifold.residual(nodes), axis=1)
        self.graph = CodeGraph(
            nodes,
            factor,
            links.first,
            links.neighbour,
            links.edge,
            roadmap.edge_costs(cloud),
            settings.collision_weight,
            np.empty(QUEUE * len(nodes)),
            np.empty(QUEUE * len(nodes), dtype=np.int32),
        )
        self._space, self._settings = query.space, settings
        self._projected = np.zeros(len(nodes), dtype=bool)
        starts, goals = query.start[None], query.goals
        self._links = [
            (ends, (near := nearest_rows(nodes, ends, count)), roadmap.link_costs(cloud, ends, near))
            for ends, count in ((starts, settings.entries), (goals, settings.exits))
        ]

    def cheapest(self) -> list[list[int]]:
        """Sequences of codes, cheapest first: each is the cheapest through some code that those before have not."""
        (there, before), (back, after) = (self._ways(*link) for link in self._links)
        through = there + back
        found: list[list[int]] = []
        while len(found) < self._settings.sequences and through.min() < np.inf:
            code = int(through.argmin())
            codes = [*_along(before, code)][::-1] + [*_along(after, code)][1:]
            through[code] = np.inf
            if len(set(codes)) == len(codes):  # otherwise a detour to the code and back
                through[codes] = np.inf
                found.append(codes)
        return found

    def _ways(self, ends: np.ndarray, near: np.ndarray, nll: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cost (N,) of the cheapest way between any of ends (e, n) and each code, and the code before it."""
        graph = self.graph
        cost, parent = np.full(len(graph.nodes), np.inf), np.empty(len(graph.nodes), dtype=np.int32)
        length = np.linalg.norm(graph.nodes[near] - ends[:, None], axis=2)
        np.minimum.at(cost, near, 0.5 * (1.0 + graph.factor[near]) * length + graph.weight * nll)
        cheapest_ways(graph, cost, parent)
        return cost, parent

    def project(self, codes: np.ndarray) -> bool:
        """Put codes on the manifold; those that lie too far from it are not used again. Whether any was new."""
        new = codes[~self._projected[codes]]
        self._projected[new] = True
        for code in new.tolist():
            node, q = self.graph.nodes[code], self.graph.nodes[code].copy()
            good = self._space.project(q) and np.linalg.norm(q - node) <= self._settings.drift
            self.graph.factor[code] = 1.0 if good else np.inf
            node[:] = q
        return len(new) > 0


def _along(parent: np.ndarray, code: int) -> Iterator[int]:
    """A code and those before it on its cheapest way."""
    while code >= 0:
        yield code
        code = int(parent[code])
