"""Datasets in memory: scenes as shapes, with paths as waypoints or as labels on a roadmap.

Joints u are normalised to [0, 1] between the limits. Scenes whose seed is divisible by 20 validate,
the others train. `shards` describes the folder on disk and the arrays.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import read_bytes, read_json_object
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    FULL_SCALE,
    LABEL_ARRAYS,
    PATH_ARRAYS,
    ROADMAP_FILE,
    RoadmapGraph,
    joined,
    read_shards,
    shard_files,
)
from cvqmpt_lab.vqmpt.config import SerialChain
from cvqmpt_lab.vqmpt.weights import RobotSignature

SCHEMA = 1
VALIDATION_EVERY = 20  # scenes whose seed is divisible by it validate

SplitName = Literal["train", "validation"]


class Shapes(NamedTuple):
    """Boxes, cylinders and spheres, m of them."""

    kind: np.ndarray  # (m,) uint8: 0 box, 1 cylinder, 2 sphere
    # (m, 3) float32 [m]: edges; radius, radius, height (axis z); radius three times
    size: np.ndarray
    pose: np.ndarray  # (m, 3, 4) float32: T_world_shape [m]


@dataclass(frozen=True, eq=False)
class TrainingData:
    """A dataset of s scenes and p paths: its description, and the joined arrays of its shards."""

    folder: Path
    robot: RobotSignature
    families: tuple[str, ...]
    chain: SerialChain | None  # kinematics for link positions; None when the description has none
    sha256: str  # of the description and the shards
    arrays: Mapping[str, np.ndarray]  # by the names of `shards.PATH_ARRAYS` or `LABEL_ARRAYS`

    @property
    def validates(self) -> np.ndarray:
        """Whether each scene (s,) is for validation, bool."""
        return self.arrays["scene_seed"] % VALIDATION_EVERY == 0

    def shapes(self, scene: int) -> Shapes:
        """Shapes of one scene."""
        rows = slice(*self.arrays["shape_start"][scene : scene + 2])
        return Shapes(*(self.arrays[f"shape_{name}"][rows] for name in Shapes._fields))

    def split(self, name: SplitName) -> np.ndarray:
        """Rows of the paths for training or validation."""
        return np.flatnonzero(self.validates[self.arrays["path_scene"]] == (name == "validation"))


@dataclass(frozen=True, eq=False)
class PathDataset(TrainingData):
    """A dataset of paths."""

    def require_splits(self) -> None:
        """Raise InvalidInputError without a path to train on or one to validate with."""
        for name in get_args(SplitName):
            if len(self.split(name)) == 0:
                raise InvalidInputError(
                    f"{self.folder} has no {name} path (scene seeds divisible by "
                    f"{VALIDATION_EVERY} validate); generate more scenes"
                )

    def joints(self, waypoints: np.ndarray | slice) -> np.ndarray:
        """Normalised joints u (..., n) float32 of rows of the waypoints."""
        return self.arrays["waypoints"][waypoints].astype(np.float32) / np.float32(FULL_SCALE)

    def path(self, row: int) -> np.ndarray:
        """Normalised joints u (t, n) float32 of one path."""
        return self.joints(slice(*self.arrays["path_start"][row : row + 2]))

    def padded(self, paths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Waypoints of paths (b,); shorter paths are padded with their last waypoint.

        Returns:
            Normalised joints (b, t, n) float32, and the counts (b,) of each path's own waypoints.
        """
        start = self.arrays["path_start"][paths]
        counts = self.arrays["path_start"][paths + 1] - start
        place = np.minimum(np.arange(counts.max()), counts[:, None] - 1)
        return self.joints(start[:, None] + place), counts

    def with_few_trivial(
        self, rows: np.ndarray, share: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Rows (k,) in order, at most this share of them trivial paths; all if all are trivial."""
        trivial = self.arrays["trivial"][rows]
        others = int((~trivial).sum())
        most = int(share / (1.0 - share) * others) if share < 1.0 else len(rows)
        if others == 0 or trivial.sum() <= most:
            return rows
        kept = ~trivial
        kept[rng.choice(np.flatnonzero(trivial), most, replace=False)] = True
        return rows[kept]

    def thinned(self, spacing: float | None) -> "PathDataset":
        """The dataset with fewer waypoints: both ends of each path, and one every `spacing` [rad].

        None keeps all; InvalidInputError for a spacing that is not positive.
        """
        if spacing is None:
            return self
        if not spacing > 0.0:
            raise InvalidInputError(f"spacing of waypoints is {spacing} rad; it must be positive")
        waypoints, start = self.arrays["waypoints"], self.arrays["path_start"]
        scale = (np.array(self.robot.upper) - np.array(self.robot.lower)) / FULL_SCALE
        steps = np.zeros(len(waypoints))
        block = 1 << 18
        # in blocks: the whole in floats would not fit everywhere
        for begin in range(1, len(steps), block):
            joints = waypoints[begin - 1 : begin + block] * scale
            steps[begin : begin + block] = np.linalg.norm(np.diff(joints, axis=0), axis=1)
        first, last, counts = start[:-1], start[1:] - 1, np.diff(start)
        steps[first] = 0.0
        total = np.cumsum(steps)
        along = total - total[first].repeat(counts)
        parts = np.maximum(1.0, np.ceil(along[last] / spacing - 1e-6))
        place = np.floor(along * (parts / np.maximum(along[last], 1e-9)).repeat(counts) + 1e-6)
        kept = np.diff(place, prepend=-1.0) != 0.0
        kept[first] = kept[last] = True
        start = np.concatenate(([0], np.add.reduceat(kept, first).cumsum()))
        thin = {"path_start": start, "waypoints": waypoints[kept]}
        return replace(self, arrays={**self.arrays, **thin})


class BaseTurn:
    """Rotations of robot and scene about the base, within the limits of joint 1 if `active`."""

    def __init__(self, dataset: PathDataset, wanted: bool) -> None:
        self.active = wanted and dataset.chain is not None and dataset.chain.turns_about_base
        self._range = np.float64(dataset.robot.upper[0] - dataset.robot.lower[0])
        first, starts = dataset.arrays["waypoints"][:, 0], dataset.arrays["path_start"][:-1]
        # (p,) of the first joint along each path
        self.least = np.minimum.reduceat(first, starts) / FULL_SCALE
        self.most = np.maximum.reduceat(first, starts) / FULL_SCALE

    def draw(self, paths: np.ndarray, rng: np.random.Generator) -> float:
        """One angle [rad] that keeps joint 1 of all these paths within its limits."""
        # two draws, as in the trainings of the shipped weights
        place = rng.random(2)[0]
        least, most = self.least[paths].min(), self.most[paths].max()
        return float((-least + place * (1.0 - most + least)) * self._range) if self.active else 0.0

    def draw_each(self, paths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Shifts (b,) of the normalised first joint that keep each path within its limits."""
        place = rng.random(len(paths))
        # u_1 + shift is uniform over what leaves the whole path within the limits
        shift = -self.least[paths] + place * (1.0 - self.most[paths] + self.least[paths])
        return (shift if self.active else np.zeros(len(paths))).astype(np.float32)

    def shift(self, angles: np.ndarray) -> np.ndarray:
        """What turns [rad] add to the normalised first joint: angle / (upper_1 - lower_1)."""
        return (angles / self._range).astype(np.float32)


@dataclass(frozen=True, eq=False)
class SequenceDataset(TrainingData):
    """A dataset of code sequences h_1 ... h_l from starts to goals.

    With a roadmap its arrays also say which of the nodes, edges and links are free in each scene;
    links are the straight motions from configurations to the nodes nearest to each.
    """

    graph: RoadmapGraph | None  # None where sequences are those of encoded paths

    def configurations(self, joints: np.ndarray) -> np.ndarray:
        """Configurations q = lower + u (upper - lower) (..., n) float32 of stored joints."""
        lower, upper = np.array(self.robot.lower), np.array(self.robot.upper)
        return (lower + joints / FULL_SCALE * (upper - lower)).astype(np.float32)

    def free(self, name: str, scenes: np.ndarray) -> np.ndarray:
        """Which "node" (k, N) or "edge" (k, E) of the roadmap is free in scenes (k,), bool."""
        count = len(getattr(self.graph, f"{name}s"))
        bits = self.arrays[f"{name}_free"][scenes]
        return np.unpackbits(bits, axis=1, count=count).astype(bool)


def open_dataset(folder: Path) -> PathDataset:
    """Read a dataset's paths into memory.

    InvalidInputError names the file that is missing, damaged, of another schema or of labels.
    """
    header = _header(folder)
    if holds_labels(folder):
        raise InvalidInputError(
            f"{folder} holds labels on a roadmap, not paths; make those: cvqmpt data generate "
            "--labels paths"
        )
    return PathDataset(**header, arrays=joined(read_shards(folder, PATH_ARRAYS), PATH_ARRAYS))


def open_labels(folder: Path) -> SequenceDataset:
    """Read a dataset's labels on a roadmap into memory; pairs without a path are left out.

    InvalidInputError names the file that is missing, damaged or of another kind.
    """
    header = _header(folder)
    if not holds_labels(folder):
        raise InvalidInputError(
            f"{folder} holds paths, not labels on a roadmap; make those: cvqmpt data generate "
            "--labels roadmap"
        )
    graph = RoadmapGraph.read(folder)
    arrays = joined(read_shards(folder, LABEL_ARRAYS), LABEL_ARRAYS)
    count = np.diff(arrays["code_start"])
    found = np.isfinite(arrays["cost"]) & (count > 0)
    for name, column in LABEL_ARRAYS.items():
        if column.rows == "path" and not column.ranges:
            arrays[name] = arrays[name][found]
    arrays["code_start"] = np.concatenate([[0], np.cumsum(count[found])])
    arrays["codes"] = arrays["codes"][np.repeat(found, count)]
    return SequenceDataset(**header, arrays=arrays, graph=graph)


def holds_labels(folder: Path) -> bool:
    """Whether a dataset holds labels on a roadmap instead of paths."""
    return (Path(folder) / ROADMAP_FILE).exists()


def _header(folder: Path) -> dict[str, Any]:
    """Fields of `TrainingData` that are in a dataset's description."""
    folder = Path(folder)
    path = folder / DESCRIPTION_FILE
    if not path.exists():
        raise InvalidInputError(
            f"no dataset in {folder}: it has no {DESCRIPTION_FILE}; generate one there first"
        )
    description = read_json_object(path)
    if description.get("schema") != SCHEMA:
        raise InvalidInputError(
            f"{path}: schema is {description.get('schema')!r}; this version reads {SCHEMA}"
        )
    ours = {"robot": "name", "kinematics_digest": "kinematics"}
    names = ("robot", "lower", "upper", "joints", "kinematics_digest")
    signature = {ours.get(name, name): description[name] for name in names if name in description}
    robot = from_plain(RobotSignature, signature, f"{path}: ")
    families = from_plain(tuple[str, ...], description.get("families"), f"{path}: families")
    if not families:
        raise InvalidInputError(f"{path}: families is empty; it must name one at least")
    chain = from_plain(SerialChain | None, description.get("kinematics"), f"{path}: kinematics")
    if chain is not None and len(chain.rotation) != len(robot.lower):
        raise InvalidInputError(
            f"{path}: kinematics has {len(chain.rotation)} joints, lower {len(robot.lower)}"
        )
    digest = hashlib.sha256()
    for file in (path, *shard_files(folder)):
        digest.update(hashlib.sha256(read_bytes(file)).digest())
    return {
        "folder": folder,
        "robot": robot,
        "families": families,
        "chain": chain,
        "sha256": digest.hexdigest(),
    }
