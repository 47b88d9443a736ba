"""Motions of a dictionary's roadmap as its eyes see them, with verdicts: what they learn from and are judged by."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.planning.sight import Eyes
from cvqmpt_lab.training.dataset import VALIDATION_EVERY, Shapes
from cvqmpt_lab.training.shards import RoadmapGraph, RoadmapShard
from cvqmpt_lab.training.training_clouds import CloudSettings, sample_cloud

NODES, EDGES = 256, 512  # drawn in each scene for training
POINTS = 4096  # of a cloud
CLOUDS = (
    CloudSettings(points=POINTS),  # half of them from some sides only
    CloudSettings(points=POINTS, measured=1.0),  # by depth cameras and their errors
)


@dataclass(frozen=True, eq=False)
class Examples:
    """Motions of one scene, those of no length being configurations."""

    features: np.ndarray
    """(b, n + 1), see `kernels.search.sight`."""
    odds: np.ndarray
    """(b,) log odds by the eyes' own network."""
    free: np.ndarray
    """(b,) bool."""
    edge: np.ndarray
    """(b,) bool: a motion, not a configuration."""


def examples_of(
    eyes: Eyes,
    cloud: np.ndarray,
    graph: RoadmapGraph,
    node_free: np.ndarray,
    edge_free: np.ndarray,
    chosen: tuple[np.ndarray, np.ndarray] | None = None,
) -> Examples:
    """The nodes and edges that the robot itself allows, or chosen rows of both, seen in a cloud (m, 3) [m]."""
    nodes, edges = chosen or (np.flatnonzero(graph.node_possible), np.flatnonzero(graph.edge_possible))
    motions = np.concatenate([np.stack([graph.nodes[nodes]] * 2, axis=1), graph.nodes[graph.edges[edges]]])
    features, odds = eyes.judge(cloud, motions)
    free = np.concatenate([node_free[nodes], edge_free[edges]])
    return Examples(features, odds, free, np.arange(len(free)) >= len(nodes))


def training_scenes(
    shards: Iterable[RoadmapShard], scenes: int, rng: np.random.Generator, *, validate: bool = False
) -> Iterator[tuple[RoadmapShard, int, np.ndarray]]:
    """The first `scenes` scenes that train, as rows of their shards, each with a cloud (m, 3) [m] of its own.

    validate: those that validate instead.
    """
    for shard in shards:
        arrays = shard.arrays
        validates = arrays["scene_seed"] % VALIDATION_EVERY == 0
        for scene in np.flatnonzero(validates == validate).tolist():
            if scenes == 0:
                return
            scenes -= 1
            rows = slice(arrays["shape_start"][scene], arrays["shape_start"][scene + 1])
            shapes = Shapes(*(arrays[f"shape_{name}"][rows] for name in ("kind", "size", "pose")))
            yield shard, scene, sample_cloud(shapes, CLOUDS[rng.integers(len(CLOUDS))], rng)


def training_examples(
    eyes: Eyes, shards: Iterable[RoadmapShard], scenes: int, rng: np.random.Generator
) -> Iterator[Examples]:
    """Some motions of the first `scenes` scenes that train."""
    for shard, scene, cloud in training_scenes(shards, scenes, rng):
        graph = shard.graph
        chosen = (
            rng.choice(np.flatnonzero(graph.node_possible), NODES, replace=False),
            rng.choice(np.flatnonzero(graph.edge_possible), EDGES, replace=False),
        )
        yield examples_of(eyes, cloud, graph, shard.node_free(scene), shard.edge_free(scene), chosen)
