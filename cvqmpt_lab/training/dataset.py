"""A dataset of training paths in memory: scenes as shapes, paths as waypoints of 16 bits a joint,
split in two.

Joints u are normalised to [0, 1] between the limits. Scenes whose seed is divisible by 20 validate,
the others train; twins, second labels of a path, do neither. `shards` describes the folder on disk.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from cvqmpt_lab.codec.plain import from_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import read_bytes, read_json_object, require_regular_file
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    FULL_SCALE,
    INDEX_FILE,
    ROADMAP_FILE,
    SCHEMA,
    RoadmapShard,
    read_index,
    read_roadmap_shards,
    read_shard,
)
from cvqmpt_lab.vqmpt.config import SerialChain
from cvqmpt_lab.vqmpt.weights import RobotSignature

VALIDATION_EVERY = 20  # scenes whose seed is divisible by it validate
ROADMAP_SPACING = 0.13  # [rad] between waypoints at most, as in other datasets
# of each labelled scene, the first that were found: all of them would not fit into memory
ROADMAP_PATHS = 40

SplitName = Literal["train", "validation"]


@dataclass(frozen=True, eq=False)
class Shapes:
    """Boxes, cylinders and spheres, m of them."""

    kind: np.ndarray  # (m,) uint8: 0 box, 1 cylinder, 2 sphere
    # (m, 3) float32 [m]: edges; radius, radius, height (axis z); radius three times
    size: np.ndarray
    pose: np.ndarray  # (m, 3, 4) float32: T_world_shape [m]

    def __len__(self) -> int:
        return len(self.kind)


@dataclass(frozen=True, eq=False)
class Scenes:
    """All s scenes, m shapes in all."""

    family: np.ndarray  # (s,) uint8: index into the dataset's families
    seed: np.ndarray  # (s,) int64
    shape_start: np.ndarray  # (s + 1,) int64: ranges into the shapes
    shape: Shapes  # of all scenes

    def __len__(self) -> int:
        return len(self.seed)

    def shapes(self, scene: int) -> Shapes:
        """Those of one scene."""
        rows = slice(int(self.shape_start[scene]), int(self.shape_start[scene + 1]))
        return Shapes(self.shape.kind[rows], self.shape.size[rows], self.shape.pose[rows])


@dataclass(frozen=True, eq=False)
class Paths:
    """All p paths, w waypoints in all."""

    scene: np.ndarray  # (p,) int64: row of the scene
    start: np.ndarray  # (p + 1,) int64: ranges into the waypoints
    waypoints: np.ndarray  # (w, n) uint16: u times FULL_SCALE
    trivial: np.ndarray  # (p,) bool: the straight line is free
    twin_of: np.ndarray  # (p,) int64: row of the path of which this is a second label, or -1
    length: np.ndarray  # (p,) float32 [rad]
    straight: np.ndarray  # (p,) float32: length of the straight line [rad]

    def __len__(self) -> int:
        return len(self.scene)

    def joints(self, path: int) -> np.ndarray:
        """Normalised joints u (t, n) float32 of one path."""
        return unpacked(self.waypoints[self.start[path] : self.start[path + 1]])

    def counts(self, paths: np.ndarray) -> np.ndarray:
        """Waypoints of each path."""
        return self.start[paths + 1] - self.start[paths]

    def padded(self, paths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normalised joints (b, t, n) float32 of paths (b,), the last waypoint repeated, and their
        counts (b,).
        """
        counts = self.counts(paths)
        place = np.minimum(np.arange(counts.max()), counts[:, None] - 1)
        return unpacked(self.waypoints[self.start[paths][:, None] + place]), counts


def unpacked(joints: np.ndarray) -> np.ndarray:
    """Normalised joints u float32 of stored ones, uint16."""
    return joints.astype(np.float32) / np.float32(FULL_SCALE)


def with_few_trivial(
    paths: Paths, rows: np.ndarray, share: float, rng: np.random.Generator
) -> np.ndarray:
    """Rows in which at most this share is of trivial paths;
    which of those stay is drawn, order is kept.
    """
    trivial = paths.trivial[rows]
    others = int((~trivial).sum())
    most = int(share / (1.0 - share) * others) if share < 1.0 else len(rows)
    if others == 0 or trivial.sum() <= most:  # nothing but straight lines is better than nothing
        return rows
    kept = ~trivial
    kept[rng.choice(np.flatnonzero(trivial), most, replace=False)] = True
    return rows[kept]


