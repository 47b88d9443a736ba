"""A dataset of training paths, opened: the shards of its folder joined, split for training and validation.

Joints u are normalised to [0, 1] between the limits. Scenes whose seed is divisible by 20 validate, the others
train; twins, second labels of a path, do neither. `shards` describes the folder on disk.
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
from cvqmpt_lab.training.paths import Paths, Scenes, Shapes, thinned
from cvqmpt_lab.training.roadmap_paths import path_arrays
from cvqmpt_lab.training.roadmap_shards import ROADMAP_FILE, read_roadmap_shards
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    INDEX_FILE,
    SCHEMA,
    Arrays,
    read_index,
    read_shard,
)
from cvqmpt_lab.vqmpt.inputs import SerialChain
from cvqmpt_lab.vqmpt.weights import RobotSignature

VALIDATION_EVERY = 20
"""Seeds of scenes, the divisible ones of which validate."""

SplitName = Literal["train", "validation"]


@dataclass(frozen=True, eq=False)
class PathDataset:
    """An opened dataset."""

    folder: Path
    robot: RobotSignature
    families: tuple[str, ...]
    chain: SerialChain | None
    """Kinematics for link positions; None when the description has none."""
    sha256: str
    """Of the description and the index, which holds those of the shards."""
    scenes: Scenes
    paths: Paths

    @property
    def joint_dim(self) -> int:
        """Joints of the robot."""
        return len(self.robot.lower)

    def split(self, name: SplitName) -> np.ndarray:
        """Rows of the paths that train or validate, without twins."""
        if name not in get_args(SplitName):
            raise UnknownChoiceError("split", name, get_args(SplitName))
        validates = self.scenes.seed[self.paths.scene] % VALIDATION_EVERY == 0
        return np.flatnonzero((validates == (name == "validation")) & (self.paths.twin_of < 0))

    def require_splits(self) -> None:
        """Check that there is something to train on and something to validate with.

        Raises
        ------
        InvalidInputError
            Naming the split that has no path.
        """
        for name in get_args(SplitName):
            if len(self.split(name)) == 0:
                raise InvalidInputError(
                    f"{self.folder} has no {name} path (scene seeds divisible by {VALIDATION_EVERY} validate); "
                    "generate more scenes"
                )

    def thinned(self, spacing: float | None) -> "PathDataset":
        """The dataset with fewer waypoints: both ends of a path, and the first
        waypoint after every `spacing` [rad] of it, evenly; all of them for None.
        """
        if spacing is None:
            return self
        span = np.array(self.robot.upper) - np.array(self.robot.lower)
        return replace(self, paths=thinned(self.paths, span, spacing))


def open_dataset(folder: Path, *, verify: bool = True) -> PathDataset:
    """Read a whole dataset into memory.

    Parameters
    ----------
    folder
        What ``cvqmpt data generate`` wrote; of roadmap labels some paths of each scene are read.
    verify
        Compare every shard with its sha256.

    Raises
    ------
    InvalidInputError
        Naming the file that is missing, damaged or of another schema.
    """
    folder = Path(folder)
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
    robot, families = _robot(description, path), _families(description, path)
    joints, chain = len(robot.lower), None
    if description.get("kinematics") is not None:
        chain = from_plain(SerialChain, description["kinematics"], f"{path}: kinematics")
        if len(chain.rotation) != joints:
            raise InvalidInputError(f"{path}: kinematics has {len(chain.rotation)} joints, lower {joints}")
    if (folder / ROADMAP_FILE).exists():
        shards = path_arrays(read_roadmap_shards(folder), robot)
    else:
        shards = [read_shard(folder, row, joints, len(families), verify=verify) for row in read_index(folder)]
    digest = hashlib.sha256(read_bytes(path) + read_bytes(folder / INDEX_FILE)).hexdigest()
    return PathDataset(folder, robot, families, chain, digest, _scenes(shards), _paths(shards))


def _robot(description: Mapping[str, Any], path: Path) -> RobotSignature:
    known = {"robot": "name", "lower": "lower", "upper": "upper", "joints": "joints"}
    known["kinematics_digest"] = "kinematics"
    named = {ours: description[theirs] for theirs, ours in known.items() if theirs in description}
    return from_plain(RobotSignature, named, f"{path}: ")


def _families(description: Mapping[str, Any], path: Path) -> tuple[str, ...]:
    families = from_plain(tuple[str, ...], description.get("families"), f"{path}: families")
    if not families:
        raise InvalidInputError(f"{path}: families is empty; it must name one at least")
    return families


def _scenes(shards: list[Arrays]) -> Scenes:
    """All scenes, rows counted through."""
    return Scenes(
        family=_together(shards, "family"),
        seed=_together(shards, "scene_seed"),
        shape_start=_ranges(shards, "shape_start", "shape_kind"),
        shape=Shapes(
            _together(shards, "shape_kind"),
            _together(shards, "shape_size").astype(np.float32),
            _together(shards, "shape_pose").astype(np.float32),
        ),
    )


def _paths(shards: list[Arrays]) -> Paths:
    """All paths, rows counted through."""
    return Paths(
        scene=_shifted(shards, "path_scene", "scene_seed"),
        start=_ranges(shards, "path_start", "waypoints"),
        waypoints=_together(shards, "waypoints"),
        trivial=_together(shards, "trivial").astype(bool),
        twin_of=_shifted(shards, "twin_of", "path_scene"),
        length=_together(shards, "length"),
        straight=_together(shards, "straight"),
    )


def _together(shards: list[Arrays], name: str) -> np.ndarray:
    return np.concatenate([shard[name] for shard in shards])


def _offsets(shards: list[Arrays], items: str) -> list[int]:
    """How many items there are before each shard, and in all."""
    return np.cumsum([0, *(len(shard[items]) for shard in shards)]).tolist()


def _shifted(shards: list[Arrays], name: str, items: str) -> np.ndarray:
    """Rows of items, counted through; -1 stays."""
    parts = zip(shards, _offsets(shards, items), strict=False)
    return np.concatenate([np.where(s[name] < 0, -1, s[name].astype(np.int64) + o) for s, o in parts])


def _ranges(shards: list[Arrays], name: str, items: str) -> np.ndarray:
    """Where each range of items begins, and where the last ends."""
    offsets = _offsets(shards, items)
    starts = [s[name][:-1].astype(np.int64) + o for s, o in zip(shards, offsets, strict=False)]
    return np.concatenate([*starts, offsets[-1:]])
