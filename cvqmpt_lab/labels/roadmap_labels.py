"""Labels on a roadmap: nodes and edges checked in random scenes, and shortest paths."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.labels.generation import (
    SceneRecipe,
    free_configurations,
    near_obstacles,
    unconstrained_space,
)
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.motion import edge_verdicts, motion_free
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.shards import (
    LABEL_ARRAYS,
    LINKS,
    ROADMAP_FILE,
    RoadmapGraph,
    packed,
)
from cvqmpt_lab.vqmpt.learned_sampler import dictionary_roadmap

# configurations of a scene between which paths are looked for
STARTS, GOALS = 16, 48
# state checks an edge, on average: scenes that need more have a wall millimetres from the base
CHECKS = 60


@dataclass(frozen=True)
class RoadmapRecipe(SceneRecipe):
    """Labels on the roadmap of a dictionary."""

    title: ClassVar = "Labels on a roadmap"
    columns: ClassVar = LABEL_ARRAYS

    labels: str = field(default="roadmap", init=False)
    model: str = "vq_mpt"  # name or folder of the dictionary's weights

    def check(self) -> None:
        """Refuse a robot that the dictionary is not of, or one without a roadmap."""
        roadmap_graph(self.model, robot_from_source(self.robot))

    def prepare(self, out: Path) -> None:
        """Write the roadmap, or check that the existing one is equal."""
        graph = roadmap_graph(self.model, robot_from_source(self.robot))
        if (out / ROADMAP_FILE).exists() and RoadmapGraph.read(out).digest != graph.digest:
            raise InvalidInputError(f"{out} holds labels of another roadmap; choose another --out")
        graph.write(out)

    def labelled(self, robot: Robot, scene: Scene, index: int) -> dict[str, np.ndarray] | None:
        """All nodes and edges checked, and shortest paths."""
        graph = roadmap_graph(self.model, robot)
        return roadmap_labels(robot, scene, graph, self.paths_per_scene, (self.seed, index))


@lru_cache(maxsize=1)
def roadmap_graph(model: str, robot: Robot) -> RoadmapGraph:
    """Codes of a dictionary as nodes, undirected edges, and which of these the robot allows.

    OtherRobotError for a robot that the dictionary is not of; InvalidInputError for a roadmap of
    fewer nodes than ends are linked to, or one whose edges are too long to check.
    """
    roadmap = dictionary_roadmap(model, robot)
    if len(roadmap.nodes) <= LINKS:
        raise InvalidInputError(
            f"{robot.name}'s roadmap has {len(roadmap.nodes)} nodes; labels need more than {LINKS}"
        )
    count, k = roadmap.neighbours.shape
    pairs = np.stack([np.repeat(np.arange(count), k), roadmap.neighbours.ravel()], axis=1)
    edges = np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int32)
    space = unconstrained_space(robot, Scene("nothing", ()))
    checked = verdicts(space, roadmap.nodes, edges, checks=100 * CHECKS)
    # although nothing is near
    if checked is None:
        raise InvalidInputError(
            f"nodes of {robot.name}'s roadmap are far apart; train its dictionary longer"
        )
    return RoadmapGraph(roadmap.nodes, edges, checked[1], *body_points(robot))


def body_points(robot: Robot, count: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Points that stand for the arm's body: centres of balls that cover the links.

    Each is the one farthest from those before it, on average over random configurations.

    Returns:
        The joint that moves each (k,), and where the point is in its frame (k, 3) [m].
    """
    geometry = robot_arrays(robot)
    rows = np.repeat(geometry.body_link, np.diff(geometry.body_start))
    used = (geometry.leaf >= 0) & (rows > 0)
    rows, offsets = rows[used], geometry.sphere[used, :3]
    states = robot.random_configurations(np.random.default_rng(0), 64)
    rotations, translations = link_poses(robot.kinematics, states)
    places = np.einsum("skij,kj->ski", rotations[:, rows], offsets) + translations[:, rows]
    chosen, away = [len(rows) - 1], np.full(len(rows), np.inf)
    while len(chosen) < min(count, len(rows)):
        apart = np.linalg.norm(places - places[:, chosen[-1:]], axis=2).mean(axis=0)
        away = np.minimum(away, apart)
        chosen.append(int(away.argmax()))
    chosen.sort()
    return rows[chosen] - 1, offsets[chosen]


