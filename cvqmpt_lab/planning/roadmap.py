"""Configurations linked to their neighbours, and one planning question after another asked of them."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search import lazy_roadmap as kernels
from cvqmpt_lab.planning.allowance import Allowance
from cvqmpt_lab.planning.result import JointPath
from cvqmpt_lab.planning.sight import Sight, blind
from cvqmpt_lab.planning.space import ConstrainedSpace

LONGEST_PATH = 256  # nodes
QUEUE = 32  # entries a node
SEARCHES_AT_ONCE = 16  # between looks at the clock


@dataclass(frozen=True, eq=False)
class Roadmap:
    """Configurations to plan through, each linked to its nearest ones."""

    nodes: np.ndarray
    """(N, n) [rad]."""
    covariances: np.ndarray
    """(N, n, n) of the Gaussians that samples around nodes come from [rad^2]."""
    neighbours: np.ndarray
    """(N, k) int32, the nearest nodes of each."""

    @staticmethod
    def of(nodes: np.ndarray, covariances: np.ndarray, neighbours: int = 12) -> "Roadmap":
        """Link each node to its nearest ones; InvalidInputError when there are not more nodes than neighbours."""
        if len(nodes) <= neighbours:
            raise InvalidInputError(f"a roadmap of {len(nodes)} nodes; give more than {neighbours}")
        table = np.empty((len(nodes), neighbours), dtype=np.int32)
        for i, node in enumerate(nodes):
            squares = ((nodes - node) ** 2).sum(axis=1)
            squares[i] = np.inf
            near = np.argpartition(squares, neighbours)[:neighbours]
            table[i] = near[np.argsort(squares[near])]
        return Roadmap(nodes, covariances, table)


@dataclass(frozen=True)
class RoadmapSettings:
    """How a roadmap is searched; defaults were chosen on the tuning environments."""

    links: int = 20
    """Nodes that the start and each goal are linked to."""
    direct: int = 0
    """Nearest goals that the start is linked to without a node between."""
    penalty: float = 1.0
    """Edges at a node count 1 + penalty * |F| times their length, so that paths prefer the manifold."""
    drift: float = 2.5
    """Nodes that lie further from the manifold are left out [rad]."""
    searches: int = 100
    """Searches at most; each ends at a path, or at the first edge that turns out blocked."""
    step: float = 0.2
    """Longest motion between the states of an edge [rad]; a found path is mended to the space's own."""
    caution: float = 2.0
    """What -log P(free) of an edge adds to its length, where a cloud is seen [rad]."""
    detour: float = 1.5
    """How much longer the nodes of a found path count when the next path is searched."""


