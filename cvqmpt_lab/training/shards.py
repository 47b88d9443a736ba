"""Folders of training data: random scenes, and near-shortest paths or labels on a roadmap in them.

As ``cvqmpt data generate`` writes them::

    dataset.json        schema 1, robot, lower, upper [rad], joints, kinematics_digest, families,
                        kinematics (a vqmpt.config.SerialChain), recipe, provenance
    shards.csv          shard, sha256, scenes, paths
    shards/NNNNNN.npz   the arrays of `PATH_ARRAYS`, or of `LABEL_ARRAYS` with --labels roadmap
    roadmap.npz         a `RoadmapGraph`, with --labels roadmap

Joints are stored in 16 bits: 65535 u, with u = (q - lower) / (upper - lower) in [0, 1].
"""

import hashlib
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_bytes, read_text, write_bytes, write_text

DESCRIPTION_FILE = "dataset.json"
INDEX_FILE = "shards.csv"
ROADMAP_FILE = "roadmap.npz"
SHARDS_FOLDER = "shards"
FULL_SCALE = 65535.0  # what a stored joint is at the upper limit
SPACING = 0.13  # [rad] between waypoints of a path, at most
LINKS = 20  # nodes of a roadmap that a start or goal is linked to


class Column(NamedTuple):
    """What an array of a shard holds; n joints, N nodes and E edges."""

    rows: str  # there is one entry for each scene, shape, path, waypoint, code or end of links
    dtype: str  # as it is written; one of the same kind can be read
    shape: tuple[int | str, ...] = ()  # of an entry
    ranges: str = ""  # each entry is where a range of these items begins; at last, where it ends
    below: str = ""  # each entry is less than the number of these
    least: int = 0  # smallest entry, or length of a range
    finite: bool = True


SCENE_ARRAYS = {
    "family": Column("scene", "uint8", below="families"),
    "scene_seed": Column("scene", "int64"),
    "shape_start": Column("scene", "int32", ranges="shape"),
    # 0 box, 1 cylinder, 2 sphere; sizes and poses T_world_shape [m] as in `dataset.Shapes`
    "shape_kind": Column("shape", "uint8", below="kinds of shapes"),
    "shape_size": Column("shape", "float32", (3,)),
    "shape_pose": Column("shape", "float32", (3, 4)),
    "path_scene": Column("path", "int32", below="scene"),
    # [rad], from the start straight to the goal
    "straight": Column("path", "float32"),
}
PATH_ARRAYS = SCENE_ARRAYS | {
    "path_start": Column("path", "int32", ranges="waypoint", least=2),
    "waypoints": Column("waypoint", "uint16", ("n",)),
    "length": Column("path", "float32"),
    # the straight line is free
    "trivial": Column("path", "bool"),
    # the path of which this is a second label, or -1
    "twin_of": Column("path", "int32", below="path", least=-1),
}
LABEL_ARRAYS = SCENE_ARRAYS | {
    # packed bits: 1 where the node or edge is free
    "node_free": Column("scene", "uint8", ("N/8",)),
    "edge_free": Column("scene", "uint8", ("E/8",)),
    # start and goal, and the nodes that the shortest path between them leads through
    "ends": Column("path", "uint16", (2, "n")),
    "code_start": Column("path", "int32", ranges="code"),
    "codes": Column("code", "uint16", below="N"),
    # length through the codes [rad], inf where there is no path
    "cost": Column("path", "float32", finite=False),
    # the codes are others than those of the shortest path in an empty scene
    "differs": Column("path", "bool"),
    # configurations, the nodes nearest to each, and whether the straight motion to these is free
    "link_start": Column("scene", "int32", ranges="end"),
    "link_end": Column("end", "uint16", ("n",)),
    "link_code": Column("end", "uint16", (LINKS,), below="N"),
    "link_free": Column("end", "bool", (LINKS,)),
}


class IndexRow(NamedTuple):
    """One line of the index."""

    shard: int
    sha256: str
    scenes: int
    paths: int

    @property
    def file(self) -> str:
        """Name of the shard's file."""
        return f"{self.shard:06d}.npz"


def packed_shard(number: int, arrays: dict[str, np.ndarray]) -> tuple[IndexRow, bytes]:
    """Return the index row and the file content of a shard."""
    content = _archive(arrays)
    counts = len(arrays["scene_seed"]), len(arrays["path_scene"])
    return IndexRow(number, hashlib.sha256(content).hexdigest(), *counts), content