def verdicts(
    space: ConstrainedSpace,
    nodes: np.ndarray,
    edges: np.ndarray,
    possible: np.ndarray | None = None,
    checks: int = CHECKS,
    margin: float = 0.002,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Whether nodes and edges are free.

    Args:
        space: unconstrained space of a scene.
        nodes: (N, n) [rad or m].
        edges: (E, 2) rows of nodes.
        possible: (E,) edges that may be free, others are not checked; None for all.
        checks: state checks an edge, on average, at most.
        margin: [m] that free motions keep from obstacles.

    Returns:
        (N,) and (E,) bool, or None after too many checks.
    """
    node_free = np.zeros(len(nodes), dtype=bool)
    edge_free = np.ones(len(edges), dtype=bool) if possible is None else possible.copy()
    arrays, most = space.arrays._replace(margin=margin), checks * len(edges)
    done = edge_verdicts(arrays, nodes, edges, node_free, edge_free, most)
    return (node_free, edge_free) if done else None


@lru_cache(maxsize=1)
def checks_of(robot: Robot, graph: RoadmapGraph) -> int:
    """Limit of state checks an edge in a scene: CHECKS, or more if an empty scene takes more."""
    space, checks = unconstrained_space(robot, Scene("nothing", ())), CHECKS
    while verdicts(space, graph.nodes, graph.edges, graph.edge_possible, checks) is None:
        checks *= 4
    return checks


def roadmap_labels(
    robot: Robot, scene: Scene, graph: RoadmapGraph, pairs: int, seed: Sequence[int]
) -> dict[str, np.ndarray] | None:
    """Check all of a roadmap in a scene, and find shortest paths between pairs of ends.

    Half of the starts and goals have the hand near an obstacle. Pairs whose straight motion is free
    are left out. Ends of links are the starts, the goals and configurations among obstacles.

    Args:
        robot: the arm.
        scene: what it must not touch.
        graph: the roadmap.
        pairs: of start and goal, at most.
        seed: of all that is drawn.

    Returns:
        Arrays of `training.shards.LABEL_ARRAYS` of this scene alone; None after too many checks.
    """
    space, rng = unconstrained_space(robot, scene), np.random.default_rng(seed)
    checks = checks_of(robot, graph)
    checked = verdicts(space, graph.nodes, graph.edges, graph.edge_possible, checks)
    if checked is None:
        return None
    node_free, edge_free = checked
    ends = _ends(space, rng)
    starts, goals = ends[:STARTS], ends[STARTS:]
    every = np.argwhere(np.ones((len(starts), len(goals)), dtype=bool))
    linked_ends = np.concatenate([ends, _confined(space, np.random.default_rng((*seed, 1)))])
    # squared distances: |end|^2 + |node|^2 - 2 <end, node>
    lengths = (linked_ends**2).sum(1)[:, None] + (graph.nodes**2).sum(1)
    squares = lengths - 2.0 * linked_ends @ graph.nodes.T
    near = np.argpartition(squares, LINKS, axis=1)[:, :LINKS]
    nodes, count = np.concatenate([graph.nodes, linked_ends]), len(graph.nodes)
    of_end = np.repeat(count + np.arange(len(linked_ends)), LINKS)
    links = np.stack([of_end, near.ravel()], axis=1).astype(np.int32)
    # near self-collision a link needs more checks than an edge that the robot itself allows
    linked = verdicts(space, nodes, links, checks=600)
    if linked is None:
        return None
    link_free = linked[1]
    nodes, links = nodes[: count + len(ends)], links[: LINKS * len(ends)]
    cost, before = _shortest_paths(
        nodes, graph.edges[edge_free], links[link_free[: len(links)]], count
    )
    rows: list[tuple[int, int]] = []
    for s, g in rng.permutation(every).tolist():
        if len(rows) < pairs and not motion_free(space.arrays, starts[s], goals[g]):
            rows.append((s, g))
    codes = [_codes(before[s], count + STARTS + g) for s, g in rows]
    s, g = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    return {
        "node_free": np.packbits(node_free)[None],
        "edge_free": np.packbits(edge_free)[None],
        "link_start": np.array([0, len(linked_ends)]),
        "link_end": packed(linked_ends, robot.lower, robot.upper),
        "link_code": near,
        "link_free": link_free.reshape(near.shape),
        "path_scene": np.zeros(len(codes), int),
        "ends": packed(np.stack([starts[s], goals[g]], axis=1), robot.lower, robot.upper),
        "code_start": np.cumsum([0, *map(len, codes)]),
        "codes": np.concatenate([np.empty(0, int), *codes]),
        "straight": np.linalg.norm(goals[g] - starts[s], axis=1),
        "cost": cost[s, g],
    }


def _ends(space: ConstrainedSpace, rng: np.random.Generator) -> np.ndarray:
    """Free configurations (at most STARTS + GOALS, n), half of them near an obstacle."""
    candidates = free_configurations(space, rng)
    near = near_obstacles(space, candidates)
    wanted = (STARTS + GOALS) // 2
    close, rest = candidates[near], candidates[~near]
    ends = np.concatenate([close[:wanted], rest, close[wanted:]])[: STARTS + GOALS]
    return rng.permutation(ends)


def _confined(
    space: ConstrainedSpace, rng: np.random.Generator, most: int = 32, around: int = 12
) -> np.ndarray:
    """Free configurations among obstacles (at most `most`, n).

    Of those with the hand near an obstacle, the ones with the most collisions among `around`
    normally distributed neighbours.
    """
    robot = space.robot
    candidates = robot.random_configurations(rng, 1024)
    candidates = candidates[near_obstacles(space, candidates)]
    candidates = candidates[space.valid_batch(candidates)]
    offsets = rng.standard_normal((len(candidates), around, robot.dof))
    others = np.clip(candidates[:, None] + 0.25 * offsets, robot.lower, robot.upper)
    free = space.valid_batch(others.reshape(-1, robot.dof)).reshape(len(candidates), around)
    return candidates[np.argsort(free.sum(axis=1), kind="stable")[:most]]


def _shortest_paths(
    nodes: np.ndarray, edges: np.ndarray, links: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Shortest paths from every start over edges both ways to every goal, by Dijkstra.

    Args:
        nodes: (N + s + g, n) [rad]: the roadmap's, STARTS starts, then goals.
        edges: (E, 2) rows that are joined.
        links: (l, 2) rows of starts and goals, and of nodes.
        count: N.

    Returns:
        Costs (s, g) [rad], inf if there is no path, and each row's predecessor on the path from a
        start (s, rows), negative if there is none.
    """
    leaving = links[:, 0] < count + STARTS
    pairs = np.concatenate([edges, edges[:, ::-1], links[leaving], links[~leaving][:, ::-1]])
    length = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    graph = csr_array((length, (pairs[:, 0], pairs[:, 1])), shape=(len(nodes), len(nodes)))
    starts = np.arange(count, min(count + STARTS, len(nodes)))
    if len(starts) == 0:
        return np.empty((0, 0)), np.empty((0, len(nodes)))
    cost, before = dijkstra(graph, indices=starts, return_predecessors=True)
    return cost[:, count + STARTS :], before


def _codes(before: np.ndarray, goal: int) -> list[int]:
    """Codes on the path to row `goal`; empty if there is no path."""
    rows, row = [], int(before[goal])
    while row >= 0:
        rows.append(row)
        row = int(before[row])
    # the last one is the start itself
    return rows[-2::-1]
