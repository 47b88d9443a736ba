"""A tiny dataset of training paths, written here independently of the generator."""

import json

import numpy as np

LOWER = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
UPPER = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
SPAN = np.array(UPPER) - LOWER
# Craig parameters a [m], d [m] and alpha [quarter turns] of the Panda's joints
PANDA = ((0, 0.333, 0), (0, 0, -1), (0, 0.316, 1), (0.0825, 0, 1), (-0.0825, 0.384, -1), (0, 0, 1))
PANDA += ((0.088, 0, 1),)


def kinematics():
    """The Panda's kinematic chain, and points on its joints and hand."""
    turns = {0: (1.0, 0.0), 1: (0.0, 1.0), -1: (0.0, -1.0)}
    cosines = [turns[quarter] for _, _, quarter in PANDA]
    return {
        "rotation": [[[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]] for c, s in cosines],
        "translation": [
            [float(a), -s * d, c * d] for (a, d, _), (c, s) in zip(PANDA, cosines, strict=True)
        ],
        "points": [3, 4, 6, 6],
        "offsets": [[0.0, 0.0, 0.0]] * 3 + [[0.0, 0.0, 0.21]],
    }


def smooth_path(rng, steps=120):
    """Normalised joints of a random curve, less than 0.13 rad apart."""
    ends, bulge = rng.uniform(0.15, 0.85, (2, 7)), rng.normal(0.0, 0.1, 7)
    t = np.linspace(0.0, 1.0, rng.integers(steps // 2, steps))[:, None]
    return np.clip(ends[0] * (1 - t) + ends[1] * t + bulge * np.sin(np.pi * t), 0.0, 1.0)


def shard(rng, seeds, paths_per_scene):
    """Arrays of one shard."""
    s, shapes = len(seeds), 5
    m = s * shapes
    kind = rng.integers(0, 3, m).astype(np.uint8)
    size = rng.uniform(0.1, 0.4, (m, 3)).astype(np.float32)
    size[kind >= 1, 1] = size[kind >= 1, 0]
    size[kind == 2, 2] = size[kind == 2, 0]
    angle = rng.uniform(0, 6.28, m)
    pose = np.zeros((m, 3, 4), dtype=np.float32)
    pose[:, 0, 0] = pose[:, 1, 1] = np.cos(angle)
    pose[:, 1, 0], pose[:, 0, 1], pose[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
    pose[:, :, 3] = rng.uniform(-0.7, 0.7, (m, 3))
    paths = [smooth_path(rng) for _ in range(s * paths_per_scene)]
    lengths = [np.linalg.norm(np.diff(u * SPAN, axis=0), axis=1).sum() for u in paths]
    row = np.arange(len(paths))
    return {
        "family": np.zeros(s, dtype=np.uint8),
        "scene_seed": np.array(seeds, dtype=np.int64),
        "shape_start": np.arange(0, m + 1, shapes, dtype=np.int32),
        "shape_kind": kind,
        "shape_size": size,
        "shape_pose": pose,
        "path_scene": (row // paths_per_scene).astype(np.int32),
        "path_start": np.cumsum([0, *map(len, paths)], dtype=np.int32),
        "waypoints": np.rint(np.concatenate(paths) * 65535).astype(np.uint16),
        "length": np.array(lengths, np.float32),
        "straight": np.array([np.linalg.norm((u[-1] - u[0]) * SPAN) for u in paths], np.float32),
        "trivial": row % 3 == 0,
    }


def write_shard(folder, number, arrays):
    """Add a shard to a dataset."""
    (folder / "shards").mkdir(exist_ok=True)
    np.savez_compressed(folder / "shards" / f"{number:06d}.npz", **arrays)


def write_dataset(folder, *, shards=((20, 1, 2), (40, 3, 4)), paths_per_scene=7, seed=0, **changes):
    """Write scenes of the seeds and paths of each; `changes` replace fields of the description."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    description = {"schema": 1, "robot": "panda", "lower": LOWER, "upper": UPPER}
    description |= {"families": ["cubes"], "kinematics": kinematics(), **changes}
    (folder / "dataset.json").write_text(json.dumps(description))
    for number, seeds in enumerate(shards):
        write_shard(folder, number, shard(rng, seeds, paths_per_scene))
    return folder
