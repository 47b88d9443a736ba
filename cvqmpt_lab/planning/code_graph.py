"""A dictionary's codes and the edges between them, as one pair of eyes sees all of them at once."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.kernels.search.code_graph import CodeGraph
from cvqmpt_lab.kernels.search.sight import ball_cells, join_looks, look_at_cells
from cvqmpt_lab.planning.roadmap import Roadmap
from cvqmpt_lab.planning.sight import CLOUDS, SPACING, Eyes


@dataclass(frozen=True, eq=False)
class CodeEdges:
    """Undirected edges of a roadmap, and the arcs that lead along them both ways."""

    edges: np.ndarray
    """(E, 2) int32, the smaller node first."""
    first: np.ndarray
    """(N + 1,) int32, where each node's arcs begin."""
    neighbour: np.ndarray
    """(2 E,) int32."""
    edge: np.ndarray
    """(2 E,) int32."""

    @classmethod
    def of(cls, roadmap: Roadmap) -> "CodeEdges":
        """Those of a roadmap."""
        count, k = roadmap.neighbours.shape
        pairs = np.stack([np.repeat(np.arange(count), k), roadmap.neighbours.ravel()], axis=1)
        edges = np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int32)
        arcs = np.concatenate([edges, edges[:, ::-1]])
        order = np.lexsort((arcs[:, 1], arcs[:, 0]))
        first = np.searchsorted(arcs[order, 0], np.arange(count + 1)).astype(np.int32)
        return cls(edges, first, arcs[order, 1].copy(), (order % len(edges)).astype(np.int32))


class SeenGraph:
    """A roadmap before one pair of eyes: where the robot's balls are along its edges is worked out once."""

    def __init__(self, roadmap: Roadmap, eyes: Eyes) -> None:
        self.roadmap, self.eyes, self.links = roadmap, eyes, CodeEdges.of(roadmap)
        ends = roadmap.nodes[self.links.edges]
        self._length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        pieces = np.maximum(np.ceil(self._length / SPACING).astype(int), 1)
        self._first = np.cumsum([len(roadmap.nodes), *(pieces - 1)]).astype(np.int32)
        between = np.repeat(np.arange(len(ends)), pieces - 1)
        step = np.arange(len(between)) - (self._first[between] - len(roadmap.nodes)) + 1
        share = (step / pieces[between])[:, None]
        states = np.concatenate(
            [roadmap.nodes, ends[between, 0] + share * (ends[between, 1] - ends[between, 0])]
        )
        self._cells = np.empty((len(states), eyes.balls), dtype=np.int32)
        ball_cells(eyes.robot.kinematics, eyes.blank, states, self._cells)
        self._priced: OrderedDict[bytes, np.ndarray] = OrderedDict()

    def features(self, cloud: np.ndarray, anew: bool = False) -> np.ndarray:
        """Inputs (E, n + 1) of the eyes' network for all edges; anew: see `Eyes.look`."""
        sight, n = self.eyes.look(cloud, anew), self.eyes.robot.dof
        clearance = np.empty((len(self._cells), n))
        look_at_cells(sight, sight.distance.reshape(-1), self._cells, clearance)
        features = np.empty((len(self._length), n + 1))
        join_looks(clearance, self._first, self.links.edges, self._length, features)
        return features

    def prices(self, cloud: np.ndarray, anew: bool = False) -> np.ndarray:
        """-log P(free) (E,) of all edges; those of the latest clouds are remembered. anew: look again all the same."""
        key = cloud.tobytes()
        if anew or key not in self._priced:
            self._priced[key] = np.logaddexp(0.0, -self.eyes.network(self.features(cloud, anew)))
            if len(self._priced) > CLOUDS:
                self._priced.popitem(last=False)
        self._priced.move_to_end(key)
        return self._priced[key]

    def graph(self, cloud: np.ndarray) -> CodeGraph:
        """The graph with its prices, the nodes a copy."""
        links = self.links
        return CodeGraph(
            nodes=self.roadmap.nodes.copy(),
            first=links.first,
            neighbour=links.neighbour,
            edge=links.edge,
            length=self._length.copy(),
            price=self.prices(cloud).copy(),
        )
