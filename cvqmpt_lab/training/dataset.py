"""Datasets in memory: scenes as shapes, and paths as waypoints.

Joints u are normalised to [0, 1] between the joint limits. Scenes whose seed is divisible by 20 are
for validation, the others for training. `shards` describes the folder on disk and the arrays;
`sequence_dataset` has paths as sequences of codes.
"""

import hashlib
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, mapping
from cvqmpt_lab.base.files import read_bytes, read_json_object
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    FULL_SCALE,
    PATH_ARRAYS,
    SHARD_SCENES,
    RoadmapGraph,
    joined,
    read_shards,
    shard_files,
)
from cvqmpt_lab.vqmpt.config import SerialChain
from cvqmpt_lab.vqmpt.weights import RobotSignature

DATASET_SCHEMA = 1
VALIDATION_EVERY = 20  # scenes whose seed is divisible by this number are for validation

SplitName = Literal["train", "validation"]


class Shapes(NamedTuple):
    """m boxes, cylinders and spheres of a scene."""

    kind: np.ndarray  # (m,) uint8: 0 box, 1 cylinder (axis z), 2 sphere
    # (m, 3) float32 [m]: x, y, z; or radius, radius, height; or radius, radius, radius
    size: np.ndarray
    pose: np.ndarray  # (m, 3, 4) float32: T_world_shape [m]


@dataclass(frozen=True, eq=False)
class TrainingData:
    """A dataset of s scenes and p paths: its description, and the joined arrays of its shards."""

    folder: Path
    robot: RobotSignature
    families: tuple[str, ...]
    chain: SerialChain | None  # kinematics for link positions; None if the description has none
    sha256: str  # digest of the description and all shards
    arrays: Mapping[str, np.ndarray]  # by the names of `shards.PATH_ARRAYS` or `LABEL_ARRAYS`

    @property
    def validates(self) -> np.ndarray:
        """Whether each scene (s,) is for validation, bool."""
        return self.arrays["scene_seed"] % VALIDATION_EVERY == 0

    def shapes(self, scene: int) -> Shapes:
        """Return the shapes of a scene."""
        rows = slice(*self.arrays["shape_start"][scene : scene + 2])
        return Shapes(*(self.arrays[f"shape_{name}"][rows] for name in Shapes._fields))

    def split(self, name: SplitName) -> np.ndarray:
        """Return the rows of the paths for training or for validation."""
        return np.flatnonzero(self.validates[self.arrays["path_scene"]] == (name == "validation"))


