"""A roadmap searched lazily under a constraint, and the planner that takes its path at once (`roadmap-cvq`)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.search import lazy_roadmap as kernels
from cvqmpt_lab.search.query import Deadline, GaussianMixture, Observation, Proposal, Query
from cvqmpt_lab.search.result import JointPath, Timings
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.edge_model import EdgeArrays, without_cloud

LONGEST_PATH = 256  # nodes
QUEUE = 32  # entries a node
SEARCHES_AT_ONCE = 16  # before the clock is read


@dataclass(frozen=True, eq=False)
class Roadmap:
    """Configurations to plan through, each linked to its nearest ones."""

    nodes: np.ndarray  # (N, n) [rad]
    covariances: np.ndarray  # (N, n, n) [rad^2] of the Gaussians that samples around nodes come from
    neighbours: np.ndarray  # (N, k) int32, the nearest nodes of each

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

    links: int = 40  # nodes that the start and each goal are linked to
    penalty: float = 0.5  # edges at a node cost 1 + penalty * |F| times their length
    drift: float = 1.5  # [rad] nodes that lie further from the manifold are left out
    searches: int = 100  # at most; each ends at a path, or at the first edge that turns out blocked
    step: float = 0.2  # [rad] between the states of an edge; a found path is refined to the space's own step
    collision_weight: float = 2.0  # [rad] cost of an edge's -log P(free), where there is a cloud


class RoadmapQuery:
    """One start and its goals on a roadmap, in a space."""

    def __init__(
        self,
        space: ConstrainedSpace,
        roadmap: Roadmap,
        start: np.ndarray,
        goals: np.ndarray,
        settings: RoadmapSettings,
        edges: EdgeArrays | None = None,
    ) -> None:
        """Link start (n,) and goals (k, n) to the roadmap; edges: the model of their validity, None to ignore it."""
        self._settings, self._space, self._arrays = settings, space, space.arrays._replace(step=settings.step)
        self._edges = without_cloud(len(start)) if edges is None else edges
        self._weight = 0.0 if edges is None else settings.collision_weight
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
            collision_weight=self._weight,
            nll=np.empty((count + 1, neighbours.shape[1] + len(goals))),
            known=np.zeros((count + 1, neighbours.shape[1] + len(goals)), dtype=np.int8),
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
        kernels.link_query(self._graph, np.empty(links, dtype=np.int32), np.empty(links))

    def add_nodes(self, added: np.ndarray) -> None:
        """Link more nodes (a, n) to the roadmap, to each other and to start and goals; verdicts stay."""
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

    def next_path(self, deadline: Deadline) -> JointPath | None:
        """The shortest path that is on the manifold and free, or None; each search counts as an iteration."""
        path, ends = np.empty(LONGEST_PATH, dtype=np.int64), np.empty(LONGEST_PATH, dtype=np.int64)
        states = np.empty((64 * LONGEST_PATH, self._graph.nodes.shape[1]))
        length, bad = 0, -1
        while self._left > 0 and deadline.spent() is None:
            kernels.block_state(self._graph, path, ends, length, bad)  # of a path that failed its fine check
            most = min(self._left, SEARCHES_AT_ONCE, deadline.rest().iterations or SEARCHES_AT_ONCE)
            size, length, searched = kernels.search(
                self._arrays, self._graph, self._edges, most, self._settings.drift, path, ends, states
            )
            self._space.reraise()
            self._left -= searched
            deadline.count(searched)
            self.searches += searched
            if size == kernels.NO_PATH:
                if searched < most:
                    break
                length = 0
                continue
            found, bad = self._space.checked_path(states[:size])
            if found is not None:
                return found
        return None

    @property
    def free_nodes(self) -> np.ndarray:
        """Rows (r,) of nodes found free so far."""
        return np.flatnonzero(self._graph.node[: self._count] == kernels.FREE)

    def configurations(self, rows: np.ndarray) -> np.ndarray:
        """Where nodes are now (r, n): projected, if they were visited."""
        return self._graph.nodes[rows]


@dataclass(frozen=True, eq=False)
class RoadmapPath:
    """A path through the roadmap, projected node by node; samples around the nodes found free when there is none.

    While there is no path, nodes near start and goals are added, which a dictionary may have none of.
    """

    roadmap: Roadmap
    name: str = "roadmap-cvq"
    settings: RoadmapSettings = field(default_factory=RoadmapSettings)
    uniform_share: float = 0.3  # of the samples that a search gets when the roadmap holds no path
    draws: int = 3  # how often nodes near start and goals are added while there is no path
    drawn: int = 128  # nodes added at once
    spread: float = 1.0  # [rad] largest standard deviation of those from an end
    edge_model: Callable[[Query, Observation], EdgeArrays] | None = None  # None: all edges cost their length
    oracle: bool = False  # blocked nodes and edges are known at no cost: the bound of all roadmaps

    def __call__(self, query: Query, observation: Observation) -> Proposal:
        """Search the roadmap with the query's constraint."""
        deadline, began = query.deadline, query.deadline.seconds
        edges = self.edge_model(query, observation) if self.edge_model else None
        timings = Timings(encode=deadline.seconds - began)
        asked = RoadmapQuery(query.space, self.roadmap, query.start, query.goals, self.settings, edges)
        if self.oracle:
            asked.avoid(self._searched_before(query))
        path = asked.next_path(deadline)
        for _ in range(self.draws):
            if path is not None or deadline.spent():
                break
            asked.add_nodes(self._near_ends(query))
            path = asked.next_path(deadline)
        free = asked.free_nodes
        free = free[free < len(self.roadmap.nodes)]
        means, covariances = asked.configurations(free), self.roadmap.covariances[free]
        around = GaussianMixture.equal(means, covariances, query.uniform, self.uniform_share, self.name)
        if path is not None:
            return Proposal(around, timings, vertices=len(free) + 2, path=path)
        lost = f"birrt around {len(free)} free nodes: no roadmap path after {asked.searches} searches"
        return Proposal(around, timings, vertices=len(free), fallback=lost)

    def _searched_before(self, query: Query) -> RoadmapQuery:
        """A query that has found its path, or that there is none, in a space of its own."""
        aside = ConstrainedSpace(query.space.problem, query.space.backend)
        before = RoadmapQuery(aside, self.roadmap, query.start, query.goals, self.settings)
        before.next_path(Deadline(query.deadline.budget, aside))
        return before

    def _near_ends(self, query: Query) -> np.ndarray:
        """Configurations on the manifold (at most `drawn`, n), half of them around the start, half around goals."""
        rng, robot = query.rng, query.space.robot
        centres = np.tile(query.start, (self.drawn, 1))
        centres[::2] = query.goals[rng.integers(len(query.goals), size=len(centres[::2]))]
        widths = rng.uniform(0.0, self.spread, (self.drawn, 1))
        draws = np.clip(centres + widths * rng.standard_normal(centres.shape), robot.lower, robot.upper)
        return draws[[query.space.project(q) for q in draws]]