@dataclass(frozen=True, eq=False)
class PathDataset:
    """An opened dataset."""

    folder: Path
    robot: RobotSignature
    families: tuple[str, ...]
    chain: SerialChain | None  # kinematics for link positions; None when the description has none
    sha256: str  # of the description and the index, which holds those of the shards
    scenes: Scenes
    paths: Paths

    def split(self, name: SplitName) -> np.ndarray:
        """Rows of the paths that train or validate, without twins."""
        if name not in get_args(SplitName):
            raise UnknownChoiceError("split", name, get_args(SplitName))
        validates = self.scenes.seed[self.paths.scene] % VALIDATION_EVERY == 0
        return np.flatnonzero((validates == (name == "validation")) & (self.paths.twin_of < 0))

    def require_splits(self) -> None:
        """Raise InvalidInputError unless there is a path to train on and one to validate with."""
        for name in get_args(SplitName):
            if len(self.split(name)) == 0:
                raise InvalidInputError(
                    f"{self.folder} has no {name} path (scene seeds divisible by "
                    f"{VALIDATION_EVERY} validate); "
                    "generate more scenes"
                )

    def thinned(self, spacing: float | None) -> "PathDataset":
        """The dataset with fewer waypoints: both ends of each path, and the first waypoint after
        every `spacing` [rad].

        None keeps all; InvalidInputError for a spacing that is not positive.
        """
        if spacing is None:
            return self
        if not spacing > 0.0:
            raise InvalidInputError(f"spacing of waypoints is {spacing} rad; it must be positive")
        paths = self.paths
        scale = (np.array(self.robot.upper) - np.array(self.robot.lower)) / FULL_SCALE
        steps = np.zeros(len(paths.waypoints))
        block = 1 << 18
        # in blocks: the whole in floats would not fit everywhere
        for first in range(1, len(steps), block):
            last = min(first + block, len(steps))
            joints = paths.waypoints[first - 1 : last] * scale
            steps[first:last] = np.linalg.norm(np.diff(joints, axis=0), axis=1)
        steps[paths.start[:-1]] = 0.0
        counts = np.diff(paths.start)
        total = np.concatenate(([0.0], np.cumsum(steps)))[1:]
        along = total - total[paths.start[:-1]].repeat(counts)
        length = along[paths.start[1:] - 1]
        parts = np.maximum(1.0, np.ceil(length / spacing - 1e-6))
        place = np.floor(along * (parts / np.maximum(length, 1e-9)).repeat(counts) + 1e-6)
        kept = np.ones(len(steps), dtype=bool)
        kept[1:] = place[1:] != place[:-1]
        kept[paths.start[:-1]] = True
        kept[paths.start[1:] - 1] = True
        start = np.concatenate(([0], np.add.reduceat(kept, paths.start[:-1]).cumsum()))
        return replace(self, paths=replace(paths, start=start, waypoints=paths.waypoints[kept]))


def open_dataset(folder: Path) -> PathDataset:
    """Read a whole dataset into memory; of roadmap labels some paths of each scene.

    InvalidInputError names the file that is missing, damaged or of another schema.
    """
    folder = Path(folder)
    robot, families, chain = read_dataset_description(folder)
    joints = len(robot.lower)
    if (folder / ROADMAP_FILE).exists():
        shards = [_path_arrays(shard, robot) for shard in read_roadmap_shards(folder)]
    else:
        shards = [read_shard(folder, row, joints, len(families)) for row in read_index(folder)]
    digest = hashlib.sha256(
        read_bytes(folder / DESCRIPTION_FILE) + read_bytes(folder / INDEX_FILE)
    ).hexdigest()
    return PathDataset(
        folder, robot, families, chain, digest, together_scenes(shards), _paths(shards)
    )


def read_dataset_description(
    folder: Path,
) -> tuple[RobotSignature, tuple[str, ...], SerialChain | None]:
    """Robot, families and kinematics of a dataset;
    InvalidInputError where its description is missing or malformed.
    """
    path = folder / DESCRIPTION_FILE
    if not path.exists():
        raise InvalidInputError(
            f"no dataset in {folder}: it has no {DESCRIPTION_FILE}; generate one there first"
        )
    description = read_json_object(require_regular_file(path))
    if description.get("schema") != SCHEMA:
        raise InvalidInputError(
            f"{path}: schema is {description.get('schema')!r}; this version reads {SCHEMA}"
        )
    robot = _robot(description, path)
    families = from_plain(tuple[str, ...], description.get("families"), f"{path}: families")
    if not families:
        raise InvalidInputError(f"{path}: families is empty; it must name one at least")
    joints, chain = len(robot.lower), None
    if description.get("kinematics") is not None:
        chain = from_plain(SerialChain, description["kinematics"], f"{path}: kinematics")
        if len(chain.rotation) != joints:
            raise InvalidInputError(
                f"{path}: kinematics has {len(chain.rotation)} joints, lower {joints}"
            )
    return robot, families, chain


def _robot(description: Mapping[str, Any], path: Path) -> RobotSignature:
    known = {"robot": "name", "lower": "lower", "upper": "upper", "joints": "joints"}
    known["kinematics_digest"] = "kinematics"
    named = {ours: description[theirs] for theirs, ours in known.items() if theirs in description}
    return from_plain(RobotSignature, named, f"{path}: ")


