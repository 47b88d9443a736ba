"""Roadmaps: nodes and their links, made once a robot; and queries.

A roadmap holds configurations and straight links free of self-collision. They hold in every scene:
roadmaps are kept in the user's cache, and checked again when read. A query searches a roadmap
lazily in one scene under one constraint, see `lazy_roadmap`. Planners search it in turns with
trees, see `portfolio`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.caches import cached_arrays, sources_digest
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search import lazy_roadmap as kernels
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.planner_interface import Deadline
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace

TURN = 2.0 * np.pi  # [rad]
NODES = 1024
NEIGHBOURS = 20  # that each node is linked to, at most


@dataclass(frozen=True, eq=False)
class Roadmap:
    """Configurations to plan through, each linked to its nearest ones."""

    nodes: np.ndarray  # (N, n) [rad]
    neighbours: np.ndarray  # (N, k) int32, nodes near each, nearest first; -1 for none

    @staticmethod
    def of(nodes: np.ndarray, neighbours: int = 12) -> "Roadmap":
        """Link each node to its nearest ones; InvalidInputError when there are too few nodes."""
        if len(nodes) <= neighbours:
            raise InvalidInputError(f"a roadmap of {len(nodes)} nodes; give more than {neighbours}")
        own = (nodes**2).sum(axis=1)
        squares = own[:, None] + own - 2.0 * nodes @ nodes.T
        np.fill_diagonal(squares, np.inf)
        near = np.argpartition(squares, neighbours - 1, axis=1)[:, :neighbours]
        order = np.argsort(np.take_along_axis(squares, near, axis=1), axis=1, kind="stable")
        return Roadmap(nodes, np.take_along_axis(near, order, axis=1).astype(np.int32))

    @property
    def covariance(self) -> np.ndarray:
        """Covariance d^2 / n I (n, n) [rad^2] of samples around a node.

        d^2 is the mean squared distance of neighbouring nodes.
        """
        linked = self.neighbours[:, 0] >= 0
        squares = ((self.nodes[self.neighbours[linked, 0]] - self.nodes[linked]) ** 2).sum(axis=1)
        n = self.nodes.shape[1]
        return np.eye(n) * (squares.mean() if linked.any() else 1.0) / n

    def near(self, start: np.ndarray, robot: Robot) -> "Roadmap":
        """The same roadmap, hinges turned by whole turns as near to start (n,) as limits allow."""
        turns = robot.turning
        if not turns.any():
            return self
        nodes, low, high = self.nodes.copy(), robot.lower[turns], robot.upper[turns]
        turned = nodes[:, turns] + TURN * np.round((start[turns] - nodes[:, turns]) / TURN)
        nodes[:, turns] = turned + TURN * ((turned < low).astype(float) - (turned > high))
        return replace(self, nodes=nodes)


@lru_cache(maxsize=8)
def spread_roadmap(
    robot: Robot, attachments: tuple[Attachment, ...] = (), draw: int | None = None
) -> Roadmap:
    """NODES configurations over the joint ranges; fewer if most self-collide.

    Joints that turn more than once get one turn, see `Roadmap.near`. draw: seed of independent
    draws; None: a scrambled Halton sequence, which covers the ranges evenly.
    """
    return _kept(robot, attachments, f"{draw}".encode(), lambda space: _free_draws(space, draw))


def linked_roadmap(robot: Robot, attachments: tuple[Attachment, ...], nodes: np.ndarray) -> Roadmap:
    """The roadmap of those nodes (N, n) that are free of self-collision."""
    return _kept(robot, attachments, nodes.tobytes(), lambda space: nodes[space.valid_batch(nodes)])


def _kept(
    robot: Robot,
    attachments: tuple[Attachment, ...],
    made_of: bytes,
    nodes_of: Callable[[ConstrainedSpace], np.ndarray],
) -> Roadmap:
    """The roadmap of the nodes that a function returns, kept in the user's cache."""
    space = ConstrainedSpace(robot, Scene("empty", ()), attachments=attachments)
    geometry = robot_arrays(robot, attachments)
    parts = [sources_digest(Path(__file__)).encode(), robot.kinematics_digest.encode(), made_of]
    parts += [np.ascontiguousarray(array).tobytes() for array in (*geometry.pieces, *geometry[1:])]

    def make() -> dict[str, np.ndarray]:
        nodes = nodes_of(space)
        return {"nodes": nodes, "neighbours": _linked(space, nodes)}

    found = cached_arrays(
        "roadmaps", b" ".join(parts), make, lambda arrays: _is_roadmap(space, arrays)
    )
    return Roadmap(found["nodes"], found["neighbours"])


