"""Roadmaps: nodes and links, made once for a robot; and queries.

A roadmap consists of configurations and straight links without self-collision. Scenes do not change
it, so it is stored in the user's cache; it is checked again when it is read. A query searches a
roadmap lazily in one scene under one constraint, see `lazy_roadmap`. Planners alternate between the
search of a roadmap and trees, see `portfolio`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.caches import cached_arrays, sources_digest
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import nearest_turn
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.search import lazy_roadmap as kernels
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.planner_interface import Deadline
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace

ROADMAP_NODES = 1024  # largest number of nodes
ROADMAP_NEIGHBOURS = 20  # largest number of links of a node


@dataclass(frozen=True, eq=False)
class Roadmap:
    """Configurations, each linked to its nearest ones."""

    nodes: np.ndarray  # (N, n) [rad or m]
    neighbours: np.ndarray  # (N, k) int32, nodes linked to each one, nearest first; -1: no link

    @staticmethod
    def of(nodes: np.ndarray, neighbours: int = 12) -> "Roadmap":
        """Link each node to its nearest ones; refuse too few nodes."""
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

        d^2 is the mean squared distance of a node to its nearest neighbour.
        """
        linked = self.neighbours[:, 0] >= 0
        squares = ((self.nodes[self.neighbours[linked, 0]] - self.nodes[linked]) ** 2).sum(axis=1)
        n = self.nodes.shape[1]
        return np.eye(n) * (squares.mean() if linked.any() else 1.0) / n

    def near(self, start: np.ndarray, robot: Robot) -> "Roadmap":
        """Move hinges by whole turns, as near to a start (n,) as limits allow."""
        turns = robot.turning
        if not turns.any():
            return self
        turned = nearest_turn(self.nodes[:, turns], start[turns])
        too_low, too_high = turned < robot.lower[turns], turned > robot.upper[turns]
        nodes = self.nodes.copy()
        nodes[:, turns] = turned + 2.0 * np.pi * (too_low.astype(float) - too_high)
        return replace(self, nodes=nodes)


@lru_cache(maxsize=8)
def spread_roadmap(
    robot: Robot, attachments: tuple[Attachment, ...] = (), draw: int | None = None
) -> Roadmap:
    """Return a roadmap of ROADMAP_NODES configurations; of fewer if most are in self-collision.

    Joints with a range of more than one turn are sampled over one turn, see `Roadmap.near`.

    Args:
        robot: the robot.
        attachments: bodies that it carries.
        draw: seed of independent draws; None: a scrambled Halton sequence, which covers the joint
            ranges evenly.
    """
    return _cached_roadmap(
        robot, attachments, f"{draw}".encode(), lambda space: _free_draws(space, draw)
    )


def linked_roadmap(robot: Robot, attachments: tuple[Attachment, ...], nodes: np.ndarray) -> Roadmap:
    """Return the roadmap of those nodes (N, n) that are free of self-collision."""

    def free_nodes(space: ConstrainedSpace) -> np.ndarray:
        return nodes[space.valid_batch(nodes)]

    return _cached_roadmap(robot, attachments, nodes.tobytes(), free_nodes)


def _cached_roadmap(
    robot: Robot,
    attachments: tuple[Attachment, ...],
    made_of: bytes,
    nodes_of: Callable[[ConstrainedSpace], np.ndarray],
) -> Roadmap:
    """Read a roadmap from the user's cache, or make it and store it there.

    Args:
        robot: the robot.
        attachments: bodies that it carries.
        made_of: bytes that identify the nodes.
        nodes_of: makes the nodes in the robot's space without obstacles.
    """
    world = World(robot, Scene("empty", ()), attachments)
    space, geometry = ConstrainedSpace(world), world.robot_arrays
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
        and table.shape[1] <= ROADMAP_NEIGHBOURS
        and len(nodes) <= ROADMAP_NODES
        and ((nodes >= robot.lower) & (nodes <= robot.upper)).all()  # not nan
        and ((table >= -1) & (table < len(nodes))).all()
        and space.valid_batch(nodes).all()
    )


