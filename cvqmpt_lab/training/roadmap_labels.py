"""Labels on a roadmap: free nodes and edges in random scenes, and shortest paths."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.search.motion import edge_verdicts, motion_free, states_valid
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.generation import (
    SceneRecipe,
    free_configurations,
    near_obstacles,
)
from cvqmpt_lab.training.shards import (
    LABEL_ARRAYS,
    LINKS_PER_END,
    RoadmapGraph,
    packed,
)
from cvqmpt_lab.vqmpt.learned_sampler import dictionary_roadmap

# starts and goals drawn in each scene; shortest paths lead from starts to goals
STARTS, GOALS = 16, 48
# Limit of state checks per edge, on average over a scene's edges. A scene that needs more has an
# obstacle a few millimetres from the robot's base.
CHECKS_PER_EDGE = 60


@dataclass(frozen=True)
class RoadmapRecipe(SceneRecipe):
    """Recipe of a dataset of labels on the roadmap of a dictionary."""

    title: ClassVar = "Labels on a roadmap"
    columns: ClassVar = LABEL_ARRAYS

    labels: str = field(default="roadmap", init=False)
    model: str = "vq_mpt"  # name or folder of the dictionary's weights

    def check(self) -> None:
        """Raise the errors of `roadmap_graph` before anything is written."""
        roadmap_graph(self.model, robot_from_source(self.robot))

    def prepare(self, out: Path) -> None:
        """Write the roadmap; InvalidInputError if the folder has a roadmap with other nodes."""
        graph = roadmap_graph(self.model, robot_from_source(self.robot))
        written = (out / RoadmapGraph.file_name).exists()
        if written and RoadmapGraph.read(out).digest != graph.digest:
            raise InvalidInputError(f"{out} holds labels of another roadmap; choose another --out")
        graph.write(out)

    def labelled(self, robot: Robot, scene: Scene, index: int) -> dict[str, np.ndarray] | None:
        """Return the arrays of `roadmap_labels` for the scene of this index."""
        graph = roadmap_graph(self.model, robot)
        return roadmap_labels(robot, scene, graph, self.paths_per_scene, (self.seed, index))


@lru_cache(maxsize=1)
def roadmap_graph(model: str, robot: Robot) -> RoadmapGraph:
    """Build a dictionary's roadmap: a node for each code, and undirected edges.

    Args:
        model: name or folder of the dictionary's weights.
        robot: the arm.

    Raises:
        OtherRobotError: the dictionary is for another robot.
        InvalidInputError: the roadmap has too few nodes, or edges too long to be checked.
    """
    roadmap = dictionary_roadmap(model, robot)
    if len(roadmap.nodes) <= LINKS_PER_END:
        raise InvalidInputError(
            f"{robot.name}'s roadmap has {len(roadmap.nodes)} nodes; labels need more than "
            f"{LINKS_PER_END}: choose a dictionary with more codes"
        )
    count, k = roadmap.neighbours.shape
    pairs = np.stack([np.repeat(np.arange(count), k), roadmap.neighbours.ravel()], axis=1)
    edges = np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int32)
    space = ConstrainedSpace(World(robot, Scene("nothing", ())))
    checked = verdicts(space, roadmap.nodes, edges, checks=100 * CHECKS_PER_EDGE)
    # in an empty scene, only very long edges need so many checks
    if checked is None:
        raise InvalidInputError(
            f"nodes of {robot.name}'s roadmap are far apart; train its dictionary longer"
        )
    _, edge_possible = checked
    return RoadmapGraph(roadmap.nodes, edges, edge_possible, *body_points(robot))


def body_points(robot: Robot, count: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Choose points that represent the arm's body, among centres of the spheres around its links.

    They are chosen by farthest point sampling, with distances averaged over random configurations:
    the next point is argmax_i min_j mean_q |p_i(q) - p_j(q)|, where j are the points chosen before.

    Args:
        robot: the arm.
        count: number of points; all centres if the arm has fewer spheres.

    Returns:
        Index of the joint that moves each point (k,), and position of each point in that joint's
        frame (k, 3) [m].
    """
    geometry = robot_arrays(robot)
    rows = np.repeat(geometry.body_link, np.diff(geometry.body_start))
    # leaves of the sphere trees of moving links; pose row 0 is the fixed base
    used = (geometry.leaf >= 0) & (rows > 0)
    rows, offsets = rows[used], geometry.sphere[used, :3]
    states = robot.random_configurations(np.random.default_rng(0), 64)
    rotations, translations = link_poses(robot.kinematics, states)
    points = np.einsum("skij,kj->ski", rotations[:, rows], offsets) + translations[:, rows]
    chosen, to_chosen = [len(rows) - 1], np.full(len(rows), np.inf)
    while len(chosen) < min(count, len(rows)):
        to_last = np.linalg.norm(points - points[:, chosen[-1:]], axis=2).mean(axis=0)
        to_chosen = np.minimum(to_chosen, to_last)
        chosen.append(int(to_chosen.argmax()))
    chosen.sort()
    return rows[chosen] - 1, offsets[chosen]