def write_shard(folder: Path, row: IndexRow, content: bytes, rows: Iterable[IndexRow]) -> None:
    """Write a shard, then the index of all `rows`, its own included."""
    write_bytes(folder / SHARDS_FOLDER / row.file, content)
    lines = [f"{row.shard:06d},{row.sha256},{row.scenes},{row.paths}" for row in sorted(rows)]
    write_text(folder / INDEX_FILE, "\n".join((",".join(IndexRow._fields), *lines, "")))


def finished_shards(folder: Path) -> list[IndexRow]:
    """Rows of the index whose shard is complete on disk; damaged lines are skipped."""
    path = folder / INDEX_FILE
    lines = read_text(path).splitlines(keepends=True) if path.exists() else []
    rows = {row.shard: row for row in map(_parsed, lines) if row is not None}
    finished = []
    for row in rows.values():
        shard = folder / SHARDS_FOLDER / row.file
        if shard.is_file() and hashlib.sha256(read_bytes(shard)).hexdigest() == row.sha256:
            finished.append(row)
    return finished


def _parsed(line: str) -> IndexRow | None:
    """The row of a line of the index, line end included; None for a damaged line."""
    found = re.fullmatch(r"(\d{1,9}),([0-9a-f]{64}),(\d{1,9}),(\d{1,9})\n", line)
    return found and IndexRow(int(found[1]), found[2], int(found[3]), int(found[4]))


def read_shards(
    folder: Path, columns: Mapping[str, Column], sizes: Mapping[str, int]
) -> list[dict[str, np.ndarray]]:
    """Arrays of every shard of a folder.

    Args:
        folder: of the dataset.
        columns: the arrays that a shard must have.
        sizes: numbers that columns name: families, n, N, N/8, E/8.

    InvalidInputError names the file that is missing or damaged, and the arrays that contradict the
    index or each other.
    """
    path, header = folder / INDEX_FILE, ",".join(IndexRow._fields)
    first, *lines = read_text(path).splitlines(keepends=True) or [""]
    if first != f"{header}\n":
        raise InvalidInputError(f"{path}: the first line must be {header}")
    if not lines:
        raise InvalidInputError(f"{path} lists no shard; generate paths first")
    rows: dict[int, IndexRow] = {}
    for number, line in enumerate(lines, 2):
        row = _parsed(line)
        if row is None or row.shard in rows:
            raise InvalidInputError(
                f"{path}, line {number} is damaged, cut short or of a shard listed before; "
                "generate again, which repairs it"
            )
        rows[row.shard] = row
    return [_read_shard(folder, row, columns, sizes) for row in rows.values()]


def _read_shard(
    folder: Path, row: IndexRow, columns: Mapping[str, Column], sizes: Mapping[str, int]
) -> dict[str, np.ndarray]:
    path = folder / SHARDS_FOLDER / row.file
    data = read_bytes(path)
    if hashlib.sha256(data).hexdigest() != row.sha256:
        raise InvalidInputError(f"{path} is damaged (sha256); fetch or generate it again")
    arrays = _arrays(path, data)
    counts = {"kinds of shapes": 3, **sizes, "scene": row.scenes, "path": row.paths}
    for name, column in columns.items():
        array = arrays.get(name, np.empty(()))
        if array.ndim != 1 + len(column.shape) or array.dtype.kind != np.dtype(column.dtype).kind:
            raise InvalidInputError(
                f"{path}: array {name} is missing or not as described; generate it again"
            )
        counts.setdefault(column.rows, len(array))
    wrong = [name for name, column in columns.items() if not _fits(arrays[name], column, counts)]
    if wrong:
        raise InvalidInputError(
            f"{path}: {', '.join(wrong)} does not fit the index, the roadmap or the other arrays; "
            "generate it again"
        )
    return arrays


def _fits(array: np.ndarray, column: Column, counts: Mapping[str, int]) -> bool:
    """Whether an array has the shape and values of its column, given all counts."""
    shape = [counts[part] if isinstance(part, str) else part for part in column.shape]
    if [*array.shape] != [counts[column.rows] + bool(column.ranges), *shape]:
        return False
    if column.ranges:
        begins_and_ends = array[0] == 0 and array[-1] == counts[column.ranges]
        return bool(begins_and_ends and (np.diff(array.astype(int)) >= column.least).all())
    if column.below:
        return bool(((array >= column.least) & (array < counts[column.below])).all())
    return not column.finite or bool(np.isfinite(array).all())


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
            parts = [np.where(part < 0, -1, part.astype(int) + offset) for part, offset in shifted]
        if column.ranges:
            parts = [*(part[:-1] for part in parts), before[column.ranges][-1:]]
        found[name] = np.concatenate(parts)
    return found