def _is_roadmap(space: ConstrainedSpace, arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether arrays are a roadmap of free configurations of a space's robot."""
    nodes, table, robot = arrays["nodes"], arrays["neighbours"], space.robot
    return bool(
        nodes.dtype == np.float64
        and table.dtype == np.int32
        and nodes.shape == (len(table), robot.dof)
        and table.ndim == 2
        and table.shape[1] <= NEIGHBOURS
        and len(nodes) <= NODES
        and ((nodes >= robot.lower) & (nodes <= robot.upper)).all()  # not nan
        and ((table >= -1) & (table < len(nodes))).all()
        and space.valid_batch(nodes).all()
    )


def _free_draws(space: ConstrainedSpace, draw: int | None) -> np.ndarray:
    """Free configurations (at most NODES, n)."""
    robot, turns = space.robot, space.robot.turning
    middle = 0.5 * (robot.lower + robot.upper)
    low = np.where(turns, middle - 0.5 * TURN, robot.lower)
    width = np.where(turns, TURN, robot.upper - robot.lower)
    rng = np.random.default_rng(draw or 0)
    if draw is None:
        from scipy.stats import qmc  # takes half a second to import

        halton = qmc.Halton(robot.dof, seed=rng)
    found = np.empty((0, robot.dof))
    for _ in range(32):
        if len(found) < NODES:
            unit = halton.random(NODES) if draw is None else rng.uniform(size=(NODES, robot.dof))
            states = np.ascontiguousarray(low + width * unit)
            found = np.concatenate([found, states[space.valid_batch(states)]])
    return found[:NODES].copy()


def _linked(space: ConstrainedSpace, nodes: np.ndarray) -> np.ndarray:
    """Nearest nodes (N, NEIGHBOURS) int32 of each that a free straight motion leads to, or -1.

    Hinges that turn more than once take the shorter turn.
    """
    turns = space.robot.turning
    table = np.full((len(nodes), NEIGHBOURS), -1, dtype=np.int32)
    for i, node in enumerate(nodes):
        change = nodes - node
        change[:, turns] -= TURN * np.round(change[:, turns] / TURN)
        squares = (change**2).sum(axis=1)
        squares[i] = np.inf
        tried = min(30, len(nodes) - 1)
        near = np.argpartition(squares, tried - 1)[:tried] if tried else np.empty(0, dtype=int)
        near = near[np.argsort(squares[near], kind="stable")]
        free = near[_motions_free(space, node, change[near])][:NEIGHBOURS]
        table[i, : len(free)] = free
    return table


def _motions_free(
    space: ConstrainedSpace, origin: np.ndarray, changes: np.ndarray, step: float = 0.2
) -> np.ndarray:
    """Whether motions from origin (n,) by changes (k, n) are free every step [rad], (k,)."""
    pieces = np.maximum(np.ceil(np.linalg.norm(changes, axis=1) / step), 1.0).astype(int)
    motion = np.repeat(np.arange(len(changes)), pieces - 1)
    first = np.cumsum(pieces - 1) - (pieces - 1)
    share = (np.arange(len(motion)) - first[motion] + 1) / pieces[motion]
    free = np.ones(len(changes), dtype=bool)
    free[motion[~space.valid_batch(origin + share[:, None] * changes[motion])]] = False
    return free


@dataclass(frozen=True)
class RoadmapSearchSettings:
    """How a roadmap is searched; defaults were chosen on the tuning environments."""

    links: int = 40  # nodes that the start and each goal are linked to
    penalty: float = 0.5  # edges at a node cost 1 + penalty * |F| times their length
    drift: float = 1.5  # [rad] nodes that lie further from the manifold are left out
    searches: int = 80  # at most; each ends at a path, or at the first edge that turns out blocked
    # A*'s estimate of what is left is the distance times this; above 1 fewer nodes are expanded
    greed: float = 4.0
    # [rad] between the states of an edge; a found path is refined to the space's own step
    step: float = 0.2


def scene_costs(space: ConstrainedSpace) -> EdgeCosts:
    """Edge costs in the scene of a space, from the distances that its checker has."""
    return EdgeCosts(space.arrays.scene.grid)


class RoadmapQuery:
    """One start and its goals on a roadmap, in a space."""

    def __init__(
        self,
        space: ConstrainedSpace,
        roadmap: Roadmap,
        start: np.ndarray,
        goals: np.ndarray,
        settings: RoadmapSearchSettings,
        costs: EdgeCosts,
        longest: float = np.inf,
        known: int = kernels.UNKNOWN,
    ) -> None:
        """Link start and goals to the roadmap.

        Args:
            space: the planning space.
            roadmap: nodes and links.
            start: (n,) [rad].
            goals: (k, n) [rad].
            settings: of the search.
            costs: of edges.
            longest: paths that cost more are not searched for [rad].
            known: verdict on all nodes; FREE ones are on the manifold.
        """
        self._space, self._settings, self._costs = space, settings, costs
        nodes, table = roadmap.nodes, roadmap.neighbours
        verdict = np.full(len(nodes), known, dtype=np.int8)
        count, total = len(nodes), len(nodes) + 1 + len(goals)
        links = min(settings.links, count)
        neighbours = np.full((count + 1, max(links, table.shape[1])), -1, dtype=np.int32)
        neighbours[:count, : table.shape[1]] = table
        self.graph = kernels.RoadmapArrays(
            nodes=np.concatenate([nodes, start[None], goals]),
            neighbours=neighbours,
            edge=np.zeros(neighbours.shape, dtype=np.int8),
            goal_edge=np.zeros((count + 1, len(goals)), dtype=np.int8),
            node=np.concatenate([verdict, np.full(1 + len(goals), kernels.FREE, dtype=np.int8)]),
            penalty=settings.penalty,
            longest=longest,
            clearance=np.full(total, np.inf),
            lowest=np.empty((count + 1, neighbours.shape[1] + len(goals))),
            known=np.zeros((count + 1, neighbours.shape[1] + len(goals)), dtype=np.int32),
            factor=np.zeros(total),
            to_go=np.empty(total),
            cost=np.empty(total),
            parent=np.empty(total, dtype=np.int32),
            slot=np.empty(total, dtype=np.int32),
            closed=np.empty(total, dtype=np.int8),
            heap=np.empty(32 * total),
            heap_edge=np.empty(32 * total, dtype=np.int32),
        )
        self._count, self._left, self.searches = count, settings.searches, 0
        kernels.link_query.unchecked(self.graph, np.empty(links, dtype=np.int32), np.empty(links))
        self.graph.to_go[:] *= settings.greed

    def avoid(self, known: "RoadmapQuery") -> None:
        """Leave out what another query, of the same nodes, found blocked."""
        for verdicts in ("edge", "goal_edge", "node"):
            blocked = getattr(known.graph, verdicts) == kernels.BLOCKED
            getattr(self.graph, verdicts)[blocked] = kernels.BLOCKED

    def next_path(self, deadline: Deadline, work: float = np.inf) -> JointPath | None:
        """The shortest free path, or None; work: at most, rows that A* expands counted, too."""
        path, ends = np.empty((2, 256), dtype=np.int64)  # longest path in nodes
        states = np.empty((64 * len(path), self.graph.nodes.shape[1]))
        arrays = self._space.arrays._replace(step=self._settings.step)
        length, bad = 0, -1
        most_work, block = self._space.work + work, 16 if work == np.inf else 4
        while self._left > 0 and self._space.work < most_work and deadline.spent() is None:
            # of a path that failed its fine check
            kernels.block_state.unchecked(self.graph, path, ends, length, bad)
            # searches before the clock is read
            most = min(self._left, block, deadline.rest().iterations or block)
            size, length, searched = kernels.search.unchecked(
                arrays, self.graph, self._costs, most, self._settings.drift, path, ends, states
            )
            self._space.reraise()
            self._left -= searched
            deadline.count(searched)
            self.searches += searched
            most_work -= searched * np.count_nonzero(self.graph.closed)
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
        return np.flatnonzero(self.graph.node[: self._count] == kernels.FREE)