def verdicts(
    space: ConstrainedSpace,
    nodes: np.ndarray,
    edges: np.ndarray,
    possible: np.ndarray | None = None,
    checks: int = CHECKS_PER_EDGE,
    margin: float = 0.002,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Check which nodes and edges are free of collision.

    Args:
        space: unconstrained space of a scene.
        nodes: (N, n) [rad or m].
        edges: (E, 2), rows of the two nodes of each edge.
        possible: (E,) bool, False for edges that are known to collide; None if none are known.
        checks: limit of state checks per edge, on average.
        margin: distance that free motions keep from obstacles [m].

    Returns:
        Whether each node (N,) and each edge (E,) is free, or None if the limit was exceeded.
    """
    node_free = np.zeros(len(nodes), dtype=bool)
    edge_free = np.ones(len(edges), dtype=bool) if possible is None else possible.copy()
    arrays = space.arrays._replace(margin=margin)
    states_valid(arrays, nodes, node_free)
    left = checks * len(edges) - len(nodes)
    done = edge_verdicts(arrays, nodes, edges, node_free, edge_free, left)
    return (node_free, edge_free) if done else None


@lru_cache(maxsize=1)
def checks_of(robot: Robot, graph: RoadmapGraph) -> int:
    """Limit of state checks per edge: multiplied by 4 until it suffices in an empty scene."""
    space = ConstrainedSpace(World(robot, Scene("nothing", ())))
    checks = CHECKS_PER_EDGE
    while verdicts(space, graph.nodes, graph.edges, graph.edge_possible, checks) is None:
        checks *= 4
    return checks


def roadmap_labels(
    robot: Robot, scene: Scene, graph: RoadmapGraph, pairs: int, seed: Sequence[int]
) -> dict[str, np.ndarray] | None:
    """Check all nodes and edges of a roadmap in a scene, and find shortest paths on it.

    Paths lead from random starts to random goals; half of the starts and goals have the hand near
    an obstacle. Pairs of start and goal whose straight motion is free are left out. A link joins a
    configuration to one of its `LINKS_PER_END` nearest nodes. Starts, goals and configurations
    among obstacles are linked.

    Args:
        robot: the arm.
        scene: obstacles.
        graph: the roadmap.
        pairs: maximum number of pairs of start and goal.
        seed: seed of all random numbers.

    Returns:
        Arrays of `shards.LABEL_ARRAYS` of this scene, or None if it needs too many state checks.
    """
    space = ConstrainedSpace(World(robot, scene))
    rng = np.random.default_rng(seed)
    checks = checks_of(robot, graph)
    checked = verdicts(space, graph.nodes, graph.edges, graph.edge_possible, checks)
    if checked is None:
        return None
    node_free, edge_free = checked
    ends = _ends(space, rng)
    starts, goals = ends[:STARTS], ends[STARTS:]
    linked_ends = np.concatenate([ends, _confined(space, np.random.default_rng((*seed, 1)))])
    # squared distances: |end|^2 + |node|^2 - 2 <end, node>
    norms = (linked_ends**2).sum(1)[:, None] + (graph.nodes**2).sum(1)
    squares = norms - 2.0 * linked_ends @ graph.nodes.T
    near = np.argpartition(squares, LINKS_PER_END, axis=1)[:, :LINKS_PER_END]
    nodes, count = np.concatenate([graph.nodes, linked_ends]), len(graph.nodes)
    end_rows = np.repeat(count + np.arange(len(linked_ends)), LINKS_PER_END)
    links = np.stack([end_rows, near.ravel()], axis=1).astype(np.int32)
    # links near self-collision need more checks than edges that are free in an empty scene
    linked = verdicts(space, nodes, links, checks=600)
    if linked is None:
        return None
    _, link_free = linked
    # paths start and end at starts and goals, not at configurations among obstacles
    nodes, links = nodes[: count + len(ends)], links[: LINKS_PER_END * len(ends)]
    cost, predecessors = _shortest_paths(
        nodes, graph.edges[edge_free], links[link_free[: len(links)]], count
    )
    all_pairs = np.argwhere(np.ones((len(starts), len(goals)), dtype=bool))
    chosen: list[tuple[int, int]] = []
    for s, g in rng.permutation(all_pairs).tolist():
        if len(chosen) < pairs and not motion_free(space.arrays, starts[s], goals[g]):
            chosen.append((s, g))
    codes = [_codes(predecessors[s], count + STARTS + g) for s, g in chosen]
    s, g = np.array(chosen, dtype=np.int64).reshape(-1, 2).T
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
    """Draw free configurations (k, n), k <= STARTS + GOALS; half have the hand near an obstacle."""
    candidates = free_configurations(space, rng)
    near = near_obstacles(space, candidates)
    wanted = (STARTS + GOALS) // 2
    close, rest = candidates[near], candidates[~near]
    ends = np.concatenate([close[:wanted], rest, close[wanted:]])[: STARTS + GOALS]
    return rng.permutation(ends)


def _confined(
    space: ConstrainedSpace, rng: np.random.Generator, most: int = 32, around: int = 12
) -> np.ndarray:
    """Draw free configurations among obstacles (k, n), k <= most.

    Candidates are random free configurations with the hand near an obstacle. Those with the most
    collisions among `around` neighbours are kept. Neighbours are drawn from a Gaussian with a
    standard deviation of 0.25 rad around the candidate.
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
    """Find shortest paths from every start to every goal; edges are used in both directions.

    Args:
        nodes: (N + s + g, n) [rad]: N nodes of the roadmap, s <= STARTS starts, then g goals.
        edges: (E, 2), rows of `nodes`: the free edges of the roadmap.
        links: (l, 2), rows of `nodes`: a start or goal, and a node of the roadmap.
        count: N.

    Returns:
        Lengths (s, g) [rad], inf if there is no path, and the predecessor of each row on the path
        from each start (s, N + s + g), negative if there is none.
    """
    # paths lead from starts to nodes, and from nodes to goals
    leaving = links[:, 0] < count + STARTS
    pairs = np.concatenate([edges, edges[:, ::-1], links[leaving], links[~leaving][:, ::-1]])
    length = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    graph = csr_array((length, (pairs[:, 0], pairs[:, 1])), shape=(len(nodes), len(nodes)))
    starts = np.arange(count, min(count + STARTS, len(nodes)))
    if len(starts) == 0:
        return np.empty((0, 0)), np.empty((0, len(nodes)))
    cost, predecessors = dijkstra(graph, indices=starts, return_predecessors=True)
    return cost[:, count + STARTS :], predecessors


def _codes(predecessors: np.ndarray, goal: int) -> list[int]:
    """Return the codes on the path to row `goal`, in order; empty if there is no path.

    predecessors: (rows,), predecessor of each row, see `_shortest_paths`.
    """
    rows, row = [], int(predecessors[goal])
    while row >= 0:
        rows.append(row)
        row = int(predecessors[row])
    return rows[-2::-1]  # reversed, without the start, which is the last row