def _free_draws(space: ConstrainedSpace, draw: int | None) -> np.ndarray:
    """Draw free configurations (at most ROADMAP_NODES, n); draw: see `spread_roadmap`."""
    robot, turns = space.robot, space.robot.turning
    middle = 0.5 * (robot.lower + robot.upper)
    low = np.where(turns, middle - np.pi, robot.lower)
    width = np.where(turns, 2.0 * np.pi, robot.upper - robot.lower)
    rng = np.random.default_rng(draw or 0)
    if draw is None:
        from scipy.stats import qmc  # takes half a second to import

        halton = qmc.Halton(robot.dof, seed=rng)
    found = np.empty((0, robot.dof))
    for _ in range(32):
        if len(found) < ROADMAP_NODES:
            if draw is None:
                unit = halton.random(ROADMAP_NODES)
            else:
                unit = rng.uniform(size=(ROADMAP_NODES, robot.dof))
            states = np.ascontiguousarray(low + width * unit)
            found = np.concatenate([found, states[space.valid_batch(states)]])
    return found[:ROADMAP_NODES].copy()


def _linked(space: ConstrainedSpace, nodes: np.ndarray) -> np.ndarray:
    """Return links (N, ROADMAP_NEIGHBOURS) int32 of each node to the nearest ones, or -1.

    Straight motions along links are free. Hinges with a range of more than one turn move in the
    direction of the shorter motion.
    """
    turns = space.robot.turning
    table = np.full((len(nodes), ROADMAP_NEIGHBOURS), -1, dtype=np.int32)
    for i, node in enumerate(nodes):
        change = nodes - node
        change[:, turns] = nearest_turn(change[:, turns], 0.0)
        squares = (change**2).sum(axis=1)
        squares[i] = np.inf
        tried = min(30, len(nodes) - 1)
        near = np.argpartition(squares, tried - 1)[:tried] if tried else np.empty(0, dtype=int)
        near = near[np.argsort(squares[near], kind="stable")]
        free = near[_motions_free(space, node, change[near])][:ROADMAP_NEIGHBOURS]
        table[i, : len(free)] = free
    return table


def _motions_free(
    space: ConstrainedSpace, origin: np.ndarray, changes: np.ndarray, step: float = 0.2
) -> np.ndarray:
    """Whether straight motions are free of collision, (k,) bool.

    Args:
        space: the robot's space.
        origin: first state of all motions (n,) [rad or m].
        changes: from the first to the last state of each motion (k, n) [rad or m].
        step: distance of the states that are checked [rad].
    """
    pieces = np.maximum(np.ceil(np.linalg.norm(changes, axis=1) / step), 1.0).astype(int)
    motion = np.repeat(np.arange(len(changes)), pieces - 1)
    first = np.cumsum(pieces - 1) - (pieces - 1)
    share = (np.arange(len(motion)) - first[motion] + 1) / pieces[motion]
    free = np.ones(len(changes), dtype=bool)
    free[motion[~space.valid_batch(origin + share[:, None] * changes[motion])]] = False
    return free


@dataclass(frozen=True)
class RoadmapSearchSettings:
    """Settings of a roadmap search; defaults were chosen on the tuning environments."""

    links: int = 40  # number of nodes that the start and each goal are linked to
    penalty: float = 0.5  # edge lengths are multiplied by 1 + penalty * |F|
    drift: float = 1.5  # nodes further from the manifold are blocked [rad]
    searches: int = 80  # largest number of A* searches; each ends with a path or a blocked edge
    # A* estimates the remaining cost by greed * distance; above 1, fewer nodes are expanded
    greed: float = 4.0
    # largest distance of an edge's states [rad]; a path is refined to the space's step
    step: float = 0.2


def scene_costs(space: ConstrainedSpace) -> EdgeCosts:
    """Return edge costs from the distance grid of a space's scene."""
    return EdgeCosts(space.arrays.scene.grid)


