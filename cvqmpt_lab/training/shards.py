"""Folders of training data: random scenes, and near-shortest paths or labels on a roadmap in them.

As ``cvqmpt data generate`` writes them::

    dataset.json        schema 1, robot, lower, upper [rad], joints, kinematics_digest, families,
                        kinematics (a vqmpt.config.SerialChain), recipe, provenance
    shards/NNNNNN.npz   the arrays of `PATH_ARRAYS`, or of `LABEL_ARRAYS` with --labels roadmap
    roadmap.npz         a `RoadmapGraph`, with --labels roadmap

Joints are stored in 16 bits: 65535 u, with u = (q - lower) / (upper - lower) in [0, 1].
"""

import hashlib
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import read_bytes, write_bytes

DESCRIPTION_FILE = "dataset.json"
ROADMAP_FILE = "roadmap.npz"
SHARDS_FOLDER = "shards"
FULL_SCALE = 65535.0  # what a stored joint is at the upper limit
SPACING = 0.13  # [rad] between waypoints of a path, at most
LINKS = 20  # nodes of a roadmap that a start or goal is linked to


class Column(NamedTuple):
    """What an array of a shard holds; n joints, N nodes and E edges."""

    rows: str  # there is one entry for each scene, shape, path, waypoint, code or end of links
    dtype: str
    ranges: str = ""  # each entry is where a range of these items begins; at last, where it ends
    below: str = ""  # each entry is the number of one of these


SCENE_ARRAYS = {
    "family": Column("scene", "uint8"),
    "scene_seed": Column("scene", "int64"),
    "shape_start": Column("scene", "int32", ranges="shape"),
    # 0 box, 1 cylinder, 2 sphere; sizes and poses T_world_shape [m] as in `dataset.Shapes`
    "shape_kind": Column("shape", "uint8"),
    "shape_size": Column("shape", "float32"),
    "shape_pose": Column("shape", "float32"),
    "path_scene": Column("path", "int32", below="scene"),
    # [rad], from the start straight to the goal
    "straight": Column("path", "float32"),
}
PATH_ARRAYS = SCENE_ARRAYS | {
    "path_start": Column("path", "int32", ranges="waypoint"),
    "waypoints": Column("waypoint", "uint16"),
    "length": Column("path", "float32"),
    # the straight line is free
    "trivial": Column("path", "bool"),
}
LABEL_ARRAYS = SCENE_ARRAYS | {
    # packed bits: 1 where the node or edge is free
    "node_free": Column("scene", "uint8"),
    "edge_free": Column("scene", "uint8"),
    # start and goal, and the nodes that the shortest path between them leads through
    "ends": Column("path", "uint16"),
    "code_start": Column("path", "int32", ranges="code"),
    "codes": Column("code", "uint16"),
    # length through the codes [rad], inf where there is no path
    "cost": Column("path", "float32"),
    # configurations, the nodes nearest to each, and whether the straight motion to these is free
    "link_start": Column("scene", "int32", ranges="end"),
    "link_end": Column("end", "uint16"),
    "link_code": Column("end", "uint16"),
    "link_free": Column("end", "bool"),
}


def shard_files(folder: Path) -> list[Path]:
    """Files of the shards of a folder, in order; a file that is there is complete."""
    return sorted((folder / SHARDS_FOLDER).glob("[0-9]*.npz"))


def read_shards(folder: Path, columns: Mapping[str, Column]) -> list[dict[str, np.ndarray]]:
    """The arrays that `columns` names of every shard of a folder.

    InvalidInputError: there is no shard, one between others is missing, or one is damaged or lacks
    an array.
    """
    files = shard_files(folder)
    if not files:
        raise InvalidInputError(f"{folder / SHARDS_FOLDER} has no shard; generate paths first")
    for number, path in enumerate(files):
        if int(path.stem) != number:
            raise InvalidInputError(
                f"{folder / SHARDS_FOLDER} lacks shard {number:06d} but has {path.name}: generate "
                "again with the same options, which makes what is missing"
            )
    return [_arrays(path, columns) for path in files]


def joined(
    shards: Sequence[Mapping[str, np.ndarray]], columns: Mapping[str, Column]
) -> dict[str, np.ndarray]:
    """Concatenate the arrays of several shards; row numbers and ranges are shifted."""
    before = {}
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
    """Joints as 16-bit shares of their range: 65535 (q - lower) / (upper - lower), rounded."""
    u = (configurations - lower) / (upper - lower)
    return np.rint(np.clip(u, 0.0, 1.0) * FULL_SCALE).astype(np.uint16)


def _arrays(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Arrays of an npz file, whose checksums are compared; InvalidInputError names a bad file."""
    data = read_bytes(path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: file[name] for name in names}
    # what a damaged archive raises depends on the byte
    except Exception as error:
        raise InvalidInputError(
            f"{path} is damaged or lacks an array: {error}; delete it and generate again"
        ) from error


def archive(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Arrays as the content of a compressed npz file."""
    file = io.BytesIO()
    # numpy's stubs know only options that are bool
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


@dataclass(frozen=True, eq=False)
class RoadmapGraph:
    """The nodes and edges that are labelled."""

    nodes: np.ndarray  # (N, n) [rad]
    edges: np.ndarray  # (E, 2) int32, each pair once
    edge_possible: np.ndarray  # (E,) bool: free in an empty scene
    # (k,) int64, joint that moves each body point, see `labels.roadmap_labels.body_points`
    body_joint: np.ndarray
    body_offset: np.ndarray  # (k, 3) [m], where each is in that joint's frame

    @property
    def digest(self) -> str:
        """sha256 of the nodes."""
        return hashlib.sha256(self.nodes.tobytes()).hexdigest()

    def write(self, folder: Path) -> None:
        """Write it into a dataset's folder."""
        write_bytes(folder / ROADMAP_FILE, archive(vars(self)))

    @classmethod
    def read(cls, folder: Path) -> Self:
        """What `write` wrote; InvalidInputError where it is missing or damaged."""
        return cls(**_arrays(folder / ROADMAP_FILE, cls.__annotations__))
