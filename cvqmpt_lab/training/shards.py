"""Folders of training data: random scenes with near-shortest paths or with labels on a roadmap.

``cvqmpt data generate`` writes::

    dataset.json        schema 1, robot, lower, upper [rad], joints, kinematics_digest,
                        robot_files (sha256 of each), families, kinematics (a
                        vqmpt.config.SerialChain), recipe, provenance
    shards/NNNNNN.npz   the arrays of `PATH_ARRAYS`, or of `LABEL_ARRAYS` with --labels roadmap
    roadmap.npz         a `RoadmapGraph`, with --labels roadmap

Joints are stored in 16 bits: 65535 u, with u = (q - lower) / (upper - lower) in [0, 1].
"""

import hashlib
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import read_bytes, write_bytes
from cvqmpt_lab.base.readers import read_arrays

DESCRIPTION_FILE = "dataset.json"
SHARDS_FOLDER = "shards"
SHARD_SCENES = 16  # scenes of a shard
FULL_SCALE = 65535.0  # value of a stored joint at its upper limit
WAYPOINT_SPACING_RAD = 0.13  # [rad] maximum distance of neighbouring waypoints of a path
LINKS_PER_END = 20  # nearest nodes of a roadmap that a start or goal is linked to


class Column(NamedTuple):
    """An array of a shard."""

    rows: str  # item of each entry: scene, shape, path, waypoint, code or end (of links)
    dtype: str
    # entries are the first items of ranges of this kind; one more entry ends the last range
    ranges: str = ""
    below: str = ""  # entries are row numbers of items of this kind


SCENE_ARRAYS = {
    "family": Column("scene", "uint8"),
    "scene_seed": Column("scene", "int64"),
    "shape_start": Column("scene", "int32", ranges="shape"),
    # kind, size [m] and pose T_world_shape as in `dataset.Shapes`
    "shape_kind": Column("shape", "uint8"),
    "shape_size": Column("shape", "float32"),
    "shape_pose": Column("shape", "float32"),
    "path_scene": Column("path", "int32", below="scene"),
    # distance from start to goal [rad]
    "straight": Column("path", "float32"),
}
PATH_ARRAYS = SCENE_ARRAYS | {
    "path_start": Column("path", "int32", ranges="waypoint"),
    "waypoints": Column("waypoint", "uint16"),
    "length": Column("path", "float32"),  # [rad]
    "trivial": Column("path", "bool"),  # whether the straight line from start to goal is free
}
LABEL_ARRAYS = SCENE_ARRAYS | {
    # packed bits: whether each node and edge is free
    "node_free": Column("scene", "uint8"),
    "edge_free": Column("scene", "uint8"),
    # start and goal of a path, and the nodes of the shortest path between them
    "ends": Column("path", "uint16"),
    "code_start": Column("path", "int32", ranges="code"),
    "codes": Column("code", "uint16"),
    # length of the shortest path [rad], inf if there is none
    "cost": Column("path", "float32"),
    # configurations, their nearest nodes, and whether the straight motion to each node is free
    "link_start": Column("scene", "int32", ranges="end"),
    "link_end": Column("end", "uint16"),
    "link_code": Column("end", "uint16"),
    "link_free": Column("end", "bool"),
}


def shard_files(folder: Path) -> list[Path]:
    """Return the files of a folder's shards in order; shards are written whole or not at all."""
    return sorted((folder / SHARDS_FOLDER).glob("[0-9]*.npz"))