@dataclass(frozen=True, eq=False)
class PathDataset(TrainingData):
    """A dataset of paths."""

    def require_splits(self) -> None:
        """Raise InvalidInputError if there is no path for training or none for validation."""
        for name in get_args(SplitName):
            if len(self.split(name)) == 0:
                raise InvalidInputError(
                    f"{self.folder} has no {name} path (scene seeds divisible by "
                    f"{VALIDATION_EVERY} validate); generate more scenes"
                )

    def joints(self, waypoints: np.ndarray | slice) -> np.ndarray:
        """Return normalised joints u (..., n) float32 of these rows of the waypoints."""
        return self.arrays["waypoints"][waypoints].astype(np.float32) / np.float32(FULL_SCALE)

    def path(self, row: int) -> np.ndarray:
        """Return normalised joints u (t, n) float32 of one path."""
        return self.joints(slice(*self.arrays["path_start"][row : row + 2]))

    def padded(self, paths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return waypoints of paths (b,); shorter paths are padded with their last waypoint.

        Returns:
            Normalised joints (b, t, n) float32, and the number of waypoints of each path (b,)
            without padding.
        """
        start = self.arrays["path_start"][paths]
        counts = self.arrays["path_start"][paths + 1] - start
        place = np.minimum(np.arange(counts.max()), counts[:, None] - 1)
        return self.joints(start[:, None] + place), counts

    def with_few_trivial(
        self, rows: np.ndarray, share: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Leave out random trivial paths, whose straight line is free, if they are too many.

        Args:
            rows: (k,), paths.
            share: maximum share of trivial paths in the result.
            rng: random numbers.

        Returns:
            The remaining rows in their order; all rows if all are trivial.
        """
        trivial = self.arrays["trivial"][rows]
        others = int((~trivial).sum())
        most = int(share / (1.0 - share) * others) if share < 1.0 else len(rows)
        if others == 0 or trivial.sum() <= most:
            return rows
        kept = ~trivial
        kept[rng.choice(np.flatnonzero(trivial), most, replace=False)] = True
        return rows[kept]

    def thinned(self, spacing: float | None) -> "PathDataset":
        """Return the dataset with fewer waypoints: the ends of each path, and one every `spacing`.

        spacing: [rad]; None keeps all waypoints; InvalidInputError if it is not positive.
        """
        if spacing is None:
            return self
        if not spacing > 0.0:
            raise InvalidInputError(f"spacing of waypoints is {spacing} rad; it must be positive")
        waypoints, start = self.arrays["waypoints"], self.arrays["path_start"]
        scale = (np.array(self.robot.upper) - np.array(self.robot.lower)) / FULL_SCALE
        steps = np.zeros(len(waypoints))
        block = 1 << 18  # waypoints converted to floats at a time, which limits memory
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
    """Random rotations of robot and scene about the base, within the limits of joint 1.

    They are 0 if they are not wanted, or if joint 1 does not rotate the whole robot.
    """

    def __init__(self, dataset: PathDataset, wanted: bool) -> None:
        self.active = wanted and dataset.chain is not None and dataset.chain.turns_about_base
        self._range = np.float64(dataset.robot.upper[0] - dataset.robot.lower[0])  # [rad]
        first, starts = dataset.arrays["waypoints"][:, 0], dataset.arrays["path_start"][:-1]
        # (p,), range of the normalised first joint along each path
        self.least = np.minimum.reduceat(first, starts) / FULL_SCALE
        self.most = np.maximum.reduceat(first, starts) / FULL_SCALE

    def draw(self, paths: np.ndarray, rng: np.random.Generator) -> float:
        """Draw one angle [rad] that keeps joint 1 of all these paths within its limits."""
        # two numbers are drawn, as in the trainings of the shipped weights
        place = rng.random(2)[0]
        if not self.active:
            return 0.0
        least, most = self.least[paths].min(), self.most[paths].max()
        return float((-least + place * (1.0 - most + least)) * self._range)

    def draw_each(self, paths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw offsets (b,) of the normalised first joint that keep each path within its limits."""
        place = rng.random(len(paths))
        if not self.active:
            return np.zeros(len(paths), dtype=np.float32)
        # uniform over all offsets that keep the whole path within the limits
        shift = -self.least[paths] + place * (1.0 - self.most[paths] + self.least[paths])
        return shift.astype(np.float32)

    def shift(self, angles: np.ndarray) -> np.ndarray:
        """Offset of the normalised first joint for rotations `angles` [rad]."""
        return (angles / self._range).astype(np.float32)


def open_dataset(folder: Path) -> PathDataset:
    """Read a dataset's paths into memory.

    Raises:
        InvalidInputError: a file is missing, damaged or of another kind; the message names it.
    """
    description = read_dataset_description(folder)
    if holds_labels(folder):
        raise InvalidInputError(
            f"{folder} holds labels on a roadmap, not paths; make those: cvqmpt data generate "
            "--labels paths"
        )
    shards = read_shards(folder, PATH_ARRAYS, len(description["robot"].lower))
    return PathDataset(**description, arrays=joined(shards, PATH_ARRAYS))


def holds_labels(folder: Path) -> bool:
    """Whether a dataset holds labels on a roadmap instead of paths."""
    return (Path(folder) / RoadmapGraph.file_name).exists()


def read_dataset_description(folder: Path) -> dict[str, Any]:
    """Read a dataset's description: the fields of `TrainingData` without the arrays.

    Raises:
        InvalidInputError: it is missing, malformed, or of another schema, or shards are missing.
    """
    folder = Path(folder)
    path = folder / DESCRIPTION_FILE
    if not path.exists():
        raise InvalidInputError(
            f"no dataset in {folder}: it has no {DESCRIPTION_FILE}; generate one there first"
        )
    description = read_json_object(path)
    if description.get("schema") != DATASET_SCHEMA:
        raise InvalidInputError(
            f"{path}: schema is {description.get('schema')!r}; this version reads {DATASET_SCHEMA}"
        )
    fields = {  # field of RobotSignature -> field of the description
        "name": "robot",
        "lower": "lower",
        "upper": "upper",
        "joints": "joints",
        "kinematics": "kinematics_digest",
    }
    signature = {name: description[field] for name, field in fields.items() if field in description}
    robot = from_plain(RobotSignature, signature, f"{path}: ")
    families = from_plain(tuple[str, ...], description.get("families"), f"{path}: families")
    if not families:
        raise InvalidInputError(f"{path}: families is empty; it must name at least one")
    chain = from_plain(SerialChain | None, description.get("kinematics"), f"{path}: kinematics")
    if chain is not None and len(chain.rotation) != len(robot.lower):
        raise InvalidInputError(
            f"{path}: kinematics has {len(chain.rotation)} joints, lower {len(robot.lower)}"
        )
    files = shard_files(folder)
    _require_complete(description, path, len(files))
    digest = hashlib.sha256()
    for file in (path, *files):
        digest.update(hashlib.sha256(read_bytes(file)).digest())
    return {
        "folder": folder,
        "robot": robot,
        "families": families,
        "chain": chain,
        "sha256": digest.hexdigest(),
    }


def _require_complete(description: Mapping[str, Any], path: Path, shards: int) -> None:
    """Refuse a dataset whose generation was interrupted: training would use a part of its scenes.

    Args:
        description: content of the description's file; some have no recipe or no provenance.
        path: that file.
        shards: number of shards of the dataset.
    """
    recipe = mapping(description.get("recipe", {}), f"{path}: recipe")
    scenes = from_plain(int, recipe.get("scenes", 0), f"{path}: recipe.scenes")
    asked = -(-scenes // SHARD_SCENES)
    if shards < asked:
        session = mapping(description.get("provenance", {}), f"{path}: provenance")
        words = from_plain(tuple[str, ...], session.get("command", ()), f"{path}: command")
        command = shlex.join(words) or "cvqmpt data generate with the same options"
        raise InvalidInputError(
            f"{path.parent} has {shards} of {asked} shards: its generation was interrupted; add "
            f"the others: {command}"
        )
