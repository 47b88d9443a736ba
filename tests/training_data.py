"""A tiny dataset of training paths, written here independently of the generator."""

import csv
import hashlib
import io
import json

import numpy as np

LOWER = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
UPPER = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]


def kinematics():
    """The Panda's chain (Craig parameters a, d, alpha), and points on its joints and hand."""
    parameters = [
        (0, 0.333, 0),
        (0, 0, -1),
        (0, 0.316, 1),
        (0.0825, 0, 1),
        (-0.0825, 0.384, -1),
        (0, 0, 1),
        (0.088, 0, 1),
    ]
    rotation, translation = [], []
    for a, d, quarter in parameters:
        c, s = (0.0, float(quarter)) if quarter else (1.0, 0.0)
        rotation.append([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        translation.append([float(a), -s * d, c * d])
    points, offsets = [3, 4, 6, 6], [[0.0, 0.0, 0.0]] * 3 + [[0.0, 0.0, 0.21]]
    return {"rotation": rotation, "translation": translation, "points": points, "offsets": offsets}


def smooth_path(rng):
    """Normalised joints of a random curve, at most 0.13 rad apart."""
    ends = rng.uniform(0.15, 0.85, (2, 7))
    bulge = rng.normal(0.0, 0.1, 7)
    span = np.array(UPPER) - LOWER
    count = 2
    while True:
        t = np.linspace(0.0, 1.0, count)[:, None]
        u = np.clip(ends[0] * (1 - t) + ends[1] * t + bulge * np.sin(np.pi * t), 0.0, 1.0)
        steps = np.linalg.norm(np.diff(u * span, axis=0), axis=1)
        if steps.max() <= 0.13:
            straight = float(np.linalg.norm((ends[1] - ends[0]) * span))
            return np.rint(u * 65535).astype(np.uint16), float(steps.sum()), straight
        count += 4


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
    curves = [smooth_path(rng) for _ in range(s * paths_per_scene)]
    p = len(curves)
    arrays = {
        "family": np.zeros(s, dtype=np.uint8),
        "scene_seed": np.array(seeds, dtype=np.int64),
        "shape_start": np.arange(0, m + 1, shapes, dtype=np.int32),
        "shape_kind": kind,
        "shape_size": size,
        "shape_pose": pose,
        "path_scene": np.repeat(np.arange(s), paths_per_scene).astype(np.int32),
        "path_start": np.concatenate(([0], np.cumsum([len(c[0]) for c in curves]))).astype(
            np.int32
        ),
        "waypoints": np.concatenate([c[0] for c in curves]),
        "length": np.array([c[1] for c in curves], dtype=np.float32),
        "straight": np.array([c[2] for c in curves], dtype=np.float32),
        "trivial": np.arange(p) % 3 == 0,
        "twin_of": np.where(np.arange(p) % paths_per_scene == 1, np.arange(p) - 1, -1).astype(
            np.int32
        ),
    }
    return arrays


def write_shard(folder, number, arrays):
    """Add a shard to a dataset."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    (folder / "shards").mkdir(parents=True, exist_ok=True)
    (folder / "shards" / f"{number:06d}.npz").write_bytes(buffer.getvalue())
    index = folder / "shards.csv"
    is_new = not index.exists()
    with index.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow(["shard", "sha256", "scenes", "paths"])
        digest = hashlib.sha256(buffer.getvalue()).hexdigest()
        writer.writerow(
            [f"{number:06d}", digest, len(arrays["scene_seed"]), len(arrays["path_scene"])]
        )


def write_dataset(folder, *, shards=((20, 1, 2), (40, 3, 4)), paths_per_scene=7, seed=0, **changes):
    """Write scenes of the seeds and paths of each; `changes` replace fields of the description."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    description = {
        "schema": 1,
        "robot": "panda",
        "lower": LOWER,
        "upper": UPPER,
        "families": ["cubes"],
    }
    description |= {"kinematics": kinematics(), **changes}
    (folder / "dataset.json").write_text(json.dumps(description))
    for number, seeds in enumerate(shards):
        write_shard(folder, number, shard(rng, seeds, paths_per_scene))
    return folder
