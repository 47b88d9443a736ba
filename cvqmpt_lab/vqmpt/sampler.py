"""From a query to sequences of codes: the dictionary as a roadmap with edge costs, and the cheapest
sequences on it.

Costs of edges are length + w * -log P(free | cloud). `learned_sampler` makes a sampling
distribution of the codes.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.latest import Latest
from cvqmpt_lab.search.roadmap import Roadmap, nearest_rows
from cvqmpt_lab.vqmpt.clearances import cell_clearances, edge_clearances, sphere_cells
from cvqmpt_lab.vqmpt.code_arcs import QUEUE, arcs_of, cheapest_ways
from cvqmpt_lab.vqmpt.edge_model import CLOUDS, SPACING, EdgeModel

SEQUENCES = 4  # that are found, at most
ENTRIES = 40  # codes that the start leads to, the nearest ones
EXITS = 20  # codes that lead to each goal, the nearest ones
COLLISION_WEIGHT = 4.0  # what -log P(free) adds to the cost of a motion [rad]


class Links(NamedTuple):
    """Undirected edges of a roadmap, and the arcs that lead along them both ways."""

    edges: np.ndarray  # (E, 2) int32, the smaller node first
    first: np.ndarray  # (N + 1,) int32, where each node's arcs begin
    neighbour: np.ndarray  # (2 E,) int32
    edge: np.ndarray  # (2 E,) int32


def links_of(roadmap: Roadmap) -> Links:
    """Every edge of a roadmap once."""
    count, k = roadmap.neighbours.shape
    pairs = np.stack([np.repeat(np.arange(count), k), roadmap.neighbours.ravel()], axis=1)
    edges = np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int32)
    arcs = arcs_of(count, edges)
    return Links(edges, arcs.first, arcs.neighbour, arcs.edge)


def _states_along(nodes: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (s, n): the nodes, then those between the ends of each edge, SPACING apart;
    where each edge's begin.
    """
    ends = nodes[edges]
    pieces = np.maximum(
        np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / SPACING).astype(int), 1
    )
    first = np.cumsum([len(nodes), *(pieces - 1)]).astype(np.int32)
    between = np.repeat(np.arange(len(ends)), pieces - 1)
    step = np.arange(len(between)) - (first[between] - len(nodes)) + 1
    share = (step / pieces[between])[:, None]
    inner = ends[between, 0] + share * (ends[between, 1] - ends[between, 0])
    return np.concatenate([nodes, inner]), first