def read_shards(
    folder: Path, columns: Mapping[str, Column], joints: int | None = None
) -> list[dict[str, np.ndarray]]:
    """Read the arrays named in `columns` from every shard of a folder.

    Args:
        folder: folder of the dataset.
        columns: arrays to read.
        joints: number of the robot's joints; None: no array of configurations is read.

    Raises:
        InvalidInputError: there is no shard, a shard is missing between others, or one is damaged,
            lacks an array or has another number of joints.
    """
    files = shard_files(folder)
    if not files:
        raise InvalidInputError(f"{folder / SHARDS_FOLDER} has no shard; generate paths first")
    for number, path in enumerate(files):
        if int(path.stem) != number:
            raise InvalidInputError(
                f"{folder / SHARDS_FOLDER} lacks shard {number:06d} but has {path.name}: generate "
                "again with the same options, which adds the missing shards"
            )
    of_joints = {"waypoints", "ends", "link_end"}  # arrays whose last axis are the joints
    shards = [_arrays(path, columns) for path in files]
    for path, shard in zip(files, shards, strict=True):
        for name in sorted(of_joints & shard.keys()):
            shape = shard[name].shape
            if shape[-1:] != (joints,):
                raise InvalidInputError(
                    f"{path}: {name} has shape {shape}, but the robot of {DESCRIPTION_FILE} has "
                    f"{joints} joints: delete this shard and generate again"
                )
    return shards


def joined(
    shards: Sequence[Mapping[str, np.ndarray]], columns: Mapping[str, Column]
) -> dict[str, np.ndarray]:
    """Concatenate the arrays of several shards; row numbers and ranges are shifted."""
    before: dict[str, np.ndarray] = {}  # number of items of each kind before each shard, and in all
    for name, column in columns.items():
        if not column.ranges and column.rows not in before:
            before[column.rows] = np.cumsum([0, *(len(shard[name]) for shard in shards)])
    found = {}
    for name in [name for name in shards[0] if name in columns]:
        column, parts = columns[name], [shard[name] for shard in shards]
        offsets = before.get(column.ranges or column.below)
        if offsets is not None:
            shifted = zip(parts, offsets, strict=False)
            parts = [part.astype(int) + offset for part, offset in shifted]
        if column.ranges:
            parts = [*(part[:-1] for part in parts), before[column.ranges][-1:]]
        found[name] = np.concatenate(parts)
    return found


def packed(configurations: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Convert joints q to 16-bit integers, round(65535 (q - lower) / (upper - lower)).

    Args:
        configurations: q (..., n) [rad or m].
        lower: (n,) joint limits [rad or m].
        upper: (n,) joint limits [rad or m].
    """
    u = (configurations - lower) / (upper - lower)
    return np.rint(np.clip(u, 0.0, 1.0) * FULL_SCALE).astype(np.uint16)


def _arrays(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Read arrays of an npz file; InvalidInputError if it is damaged (checksum) or lacks one."""
    data = read_bytes(path)
    try:
        found = read_arrays(data)
        return {name: found[name] for name in names}
    # a damaged archive can raise any exception
    except Exception as error:
        raise InvalidInputError(
            f"{path} is damaged or lacks an array: {error}; delete it and generate again"
        ) from error


def archive(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return arrays as the content of a compressed npz file."""
    file = io.BytesIO()
    # numpy's type stubs accept only bool for keyword arguments
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


@dataclass(frozen=True, eq=False)
class RoadmapGraph:
    """The roadmap whose nodes and edges are labelled."""

    file_name: ClassVar[str] = "roadmap.npz"

    nodes: np.ndarray  # (N, n) [rad or m]
    edges: np.ndarray  # (E, 2) int32, each pair once
    edge_possible: np.ndarray  # (E,) bool: free in an empty scene
    # (k,) int64, joint that moves each body point, see `roadmap_labels.body_points`
    body_joint: np.ndarray
    body_offset: np.ndarray  # (k, 3) [m], position of each body point in that joint's frame

    @property
    def digest(self) -> str:
        """sha256 of the nodes."""
        return hashlib.sha256(self.nodes.tobytes()).hexdigest()

    def write(self, folder: Path) -> None:
        """Write the roadmap to a dataset's folder."""
        write_bytes(folder / self.file_name, archive(vars(self)))

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the roadmap of a dataset's folder; InvalidInputError if missing or damaged."""
        names = [field.name for field in fields(cls)]
        return cls(**_arrays(folder / cls.file_name, names))