class RoadmapQuery:
    """A search from one start to its goals through a roadmap."""

    def __init__(
        self,
        space: ConstrainedSpace,
        roadmap: Roadmap,
        start: np.ndarray,
        goals: np.ndarray,
        settings: RoadmapSearchSettings,
        costs: EdgeCosts,
        longest: float = np.inf,
        verdict: int = kernels.UNCHECKED,
    ) -> None:
        """Link start and goals to the roadmap.

        Args:
            space: the planning space.
            roadmap: nodes and links.
            start: (n,) [rad or m].
            goals: (k, n) [rad or m].
            settings: settings of the search.
            costs: costs of edges.
            longest: paths that cost as much or more are not searched for [rad].
            verdict: on all nodes; CHECKED_FREE: they are free and on the manifold.
        """
        self._space, self._settings, self._costs = space, settings, costs
        nodes, table = roadmap.nodes, roadmap.neighbours
        node = np.full(len(nodes), verdict, dtype=np.int8)
        ends = np.full(1 + len(goals), kernels.CHECKED_FREE, dtype=np.int8)
        count, total = len(nodes), len(nodes) + 1 + len(goals)
        links = min(settings.links, count)
        neighbours = np.full((count + 1, max(links, table.shape[1])), -1, dtype=np.int32)
        neighbours[:count, : table.shape[1]] = table
        exits = neighbours.shape[1] + len(goals)
        self.graph = kernels.RoadmapArrays(
            nodes=np.concatenate([nodes, start[None], goals]),
            neighbours=neighbours,
            edge=np.zeros(neighbours.shape, dtype=np.int8),
            goal_edge=np.zeros((count + 1, len(goals)), dtype=np.int8),
            node=np.concatenate([node, ends]),
            penalty=settings.penalty,
            longest=longest,
            clearance=np.full(total, np.inf),
            lowest=np.empty((count + 1, exits)),
            clearances_read=np.zeros((count + 1, exits), dtype=np.int32),
            end_state=np.zeros((count + 1, exits), dtype=np.int8),
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
        """Block all nodes and edges that another query of the same roadmap found blocked."""
        for verdicts in ("edge", "goal_edge", "node"):
            blocked = getattr(known.graph, verdicts) == kernels.BLOCKED
            getattr(self.graph, verdicts)[blocked] = kernels.BLOCKED

    def next_path(self, deadline: Deadline, work: float = np.inf) -> JointPath | None:
        """Search for the shortest free path.

        Args:
            deadline: end of the time limit of the run.
            work: limit of the work of this call, in units of `ConstrainedSpace.work`; each node
                that A* expands counts as 1, too.

        Returns:
            A path that passed the fine check, or None.
        """
        path, ends = np.empty((2, 256), dtype=np.int64)  # for paths of at most 256 nodes
        states = np.empty((64 * len(path), self.graph.nodes.shape[1]))
        proven = np.empty(len(states), dtype=bool)
        arrays = self._space.arrays._replace(step=self._settings.step)
        most_work, block = self._space.work + work, 16 if work == np.inf else 4
        while self._left > 0 and self._space.work < most_work and deadline.spent() is None:
            # number of searches before the clock is read
            most = min(self._left, block, deadline.rest().iterations or block)
            size, length, searched = kernels.search.unchecked(
                arrays,
                self.graph,
                self._costs,
                most,
                self._settings.drift,
                path,
                ends,
                states,
                proven,
            )
            self._space.reraise()
            self._left -= searched
            deadline.count(searched)
            self.searches += searched
            most_work -= searched * np.count_nonzero(self.graph.closed)
            if size == kernels.NO_PATH:
                if searched < most:
                    break
                continue
            found, bad = self._space.checked_path(states[:size], proven[: size - 1])
            kernels.store_check.unchecked(self.graph, path, ends, length, proven, bad)
            if found is not None:
                return found
        return None

    @property
    def free_nodes(self) -> np.ndarray:
        """Rows (r,) of the nodes that are known to be free."""
        return np.flatnonzero(self.graph.node[: self._count] == kernels.CHECKED_FREE)