class RoadmapQuery:
    """One start and its goals on a roadmap, in a space; finds one path after another."""

    def __init__(
        self,
        space: ConstrainedSpace,
        roadmap: Roadmap,
        start: np.ndarray,
        goals: np.ndarray,
        settings: RoadmapSettings,
        sight: Sight | None = None,
    ) -> None:
        """Link start (n,) and goals (k, n) to the roadmap.

        sight: what the robot sees, None to believe every edge alike.
        """
        self._settings, self._space, self._arrays = settings, space, space.arrays._replace(step=settings.step)
        self._sight, self._caution = (blind(len(start)), 0.0) if sight is None else (sight, settings.caution)
        self._ends, self.searches = (start, goals), 0
        verdict = np.full(len(roadmap.nodes), kernels.UNKNOWN, dtype=np.int8)
        self._set_up(roadmap.nodes, roadmap.neighbours, verdict)

    def _set_up(self, nodes: np.ndarray, table: np.ndarray, verdict: np.ndarray) -> None:
        """Link start and goals to nodes (N, n) that lead to those in table (N, k); verdict (N,): is known of them."""
        settings, (start, goals) = self._settings, self._ends
        count, total = len(nodes), len(nodes) + 1 + len(goals)
        links = min(settings.links, count)
        neighbours = np.full((count + 1, max(links, table.shape[1])), -1, dtype=np.int32)
        neighbours[:count, : table.shape[1]] = table
        factor = np.ones(total)
        if settings.penalty > 0 and self._space.dim > 0:
            violation = np.linalg.norm(self._space.problem.manifold.residual(nodes), axis=1)
            factor[:count] += settings.penalty * violation
        self._graph = kernels.Roadmap(
            nodes=np.concatenate([nodes, start[None], goals]),
            neighbours=neighbours,
            edge=np.zeros(neighbours.shape, dtype=np.int8),
            goal_edge=np.zeros((count + 1, len(goals)), dtype=np.int8),
            node=np.concatenate([verdict, np.full(1 + len(goals), kernels.FREE, dtype=np.int8)]),
            caution=self._caution,
            price=np.empty((count + 1, neighbours.shape[1] + len(goals))),
            judged=np.zeros((count + 1, neighbours.shape[1] + len(goals)), dtype=np.int8),
            factor=factor,
            to_go=np.empty(total),
            cost=np.empty(total),
            parent=np.empty(total, dtype=np.int32),
            slot=np.empty(total, dtype=np.int32),
            closed=np.empty(total, dtype=np.int8),
            heap=np.empty(QUEUE * total),
            heap_node=np.empty(QUEUE * total, dtype=np.int32),
        )
        self._count, self._left = count, settings.searches
        kernels.link_query(self._graph, settings.direct, np.empty(links, dtype=np.int32), np.empty(links))

    def add_nodes(self, added: np.ndarray) -> None:
        """Link more nodes (a, n) to the roadmap, to each other and to start and goals; what was found out is kept."""
        before, count, half = self._graph, self._count, self._settings.links // 2
        nodes = np.concatenate([before.nodes[:count], added])
        table = np.full((len(nodes), before.neighbours.shape[1]), -1, dtype=np.int32)
        table[:count] = before.neighbours[:count]
        for row in range(count, len(nodes)):
            squares = ((nodes - nodes[row]) ** 2).sum(axis=1)
            squares[row] = np.inf
            known, new = np.argsort(squares[:count])[:half], count + np.argsort(squares[count:-1])[:half]
            table[row, : len(known) + len(new)] = near = np.concatenate([known, new])
            back = near[table[near, -1] < 0]  # those that have room for one more
            table[back, np.argmax(table[back] < 0, axis=1)] = row
        verdict = np.concatenate([before.node[:count], np.full(len(added), kernels.UNKNOWN, dtype=np.int8)])
        self._set_up(nodes, table, verdict)
        self._graph.edge[:count] = before.edge[:count]
        self._graph.factor[:count] = before.factor[:count]

    def avoid(self, known: "RoadmapQuery") -> None:
        """Leave out what another query, of the same nodes, found blocked."""
        mine, theirs = self._graph, known._graph
        for verdicts, found in zip(
            (mine.edge, mine.goal_edge, mine.node), (theirs.edge, theirs.goal_edge, theirs.node), strict=True
        ):
            verdicts[found == kernels.BLOCKED] = kernels.BLOCKED

    def next_path(self, allowance: Allowance, check: bool = True) -> tuple[JointPath | None, np.ndarray]:
        """The shortest path left, on the manifold and free, and the rows of its nodes; None when there is none.

        check: otherwise nothing is projected or checked. Each search counts as an iteration of the allowance.
        """
        path, ends = np.empty(LONGEST_PATH, dtype=np.int64), np.empty(LONGEST_PATH, dtype=np.int64)
        states = np.empty((64 * LONGEST_PATH, self._graph.nodes.shape[1]))
        length, bad = 0, -1
        while self._left > 0 and allowance.spent() is None:
            kernels.block_state(self._graph, path, ends, length, bad)  # of a path that failed its fine check
            most = min(self._left, SEARCHES_AT_ONCE, allowance.rest().iterations or SEARCHES_AT_ONCE)
            size, length, searched = kernels.search(
                self._arrays, self._graph, self._sight, most, self._settings.drift, check, path, ends, states
            )
            self._space.reraise()
            self._left -= searched
            allowance.count(searched)
            self.searches += searched
            if size == kernels.NO_PATH:
                if searched < most:
                    break
                length = 0
                continue
            found, bad = self._space.checked_path(states[:size]) if check else (JointPath(states[:size]), -1)
            if found is not None:
                rows = path[1 : length - 1][::-1].copy()
                self._graph.factor[rows] *= self._settings.detour
                return JointPath(found.states.copy()), rows
        return None, np.empty(0, dtype=np.int64)

    @property
    def free_nodes(self) -> np.ndarray:
        """Rows (r,) of nodes found free so far."""
        return np.flatnonzero(self._graph.node[: self._count] == kernels.FREE)

    def configurations(self, rows: np.ndarray) -> np.ndarray:
        """Where nodes are now (r, n): projected, if they were visited."""
        return self._graph.nodes[rows]
