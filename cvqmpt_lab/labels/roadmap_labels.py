"""Labels on a dictionary's roadmap: every node and edge checked in random scenes, and shortest paths through it.

They are functions of the scene: of start and goal anywhere, the codes on the shortest path, by Dijkstra.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search.edge_verdicts import edge_verdicts
from cvqmpt_lab.kernels.search.motion import motion_free
from cvqmpt_lab.labels.generation import SceneRecipe, Shard
from cvqmpt_lab.labels.path_labels import (
    CANDIDATES,
    near_obstacles,
    packed,
    scene_shapes,
    unconstrained_space,
)
from cvqmpt_lab.methods.loaded import dictionary_roadmap
from cvqmpt_lab.methods.method import Weights
from cvqmpt_lab.planning.code_graph import CodeEdges, nearest_rows
from cvqmpt_lab.planning.roadmap import Roadmap
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.training.dataset import VALIDATION_EVERY
from cvqmpt_lab.training.shards import (
    ROADMAP_FILE,
    RoadmapGraph,
    RoadmapShard,
    packed_shard,
    read_roadmap_shards,
)

STARTS, GOALS = 16, 48  # configurations of a scene between which paths are looked for
LINKS = 20  # nodes that each is linked to
MARGIN = 0.002  # [m] that free motions keep from obstacles
CHECKS = 60  # state checks an edge, on average: scenes that need more have a wall millimetres from the base


class RoadmapLabels(NamedTuple):
    """What training learns from one scene; p pairs of start and goal."""

    robot: Robot
    scene: Scene
    node_free: np.ndarray  # (N,) bool
    edge_free: np.ndarray  # (E,) bool
    ends: np.ndarray  # (p, 2, n) starts and goals [rad]
    codes: list[np.ndarray]  # of each path, (k,); none where no path was found
    cost: np.ndarray  # (p,) length of the shortest path [rad], inf where there is none
    differs: (
        np.ndarray
    )  # (p,) bool: its codes are others than those of the shortest path that ignores the scene


class ShortestPaths(NamedTuple):
    """Shortest paths from every start to every goal."""

    cost: np.ndarray  # (s, g) [rad], inf where there is none
    before: np.ndarray  # (s, rows) row before each row on the way from a start, negative where there is none
    first_goal: int  # row of goal 0; smaller ones below the number of nodes are codes

    def codes(self, start: int, goal: int) -> np.ndarray:
        """Codes (k,) from a start to a goal, none where there is no path."""
        rows, row = [], int(self.before[start, self.first_goal + goal])
        while row >= 0:
            rows.append(row)
            row = int(self.before[start, row])
        return np.array(rows[-2::-1], np.int64)  # the last one is the start itself


@dataclass(frozen=True)
class RoadmapRecipe(SceneRecipe):
    """Labels on the roadmap of a dictionary."""

    labels: str = field(default="roadmap", init=False)
    model: str | None = None  # name or folder of the dictionary's weights; None for the shipped

    def prepare(self, out: Path) -> None:
        """Write the roadmap, or check that it is the one that is there."""
        graph = _graph(self.model, robot_from_source(self.robot))
        if (out / ROADMAP_FILE).exists() and RoadmapGraph.read(out).digest != graph.digest:
            raise InvalidInputError(f"{out} holds labels of another dictionary; choose another --out")
        graph.write(out)

    def shard(self, number: int) -> Shard:
        """Scenes with all their nodes and edges checked."""
        robot = robot_from_source(self.robot)
        graph, scenes = _graph(self.model, robot), []
        for index, family, scene_number, scene in self.scenes_of(number):
            draw = roadmap_labels(robot, scene, graph, self.paths_per_scene, (self.seed, index))
            if draw is not None:
                scenes.append((family, scene_number, draw))
        return packed_shard(number, roadmap_arrays(scenes))

    def card(self, out: Path) -> str:
        """Counts, shares and lengths by family, of both splits."""
        shards = read_roadmap_shards(out)
        graph = shards[0].graph
        lines = [
            "# Labels on a dictionary's roadmap",
            "",
            f"{len(graph.nodes)} nodes and {len(graph.edges)} edges of the dictionary {graph.digest[:12]}; the robot "
            f"itself allows {graph.node_possible.mean():.3f} of the nodes and {graph.edge_possible.mean():.3f} of the "
            f"edges. Scenes whose number is divisible by {VALIDATION_EVERY} validate. Pairs of start and goal, half of "
            "them near an obstacle, whose straight motion is blocked. No path: through this roadmap. Others than "
            "blind: the codes differ from those of the shortest path in an empty scene. Detour: length of the shortest "
            "path over that of the straight line, mean. Scenes with a wall millimetres "
            f"from the base are left out: {self.scenes - sum(len(shard.arrays['family']) for shard in shards)}.",
            "",
            "| family | scenes | of them validate | nodes free | edges free | pairs | no path | others than blind "
            "| detour | codes a path |",
            "|---|---|---|---|---|---|---|---|---|---|",
            *(_row(shards, name, [k]) for k, name in enumerate(self.families)),
            _row(shards, "all", list(range(len(self.families)))),
        ]
        return "\n".join(lines) + "\n"


@lru_cache(maxsize=1)
def _graph(model: str | None, robot: Robot) -> RoadmapGraph:
    return roadmap_graph(robot, dictionary_roadmap(Weights("vq_mpt", model), robot))


def _row(shards: list[RoadmapShard], name: str, families: list[int]) -> str:
    """Counts and means of the scenes of some families."""
    scenes = validate = pairs = codes = 0
    node_free, edge_free, found, differs, detour = [], [], [], [], []
    for shard in shards:
        arrays = shard.arrays
        own = np.isin(arrays["family"], families)
        scenes += int(own.sum())
        validate += int((own & (arrays["scene_seed"] % VALIDATION_EVERY == 0)).sum())
        node_free += [shard.node_free(scene).mean() for scene in np.flatnonzero(own).tolist()]
        edge_free += [shard.edge_free(scene).mean() for scene in np.flatnonzero(own).tolist()]
        paths = own[arrays["path_scene"]]
        solved = paths & np.isfinite(arrays["cost"])
        pairs += int(paths.sum())
        codes += int(np.diff(arrays["code_start"])[solved].sum())
        found.append(np.isfinite(arrays["cost"])[paths])
        differs.append(arrays["differs"][solved])
        detour.append(arrays["cost"][solved] / arrays["straight"][solved])
    if pairs == 0:
        return f"| {name} | {scenes} | {validate} | - | - | 0 | - | - | - | - |"
    solved_share, count = np.concatenate(found).mean(), max(int(np.concatenate(found).sum()), 1)
    return (
        f"| {name} | {scenes} | {validate} | {np.mean(node_free):.2f} | {np.mean(edge_free):.2f} | {pairs} "
        f"| {100 * (1 - solved_share):.0f} % | {100 * np.concatenate(differs).mean():.0f} % "
        f"| {np.concatenate(detour).mean():.2f} | {codes / count:.1f} |"
    )


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


def shortest_paths(nodes: np.ndarray, edges: np.ndarray, links: np.ndarray, count: int) -> ShortestPaths:
    """Shortest paths over edges both ways, links from starts and links to goals.

    nodes: the roadmap's `count` nodes, STARTS starts, then goals.
    """
    leaving = links[:, 0] < count + STARTS
    pairs = np.concatenate([edges, edges[:, ::-1], links[leaving], links[~leaving][:, ::-1]])
    length = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    graph = csr_array((length, (pairs[:, 0], pairs[:, 1])), shape=(len(nodes), len(nodes)))
    starts = np.arange(count, min(count + STARTS, len(nodes)))
    if len(starts) == 0:
        return ShortestPaths(np.empty((0, 0)), np.empty((0, len(nodes))), count)
    cost, before = dijkstra(graph, indices=starts, return_predecessors=True)
    return ShortestPaths(cost[:, count + STARTS :], before, count + STARTS)


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