def together_scenes(shards: list[dict[str, np.ndarray]]) -> Scenes:
    """All scenes, rows counted through."""
    size, pose = (
        together(shards, name).astype(np.float32) for name in ("shape_size", "shape_pose")
    )
    return Scenes(
        family=together(shards, "family"),
        seed=together(shards, "scene_seed"),
        shape_start=together_ranges(shards, "shape_start", "shape_kind"),
        shape=Shapes(together(shards, "shape_kind"), size, pose),
    )


def _paths(shards: list[dict[str, np.ndarray]]) -> Paths:
    """All paths, rows counted through."""
    return Paths(
        scene=together_rows(shards, "path_scene", "scene_seed"),
        start=together_ranges(shards, "path_start", "waypoints"),
        waypoints=together(shards, "waypoints"),
        trivial=together(shards, "trivial").astype(bool),
        twin_of=together_rows(shards, "twin_of", "path_scene"),
        length=together(shards, "length"),
        straight=together(shards, "straight"),
    )


def together(shards: list[dict[str, np.ndarray]], name: str) -> np.ndarray:
    """An array of all shards."""
    return np.concatenate([shard[name] for shard in shards])


def _offsets(shards: list[dict[str, np.ndarray]], items: str) -> list[int]:
    """How many items there are before each shard, and in all."""
    return np.cumsum([0, *(len(shard[items]) for shard in shards)]).tolist()


def together_rows(shards: list[dict[str, np.ndarray]], name: str, items: str) -> np.ndarray:
    """Rows of items, counted through; -1 stays."""
    parts = zip(shards, _offsets(shards, items), strict=False)
    return np.concatenate(
        [np.where(s[name] < 0, -1, s[name].astype(np.int64) + o) for s, o in parts]
    )


def together_ranges(shards: list[dict[str, np.ndarray]], name: str, items: str) -> np.ndarray:
    """Where each range of items begins, and where the last ends."""
    offsets = _offsets(shards, items)
    starts = [s[name][:-1].astype(np.int64) + o for s, o in zip(shards, offsets, strict=False)]
    return np.concatenate([*starts, offsets[-1:]])


def _path_arrays(shard: RoadmapShard, robot: RobotSignature) -> dict[str, np.ndarray]:
    """Arrays of paths, as `shards` describes them, of labels on a roadmap; pairs without a path are
    left out.

    A path goes from its start through the nodes that its codes name to its goal, straight along
    each edge.
    """
    lower, upper, labels = np.array(robot.lower), np.array(robot.upper), shard.arrays
    rows = np.flatnonzero(np.isfinite(labels["cost"]))
    scene = labels["path_scene"][rows]  # in ascending order
    rows = rows[np.arange(len(rows)) - np.searchsorted(scene, scene) < ROADMAP_PATHS]
    corners, first = _corners(shard, rows, lower, upper)
    step = np.diff(corners, axis=0, append=corners[-1:])
    parts = np.maximum(np.ceil(np.linalg.norm(step, axis=1) / ROADMAP_SPACING), 1).astype(int)
    parts[first[1:] - 1] = 1  # a goal leads nowhere
    begins = np.cumsum(parts) - parts
    share = (np.arange(parts.sum()) - begins.repeat(parts)) / parts.repeat(parts)
    q = corners.repeat(parts, 0) + share[:, None] * step.repeat(parts, 0)
    u = np.clip((q - lower) / (upper - lower), 0.0, 1.0)
    shapes = ("shape_start", "shape_kind", "shape_size", "shape_pose")
    return {name: labels[name] for name in ("family", "scene_seed", *shapes)} | {
        "path_scene": labels["path_scene"][rows],
        "path_start": np.append(begins, len(q))[first].astype(np.int32),
        "waypoints": np.rint(u * FULL_SCALE).astype(np.uint16),
        "length": labels["cost"][rows],
        "straight": labels["straight"][rows],
        # only pairs whose straight motion is blocked are labelled
        "trivial": np.zeros(len(rows), bool),
        "twin_of": np.full(len(rows), -1, np.int32),
    }


def _corners(
    shard: RoadmapShard, rows: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Start, nodes and goal (c, n) [rad] of one path after the other, and where those of each begin
    (p + 1,).
    """
    labels, count = shard.arrays, np.diff(shard.arrays["code_start"])[rows]
    first = np.concatenate([[0], np.cumsum(count + 2)])
    corners = np.empty((first[-1], shard.graph.nodes.shape[1]))
    ends = lower + labels["ends"][rows] / FULL_SCALE * (upper - lower)
    corners[first[:-1]], corners[first[1:] - 1] = ends[:, 0], ends[:, 1]
    inside = np.ones(len(corners), bool)
    inside[first[:-1]] = inside[first[1:] - 1] = False
    place = np.arange(count.sum()) - (np.cumsum(count) - count).repeat(count)
    codes = labels["codes"][labels["code_start"][rows].astype(int).repeat(count) + place]
    corners[inside] = shard.graph.nodes[codes]
    return corners, first
