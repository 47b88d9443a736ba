"""Roadmap labels as training paths: codes become configurations, start and goal the ends, edges straight motions."""

from collections.abc import Iterable

import numpy as np

from cvqmpt_lab.training.roadmap_shards import RoadmapShard
from cvqmpt_lab.training.shards import FULL_SCALE, Arrays
from cvqmpt_lab.vqmpt.weights import RobotSignature

SPACING = 0.13  # [rad] between waypoints at most, as in other datasets
PATHS = 40  # of each scene, the first that were found: all of them would not fit into memory


def path_arrays(shards: Iterable[RoadmapShard], robot: RobotSignature) -> list[Arrays]:
    """Scenes and paths of roadmap shards as arrays of shards of paths (`shards`); pairs without one are left out."""
    return [_arrays(shard, np.array(robot.lower), np.array(robot.upper)) for shard in shards]


def _arrays(shard: RoadmapShard, lower: np.ndarray, upper: np.ndarray) -> Arrays:
    labels = shard.arrays
    rows = _kept(labels)
    waypoints, path_start = _waypoints(shard, rows, lower, upper)
    return {name: labels[name] for name in ("family", "scene_seed", *_SHAPES)} | {
        "path_scene": labels["path_scene"][rows],
        "path_start": path_start,
        "waypoints": waypoints,
        "length": labels["cost"][rows],
        "straight": labels["straight"][rows],
        "trivial": np.zeros(len(rows), bool),  # only pairs whose straight motion is blocked are labelled
        "twin_of": np.full(len(rows), -1, np.int32),
    }


_SHAPES = ("shape_start", "shape_kind", "shape_size", "shape_pose")


def _kept(labels: Arrays) -> np.ndarray:
    """Rows of the first `PATHS` paths of each scene that were found."""
    rows = np.flatnonzero(np.isfinite(labels["cost"]))
    scene = labels["path_scene"][rows]  # in ascending order
    return rows[np.arange(len(rows)) - np.searchsorted(scene, scene) < PATHS]


def _waypoints(
    shard: RoadmapShard, rows: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Waypoints (w, n) uint16 of the paths, and where those of each begin and the last end (p + 1,)."""
    corners, first = _corners(shard, rows, lower, upper)
    step = np.diff(corners, axis=0, append=corners[-1:])
    parts = np.maximum(np.ceil(np.linalg.norm(step, axis=1) / SPACING), 1).astype(int)
    parts[first[1:] - 1] = 1  # a goal leads nowhere
    begins = np.cumsum(parts) - parts
    share = (np.arange(parts.sum()) - begins.repeat(parts)) / parts.repeat(parts)
    q = corners.repeat(parts, 0) + share[:, None] * step.repeat(parts, 0)
    u = np.clip((q - lower) / (upper - lower), 0.0, 1.0)
    return np.rint(u * FULL_SCALE).astype(np.uint16), np.append(begins, len(q))[first].astype(np.int32)


def _corners(
    shard: RoadmapShard, rows: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Start, nodes and goal (c, n) [rad] of one path after the other, and where those of each begin (p + 1,)."""
    labels, count = shard.arrays, np.diff(shard.arrays["code_start"])[rows]
    first = np.concatenate([[0], np.cumsum(count + 2)])
    corners = np.empty((first[-1], shard.graph.nodes.shape[1]))
    ends = lower + labels["ends"][rows] / FULL_SCALE * (upper - lower)
    corners[first[:-1]], corners[first[1:] - 1] = ends[:, 0], ends[:, 1]
    inside = np.ones(len(corners), bool)
    inside[first[:-1]] = inside[first[1:] - 1] = False
    place = np.arange(count.sum()) - (np.cumsum(count) - count).repeat(count)
    corners[inside] = shard.graph.nodes[
        labels["codes"][labels["code_start"][rows].astype(int).repeat(count) + place]
    ]
    return corners, first
