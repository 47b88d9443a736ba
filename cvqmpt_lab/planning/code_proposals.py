"""CVQ-MPT's sequences of codes (paper, Algorithm 1) by Dijkstra's algorithm on the dictionary's roadmap.

An edge between two codes costs its length and what the doubt about it weighs, which the cloud decides.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.distributions import GaussianMixture
from cvqmpt_lab.kernels.search.code_graph import CodeGraph, cheapest_ways
from cvqmpt_lab.planning.code_graph import SeenGraph, nearest_rows
from cvqmpt_lab.planning.proposal import Observation, Proposal
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Timings

QUEUE = 40  # entries of the queue a node


@dataclass(frozen=True)
class SequenceSettings:
    """How sequences are searched."""

    sequences: int = 4
    """At most."""
    entries: int = 40
    """Codes that the start leads to, the nearest ones."""
    exits: int = 20
    """Codes that lead to each goal, the nearest ones."""
    collision_weight: float = 4.0
    """What -log P(free) adds to the cost of a motion [rad]."""
    penalty: float = 0.5
    """Motions at a code that is not on the manifold count 1 + penalty * |F| times their length."""
    drift: float = 1.5
    """Codes that lie further from the manifold are not used [rad]."""
    rounds: int = 8
    """How often at most sequences are searched again because their codes were projected."""


@dataclass(frozen=True, eq=False)
class CodeProposal(Proposal):
    """A proposal that remembers the codes it was made of."""

    codes: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """(c,) of all sequences, each once."""


@dataclass(frozen=True, eq=False)
class PredictedSequences:
    """The codes of the cheapest sequences from start to goals as a mixture of Gaussians."""

    name: str
    seen: Callable[[Query], SeenGraph]
    """The dictionary's roadmap with the edge costs of the query's robot and what it carries."""
    covariances: np.ndarray
    """(N, n, n) of codes, wide enough to sample from [rad^2]."""
    settings: SequenceSettings = field(default_factory=SequenceSettings)
    uniform_share: float = 0.15
    early: bool = False
    """Codes are projected onto the manifold before sequences through them are judged."""

    def __call__(self, query: Query, observation: Observation) -> CodeProposal:
        """Search sequences; the timings say what edge costs and sequences took."""
        assert observation.cloud is not None
        clock, began = query.allowance, query.allowance.seconds
        roadmap = self.seen(query)
        roadmap.prices(observation.cloud, observation.new)
        encoded = clock.seconds
        asked = CodeSequences(roadmap, observation.cloud, query, self.settings, self.early)
        found = asked.cheapest()
        for _ in range(self.settings.rounds if self.early else 0):
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
        self, roadmap: SeenGraph, cloud: np.ndarray, query: Query, settings: SequenceSettings, early: bool
    ) -> None:
        nodes, manifold = roadmap.roadmap.nodes.copy(), query.space.problem.manifold
        factor, links = np.ones(len(nodes)), roadmap.links
        if early and query.space.dim > 0:
            factor += settings.penalty * np.linalg.norm(manifold.residual(nodes), axis=1)
        self.graph = CodeGraph(
            nodes,
            factor,
            links.first,
            links.neighbour,
            links.edge,
            roadmap.prices(cloud),
            settings.collision_weight,
            np.empty(QUEUE * len(nodes)),
            np.empty(QUEUE * len(nodes), dtype=np.int32),
        )
        self._space, self._settings = query.space, settings
        self._projected = np.zeros(len(nodes), dtype=bool)
        starts, goals = query.start[None], query.goals
        self._links = [
            (ends, (near := nearest_rows(nodes, ends, count)), roadmap.doubts(cloud, ends, near))
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

    def _ways(self, ends: np.ndarray, near: np.ndarray, doubt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cost (N,) of the cheapest way between any of ends (e, n) and each code, and the code before it."""
        graph = self.graph
        cost, parent = np.full(len(graph.nodes), np.inf), np.empty(len(graph.nodes), dtype=np.int32)
        length = np.linalg.norm(graph.nodes[near] - ends[:, None], axis=2)
        np.minimum.at(cost, near, 0.5 * (1.0 + graph.factor[near]) * length + graph.weight * doubt)
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
