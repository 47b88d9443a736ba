"""What a whole roadmap is worth in one scene: every node and edge checked, and shortest paths through it.

Labels that are functions of the scene: of start and goal anywhere, the codes on the shortest path, by Dijkstra.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cvqmpt_lab.kernels.search.edge_verdicts import edge_verdicts
from cvqmpt_lab.kernels.search.motion import motion_free
from cvqmpt_lab.planning.code_graph import CodeEdges, nearest_rows
from cvqmpt_lab.planning.roadmap import Roadmap
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.training.shards import RoadmapGraph
from experiments.labels.labelled_scenes import (
    CANDIDATES,
    near_obstacles,
    packed,
    scene_shapes,
    unconstrained_space,
)

STARTS, GOALS = 16, 48  # configurations of a scene between which paths are looked for
LINKS = 20  # nodes that each is linked to
MARGIN = 0.002  # [m] that free motions keep from obstacles
CHECKS = 60  # state checks an edge, on average: scenes that need more have a wall millimetres from the base


@dataclass(frozen=True, eq=False)
class RoadmapLabels:
    """What training learns from one scene; p pairs of start and goal, codes of all paths in a row."""

    robot: Robot
    scene: Scene
    node_free: np.ndarray
    """(N,) bool."""
    edge_free: np.ndarray
    """(E,) bool."""
    ends: np.ndarray
    """(p, 2, n) starts and goals [rad]."""
    codes: list[np.ndarray]
    """Of each path, (k,); none where no path was found."""
    cost: np.ndarray
    """(p,) length of the shortest path [rad], inf where there is none."""
    differs: np.ndarray
    """(p,) bool: its codes are others than those of the shortest path that ignores the scene."""


@dataclass(frozen=True, eq=False)
class Paths:
    """Shortest paths from every start to every goal."""

    cost: np.ndarray
    """(s, g) [rad], inf where there is none."""
    before: np.ndarray
    """(s, rows) row before each row on the way from a start, negative where there is none."""
    first_goal: int
    """Row of goal 0; smaller ones below the number of nodes are codes."""

    def codes(self, start: int, goal: int) -> np.ndarray:
        """Codes (k,) from a start to a goal, none where there is no path."""
        rows, row = [], int(self.before[start, self.first_goal + goal])
        while row >= 0:
            rows.append(row)
            row = int(self.before[start, row])
        return np.array(rows[-2::-1], np.int64)  # the last one is the start itself


def roadmap_graph(robot: Robot, roadmap: Roadmap) -> RoadmapGraph:
    """Nodes and undirected edges of a roadmap, and which of them the robot itself allows."""
    edges = CodeEdges.of(roadmap).edges
    space = unconstrained_space(robot, Scene("nothing", ()))
    checked = verdicts(space, roadmap.nodes, edges)
    assert checked is not None  # nothing is near
    own_node, own_edge = checked
    return RoadmapGraph(roadmap.nodes, edges, own_node, own_edge)


def verdicts(
    space: ConstrainedSpace, nodes: np.ndarray, edges: np.ndarray, possible: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Whether nodes (N, n) and edges (E, 2) keep MARGIN, (N,) and (E,) bool, or None after too many CHECKS.

    possible: edges (E,) that may; others are not checked.
    """
    node_free = np.zeros(len(nodes), dtype=bool)
    edge_free = np.ones(len(edges), dtype=bool) if possible is None else possible.copy()
    arrays, most = space.arrays._replace(margin=MARGIN), CHECKS * len(edges)
    done = edge_verdicts(arrays, nodes, edges, node_free, edge_free, most)
    return (node_free, edge_free) if done else None


