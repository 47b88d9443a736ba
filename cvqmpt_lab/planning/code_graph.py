"""A dictionary's codes and the edges between them, as one pair of eyes sees all of them at once."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

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


@dataclass(frozen=True, eq=False)
class StatesSeen:
    """The s states of a roadmap that eyes look at: its nodes, then those between the ends of each edge."""

    links: CodeEdges
    length: np.ndarray
    """(E,) of the edges [rad]."""
    first: np.ndarray
    """(E + 1,) int32, where the states between each edge's ends begin."""
    states: np.ndarray
    """(s, n) [rad]."""

    @classmethod
    def of(cls, roadmap: Roadmap) -> "StatesSeen":
        """Those of a roadmap, SPACING apart."""
        links = CodeEdges.of(roadmap)
        ends = roadmap.nodes[links.edges]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        pieces = np.maximum(np.ceil(length / SPACING).astype(int), 1)
        first = np.cumsum([len(roadmap.nodes), *(pieces - 1)]).astype(np.int32)
        between = np.repeat(np.arange(len(ends)), pieces - 1)
        step = np.arange(len(between)) - (first[between] - len(roadmap.nodes)) + 1
        share = (step / pieces[between])[:, None]
        inner = ends[between, 0] + share * (ends[between, 1] - ends[between, 0])
        return cls(links, length, first, np.concatenate([roadmap.nodes, inner]))


class SeenGraph:
    """A roadmap before one pair of eyes: where the robot's balls are along its edges is worked out once."""

    def __init__(self, roadmap: Roadmap, eyes: Eyes, bare: "SeenGraph | None" = None) -> None:
        """Look nowhere yet.

        bare: the same roadmap before eyes on the same robot with an empty hand, whose balls are placed already.
        """
        self.roadmap, self.eyes = roadmap, eyes
        self._priced: OrderedDict[bytes, np.ndarray] = OrderedDict()
        if bare is None:
            self._seen = StatesSeen.of(roadmap)
            self._cells = self._placed(0)
        else:
            known = bare.eyes.blank.ball
            assert bare.roadmap is roadmap and np.array_equal(known, eyes.blank.ball[: len(known)])
            self._seen = bare._seen
            self._cells = np.concatenate([bare._cells, self._placed(len(known))], axis=1)

    @property
    def links(self) -> CodeEdges:
        """The roadmap's edges."""
        return self._seen.links

    def _placed(self, first: int) -> np.ndarray:
        """Cells (s, balls) that the balls from `first` on lie in."""
        blank = self.eyes.blank
        sight = blank._replace(ball=blank.ball[first:], row=blank.row[first:])
        cells = np.empty((len(self._seen.states), len(sight.ball)), dtype=np.int32)
        ball_cells(self.eyes.robot.kinematics, sight, self._seen.states, cells)
        return cells

    def features(self, cloud: np.ndarray, anew: bool = False) -> np.ndarray:
        """Inputs (E, n + 1) of the eyes' network for all edges; anew: see `Eyes.look`."""
        sight, n = self.eyes.look(cloud, anew), self.eyes.robot.dof
        clearance = np.empty((len(self._cells), n))
        look_at_cells(sight, sight.distance.reshape(-1), self._cells, clearance)
        seen = self._seen
        features = np.empty((len(seen.length), n + 1))
        join_looks(clearance, seen.first, self.links.edges, seen.length, features)
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

    def doubts(self, cloud: np.ndarray, ends: np.ndarray, near: np.ndarray) -> np.ndarray:
        """-log P(free) (e, k) of the motions between ends (e, n) and the nodes near (e, k) to each."""
        pairs = np.broadcast_arrays(ends[:, None], self.roadmap.nodes[near])
        motions = np.stack(pairs, axis=2).reshape(-1, 2, ends.shape[1])
        return np.logaddexp(0.0, -self.eyes.judge(cloud, motions)[1]).reshape(near.shape)


def nearest_rows(nodes: np.ndarray, ends: np.ndarray, count: int) -> np.ndarray:
    """Rows (e, count) int32 of the nodes (N, n) nearest to each of ends (e, n), in no order."""
    squares = (ends**2).sum(1)[:, None] + (nodes**2).sum(1) - 2.0 * ends @ nodes.T
    return np.argpartition(squares, count, axis=1)[:, :count].astype(np.int32)
