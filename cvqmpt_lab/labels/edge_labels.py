"""Nodes and edges of a dictionary's roadmap as an edge validity model sees them, with verdicts, and its training.

The model learns log odds of P(edge is free) from the clearances that a point cloud leaves along the edge.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, whole_number
from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.training.dataset import VALIDATION_EVERY, Shapes
from cvqmpt_lab.training.shards import DESCRIPTION_FILE, RoadmapGraph, RoadmapShard, read_roadmap_shards
from cvqmpt_lab.training.training_clouds import CloudSettings, sample_cloud
from cvqmpt_lab.vqmpt.edge_model import EdgeModel, SmallNetwork
from cvqmpt_lab.vqmpt.stages import EDGE_PART
from cvqmpt_lab.vqmpt.weights import (
    TRAINED_FOLDER,
    VQ_MPT,
    read_model,
    resolve_model,
    robot_signature,
    write_model,
)

NODES, EDGES = 256, 512  # drawn in each scene for training
POINTS = 4096  # of a cloud
CLOUDS = (
    CloudSettings(points=POINTS),  # half of them from some sides only
    CloudSettings(points=POINTS, measured=1.0),  # by depth cameras and their errors
)


class Examples(NamedTuple):
    """Motions of one scene, those of no length being configurations."""

    features: np.ndarray  # (b, n + 1), see `vqmpt.edge_model`
    odds: np.ndarray  # (b,) log odds by the model's own network
    free: np.ndarray  # (b,) bool
    edge: np.ndarray  # (b,) bool: a motion, not a configuration


def examples_of(
    model: EdgeModel,
    cloud: np.ndarray,
    graph: RoadmapGraph,
    node_free: np.ndarray,
    edge_free: np.ndarray,
    chosen: tuple[np.ndarray, np.ndarray] | None = None,
) -> Examples:
    """The nodes and edges that the robot itself allows, or chosen rows of both, seen in a cloud (m, 3) [m]."""
    nodes, edges = chosen or (np.flatnonzero(graph.node_possible), np.flatnonzero(graph.edge_possible))
    motions = np.concatenate([np.stack([graph.nodes[nodes]] * 2, axis=1), graph.nodes[graph.edges[edges]]])
    features, odds = model.log_odds(cloud, motions)
    free = np.concatenate([node_free[nodes], edge_free[edges]])
    return Examples(features, odds, free, np.arange(len(free)) >= len(nodes))


def training_examples(
    model: EdgeModel, shards: Iterable[RoadmapShard], rng: np.random.Generator
) -> Iterator[Examples]:
    """Some motions of every scene that trains, each scene in a cloud (m, 3) [m] of its own."""
    for shard in shards:
        arrays, graph = shard.arrays, shard.graph
        for scene in np.flatnonzero(arrays["scene_seed"] % VALIDATION_EVERY != 0).tolist():
            rows = slice(arrays["shape_start"][scene], arrays["shape_start"][scene + 1])
            shapes = Shapes(*(arrays[f"shape_{name}"][rows] for name in ("kind", "size", "pose")))
            cloud = sample_cloud(shapes, CLOUDS[rng.integers(len(CLOUDS))], rng)
            chosen = (
                rng.choice(np.flatnonzero(graph.node_possible), NODES, replace=False),
                rng.choice(np.flatnonzero(graph.edge_possible), EDGES, replace=False),
            )
            yield examples_of(model, cloud, graph, shard.node_free(scene), shard.edge_free(scene), chosen)


def train_edge_model(
    data: Path,
    out: Path,
    weights: str | None = None,
    *,
    seed: int = 0,
    scenes: int,
    metadata: dict[str, Any],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write the weights of a VQ-MPT (see `resolve_model`) with an edge validity model to out/model. Returns the
    number of motions.

    data: folder of roadmap labels, of which at most `scenes` scenes are used.
    InvalidInputError: no scene to train on, or the robot is not the weights'.
    """
    from cvqmpt_lab.training.edge_training import fit_edge_model  # torch: only to train

    seed, scenes = whole_number("seed", seed), whole_number("scenes", scenes, 1)
    robot = robot_from_source(read_json_object(data / DESCRIPTION_FILE).get("recipe", {}).get("robot"))
    model = read_model(resolve_model(weights, VQ_MPT, robot_signature(robot)))
    untrained = EdgeModel(SmallNetwork.untrained(robot.dof + 1), robot)
    parts = training_examples(untrained, read_roadmap_shards(data), np.random.default_rng(seed))
    examples = []
    for done, part in zip(range(1, scenes + 1), parts, strict=False):
        examples.append(part)
        on_progress(done, scenes)
    if not examples:
        raise InvalidInputError(f"{data} holds no scene to train on; generate more of them")
    free = np.concatenate([part.free for part in examples])
    arrays = fit_edge_model(np.concatenate([part.features for part in examples]), free, seed)
    origin = {**model.metadata, EDGE_PART: {**metadata, "scenes": len(examples), "seed": seed}}
    write_model(
        out / TRAINED_FOLDER, replace(model, parts={**model.parts, EDGE_PART: arrays}, metadata=origin)
    )
    return len(free)