def roadmap_labels(
    robot: Robot, scene: Scene, graph: RoadmapGraph, pairs: int, seed: Sequence[int]
) -> RoadmapLabels | None:
    """Check all of a roadmap in a scene, and find shortest paths between `pairs` pairs; None: too dear, see CHECKS.

    Half of the starts and goals have the hand near an obstacle. Pairs whose straight motion is free are left out.
    """
    space, rng = unconstrained_space(robot, scene), np.random.default_rng(seed)
    checked = verdicts(space, graph.nodes, graph.edges, graph.edge_possible)
    if checked is None:
        return None
    node_free, edge_free = checked
    ends = _ends(space, rng)
    every = np.argwhere(np.ones((len(ends[:STARTS]), len(ends[STARTS:])), dtype=bool))
    links = links_to_nearest(graph.nodes, ends)
    nodes = np.concatenate([graph.nodes, ends])
    linked = verdicts(space, nodes, links)
    if linked is None:
        return None
    link_free = linked[1]
    found = shortest_paths(nodes, graph.edges[edge_free], links[link_free], len(graph.nodes))
    blind = shortest_paths(nodes, graph.edges[graph.edge_possible], links, len(graph.nodes))
    kept: list[tuple[int, int]] = []
    for s, g in rng.permutation(every).tolist():
        if len(kept) < pairs and not motion_free(space.arrays, ends[s], ends[STARTS + g]):
            kept.append((s, g))
    codes = [found.codes(s, g) for s, g in kept]
    rows = np.array(kept, dtype=np.int64).reshape(-1, 2)
    return RoadmapLabels(
        robot,
        scene,
        node_free,
        edge_free,
        ends[rows + (0, STARTS)],
        codes,
        found.cost[rows[:, 0], rows[:, 1]],
        np.array(
            [not np.array_equal(c, blind.codes(s, g)) for c, (s, g) in zip(codes, kept, strict=True)], bool
        ),
    )


def _ends(space: ConstrainedSpace, rng: np.random.Generator) -> np.ndarray:
    """Free configurations (at most STARTS + GOALS, n), every second one with the hand near an obstacle."""
    candidates = space.robot.random_configurations(rng, CANDIDATES)
    candidates = candidates[space.valid_batch(candidates)]
    near = near_obstacles(space, candidates)
    wanted = (STARTS + GOALS) // 2
    close, rest = candidates[near], candidates[~near]
    ends = np.concatenate([close[:wanted], rest, close[wanted:]])[: STARTS + GOALS]
    return rng.permutation(ends)


def links_to_nearest(nodes: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Edges (l, 2) int32 between each end, numbered after the nodes, and its nearest nodes."""
    nearest = nearest_rows(nodes, ends, LINKS)
    rows = len(nodes) + np.arange(len(ends))
    return np.stack([np.repeat(rows, LINKS), nearest.ravel()], axis=1).astype(np.int32)


def shortest_paths(nodes: np.ndarray, edges: np.ndarray, links: np.ndarray, count: int) -> Paths:
    """Shortest paths over edges both ways, links from starts and links to goals.

    nodes: the roadmap's `count` nodes, STARTS starts, then goals.
    """
    leaving = links[:, 0] < count + STARTS
    pairs = np.concatenate([edges, edges[:, ::-1], links[leaving], links[~leaving][:, ::-1]])
    length = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    graph = csr_array((length, (pairs[:, 0], pairs[:, 1])), shape=(len(nodes), len(nodes)))
    starts = np.arange(count, min(count + STARTS, len(nodes)))
    if len(starts) == 0:
        return Paths(np.empty((0, 0)), np.empty((0, len(nodes))), count)
    cost, before = dijkstra(graph, indices=starts, return_predecessors=True)
    return Paths(cost[:, count + STARTS :], before, count + STARTS)


def roadmap_arrays(scenes: Sequence[tuple[int, int, RoadmapLabels]]) -> dict[str, np.ndarray]:
    """Arrays of a shard, from the family, the number and the labels of each scene."""
    draws = [draw for _, _, draw in scenes]
    codes = [path for draw in draws for path in draw.codes]
    return scene_shapes([(family, number, draw.scene) for family, number, draw in scenes]) | {
        "node_free": np.packbits([draw.node_free for draw in draws], axis=1),
        "edge_free": np.packbits([draw.edge_free for draw in draws], axis=1),
        "path_scene": np.repeat(np.arange(len(draws)), [len(draw.codes) for draw in draws]).astype(np.int32),
        "ends": np.concatenate([packed(draw.robot, draw.ends) for draw in draws]),
        "code_start": np.cumsum([0, *(len(path) for path in codes)], dtype=np.int32),
        "codes": np.concatenate([np.empty(0, np.int64), *codes]).astype(np.uint16),
        "straight": np.concatenate(
            [np.linalg.norm(draw.ends[:, 1] - draw.ends[:, 0], axis=1) for draw in draws]
        ).astype(np.float32),
        "cost": np.concatenate([draw.cost for draw in draws]).astype(np.float32),
        "differs": np.concatenate([draw.differs for draw in draws]),
    }