def packed(configurations: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Joints as 16-bit shares of their range: 65535 (q - lower) / (upper - lower), rounded."""
    u = (configurations - lower) / (upper - lower)
    return np.rint(np.clip(u, 0.0, 1.0) * FULL_SCALE).astype(np.uint16)


def paths_of_labels(
    labels: Mapping[str, np.ndarray],
    nodes: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    most: int = 40,
) -> dict[str, np.ndarray]:
    """A shard of labels on a roadmap as one of paths.

    A path leads from its start straight to each of its nodes and to its goal.

    Args:
        labels: the arrays of `LABEL_ARRAYS`.
        nodes: (N, n) [rad or m], of the roadmap.
        lower: (n,) joint limits [rad or m].
        upper: (n,) joint limits [rad or m].
        most: paths of each scene, the first; all of them would not fit into memory.
    """
    rows = np.flatnonzero(np.isfinite(labels["cost"]))
    # in ascending order
    scene = labels["path_scene"][rows]
    rows = rows[np.arange(len(rows)) - np.searchsorted(scene, scene) < most]
    count = np.diff(labels["code_start"])
    codes = labels["codes"][np.isin(np.arange(len(count)), rows).repeat(count)]
    count = count[rows]
    # start, nodes and goal (c, n) [rad] of each path, and where those of each begin (p + 1,)
    ends = lower + labels["ends"][rows] / FULL_SCALE * (upper - lower)
    place = np.stack([np.cumsum(count) - count, np.cumsum(count)], axis=1)
    corners = np.insert(nodes[codes], place.ravel(), ends.reshape(-1, len(lower)), axis=0)
    first = np.concatenate([[0], np.cumsum(count + 2)])
    step = np.diff(corners, axis=0, append=corners[-1:])
    parts = np.maximum(np.ceil(np.linalg.norm(step, axis=1) / SPACING), 1).astype(int)
    # a goal leads nowhere
    parts[first[1:] - 1] = 1
    begins = np.cumsum(parts) - parts
    share = (np.arange(parts.sum()) - begins.repeat(parts)) / parts.repeat(parts)
    q = corners.repeat(parts, 0) + share[:, None] * step.repeat(parts, 0)
    return {name: labels[name] for name in SCENE_ARRAYS} | {
        "path_scene": labels["path_scene"][rows],
        "straight": labels["straight"][rows],
        "path_start": np.append(begins, len(q))[first].astype(np.int32),
        "waypoints": packed(q, lower, upper),
        "length": labels["cost"][rows],
        # only pairs whose straight motion is blocked are labelled
        "trivial": np.zeros(len(rows), bool),
        "twin_of": np.full(len(rows), -1, np.int32),
    }


def _archive(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Arrays as the content of a compressed npz file."""
    file = io.BytesIO()
    # numpy's stubs know only options that are bool
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def _arrays(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Arrays of an npz file; InvalidInputError names a damaged one."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    # what a damaged archive raises depends on the byte
    except Exception as error:
        raise InvalidInputError(f"{path} is not a readable archive of arrays: {error}") from error


@dataclass(frozen=True, eq=False)
class RoadmapGraph:
    """The nodes and edges that are labelled."""

    nodes: np.ndarray  # (N, n) [rad]
    edges: np.ndarray  # (E, 2) int32, each pair once
    node_possible: np.ndarray  # (N,) bool: free in an empty scene
    edge_possible: np.ndarray  # (E,) bool, likewise
    # (k,) int64, joint that moves each body point, see `labels.roadmap_labels.body_points`
    body_joint: np.ndarray
    body_offset: np.ndarray  # (k, 3) [m], where each is in that joint's frame

    @property
    def digest(self) -> str:
        """sha256 of the nodes."""
        return hashlib.sha256(self.nodes.tobytes()).hexdigest()

    def write(self, folder: Path) -> None:
        """Write it into a dataset's folder."""
        write_bytes(folder / ROADMAP_FILE, _archive(vars(self)))

    @classmethod
    def read(cls, folder: Path) -> Self:
        """What `write` wrote; InvalidInputError where it is missing or damaged."""
        path = folder / ROADMAP_FILE
        arrays = _arrays(path, read_bytes(path))
        try:
            return cls(**{name: arrays[name] for name in cls.__annotations__})
        except KeyError as error:
            raise InvalidInputError(
                f"{path}: array {error} is missing; generate it again"
            ) from error