class CodeRoadmap:
    """The dictionary's roadmap for one robot and what it carries;
    remembers the edge costs of the latest clouds.
    """

    def __init__(
        self, roadmap: Roadmap, model: EdgeModel, bare: "CodeRoadmap | None" = None
    ) -> None:
        """Place the model's spheres along all edges.

        bare: the same roadmap for the same robot with an empty hand, whose spheres are placed
            already.
        """
        self.roadmap, self.model = roadmap, model
        self._costs = Latest[np.ndarray](CLOUDS)
        self.clearances_read = 0  # of so many states until now
        if bare is None:
            self.links = links_of(roadmap)
            self._states, self._first = _states_along(roadmap.nodes, self.links.edges)
            self._cells = self._placed(0)
        else:
            known = len(bare.model.empty.sphere)
            assert bare.roadmap is roadmap
            assert np.array_equal(bare.model.empty.sphere, model.empty.sphere[:known])
            self.links, self._states, self._first = bare.links, bare._states, bare._first
            self._cells = np.concatenate([bare._cells, self._placed(known)], axis=1)
        ends = roadmap.nodes[self.links.edges]
        self.length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)

    def _placed(self, first: int) -> np.ndarray:
        """Cells (s, spheres) that the spheres from `first` on lie in."""
        empty = self.model.empty
        arrays = empty._replace(sphere=empty.sphere[first:], row=empty.row[first:])
        cells = np.empty((len(self._states), len(arrays.sphere)), dtype=np.int32)
        sphere_cells(self.model.robot.kinematics, arrays, self._states, cells)
        return cells

    def clearances(self, cloud: np.ndarray, use_cache: bool = True) -> np.ndarray:
        """Smallest clearance (E,) [m] along all edges."""
        arrays = self.model.arrays(cloud, use_cache)
        at_state, along = np.empty(len(self._cells)), np.empty(len(self.length))
        cell_clearances(arrays, arrays.distance.reshape(-1), self._cells, at_state)
        edge_clearances(at_state, self._first, self.links.edges, along)
        return along

    def edge_costs(self, cloud: np.ndarray, use_cache: bool = True) -> np.ndarray:
        """-log P(free) (E,) of all edges, in a cloud (m, 3) [m, robot base frame]."""
        return self._costs.get(
            cloud.tobytes(), lambda: self._edge_costs(cloud, use_cache), use_cache
        )

    def _edge_costs(self, cloud: np.ndarray, use_cache: bool) -> np.ndarray:
        self.clearances_read += len(self._states)
        return np.logaddexp(
            0.0, -self.model.empty.curve.log_odds(self.clearances(cloud, use_cache))
        )

    def link_costs(self, cloud: np.ndarray, ends: np.ndarray, near: np.ndarray) -> np.ndarray:
        """-log P(free) (e, k) of the motions between ends (e, n) and the nodes near (e, k) to each."""
        pairs = np.broadcast_arrays(ends[:, None], self.roadmap.nodes[near])
        motions = np.stack(pairs, axis=2).reshape(-1, 2, ends.shape[1])
        lengths = np.linalg.norm(motions[:, 1] - motions[:, 0], axis=1)
        self.clearances_read += int(np.ceil(lengths / SPACING).sum()) + len(motions)
        return np.logaddexp(0.0, -self.model.log_odds(cloud, motions)[1]).reshape(near.shape)


class CodeSequences:
    """A start and goals, linked to the dictionary's roadmap."""

    def __init__(
        self, roadmap: CodeRoadmap, cloud: np.ndarray, start: np.ndarray, goals: np.ndarray
    ) -> None:
        """Start (n,), goals (k, n) [rad or m], in a cloud (m, 3) [m, robot base frame]."""
        nodes, self._roadmap = roadmap.roadmap.nodes, roadmap
        self._arc_cost = (roadmap.length + COLLISION_WEIGHT * roadmap.edge_costs(cloud))[
            roadmap.links.edge
        ]
        self._heap = np.empty(QUEUE * len(nodes)), np.empty(QUEUE * len(nodes), dtype=np.int32)
        self._links = [
            (
                ends,
                (near := nearest_rows(nodes, ends, count)),
                roadmap.link_costs(cloud, ends, near),
            )
            for ends, count in ((start[None], ENTRIES), (goals, EXITS))
        ]

    def cheapest(self) -> list[list[int]]:
        """Sequences of codes, cheapest first:
        each is the cheapest through some code that those before have not.
        """
        (there, before), (back, after) = (self._ways(*link) for link in self._links)
        through = there + back
        found: list[list[int]] = []
        while len(found) < SEQUENCES and through.min() < np.inf:
            code = int(through.argmin())
            codes = [*_along(before, code)][::-1] + [*_along(after, code)][1:]
            through[code] = np.inf
            if len(set(codes)) == len(codes):  # otherwise a detour to the code and back
                through[codes] = np.inf
                found.append(codes)
        return found

    def _ways(
        self, ends: np.ndarray, near: np.ndarray, nll: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Cost (N,) of the cheapest way between any of ends (e, n) and each code, and the code
        before it.
        """
        nodes, links = self._roadmap.roadmap.nodes, self._roadmap.links
        cost, parent = np.full((1, len(nodes)), np.inf), np.empty((1, len(nodes)), dtype=np.int32)
        length = np.linalg.norm(nodes[near] - ends[:, None], axis=2)
        np.minimum.at(cost[0], near, length + COLLISION_WEIGHT * nll)
        cheapest_ways(links.first, links.neighbour, self._arc_cost, cost, parent, *self._heap)
        return cost[0], parent[0]


def _along(parent: np.ndarray, code: int) -> Iterator[int]:
    """A code and those before it on its cheapest way."""
    while code >= 0:
        yield code
        code = int(parent[code])
