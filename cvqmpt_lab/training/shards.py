"""Folders of training data on disk, checked array by array: near-shortest paths, or labels on a
dictionary's roadmap.

As ``cvqmpt data generate`` writes them; s scenes, m shapes, p paths, n joints, N nodes, E edges::

    dataset.json     schema 1, robot, lower, upper [rad], joints, kinematics_digest, families,
    kinematics (a
                     vqmpt.config.SerialChain), provenance
    shards.csv       shard, sha256, scenes, paths
    shards/NNNNNN.npz
        family (s,) uint8, scene_seed (s,) int64
        shape_start (s+1,) int32: ranges into the shapes; shape_kind (m,) uint8, shape_size (m,3)
        float32 and shape_pose (m,3,4) float32: as in dataset.Shapes path_scene (p,) int32: row of
        the scene in this shard; path_start (p+1,) int32: ranges into the waypoints waypoints (w,n)
        uint16: u * 65535, at most 0.13 rad apart along a path length, straight (p,) float32 [rad];
        trivial (p,) bool: the straight line is free twin_of (p,) int32: row of the path in this
        shard of which this is a second label, or -1

With ``--labels roadmap``::

    roadmap.npz      nodes (N,n) float64 [rad], edges (E,2) int32, node_possible (N,) and
    edge_possible (E,) bool: free
                     in an empty scene; body_joint (k,) int64 and body_offset (k,3) float64 [m]:
                     points of the arm
    shards/NNNNNN.npz
        family, scene_seed, shape_start, shape_kind, shape_size, shape_pose: as above
        node_free (s,N/8) and edge_free (s,E/8) uint8: packed bits
        path_scene (p,) int32, ends (p,2,n) uint16: start and goal, u * 65535
        code_start (p+1,) int32: ranges into codes (c,) uint16
        cost (p,) float32: length through the codes [rad], inf where there is no path; straight (p,)
        float32 [rad] link_start (s+1,) int32: ranges into the ends of links, link_end (e,n) uint16:
        u * 65535; link_code (e,20)
        uint16: the nodes nearest to each; link_free (e,20) bool: the straight motion between both
        is free differs (p,) bool: the codes are others than those of the shortest path in an empty
        scene
"""

import hashlib
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_bytes, read_text, require_regular_file, write_bytes, write_text

SCHEMA = 1
DESCRIPTION_FILE = "dataset.json"
INDEX_FILE = "shards.csv"
ROADMAP_FILE = "roadmap.npz"
SHARDS_FOLDER = "shards"
COLUMNS = ("shard", "sha256", "scenes", "paths")
FULL_SCALE = 65535.0  # what a stored joint is at the upper limit
LINKS = 20  # nodes of a roadmap that a start or goal is linked to

_REQUIRED = {  # dimensions and kinds of numbers (numpy's letters) of every array
    "family": (1, "u"),
    "scene_seed": (1, "iu"),
    "shape_start": (1, "iu"),
    "shape_kind": (1, "u"),
    "shape_size": (2, "f"),
    "shape_pose": (3, "f"),
    "path_scene": (1, "iu"),
    "path_start": (1, "iu"),
    "waypoints": (2, "u"),
    "length": (1, "f"),
    "straight": (1, "f"),
    "trivial": (1, "b"),
    "twin_of": (1, "i"),
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
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # the stubs know only bool options
    content, counts = file.getvalue(), (len(arrays["scene_seed"]), len(arrays["path_scene"]))
    return IndexRow(number, hashlib.sha256(content).hexdigest(), *counts), content


def write_shard(folder: Path, row: IndexRow, content: bytes, rows: Iterable[IndexRow]) -> None:
    """Put a shard on disk, then write the index of all `rows`, its own included."""
    write_bytes(folder / SHARDS_FOLDER / row.file, content)
    lines = [f"{row.shard:06d},{row.sha256},{row.scenes},{row.paths}" for row in sorted(rows)]
    write_text(folder / INDEX_FILE, "\n".join((",".join(COLUMNS), *lines, "")))


def finished_shards(folder: Path) -> list[IndexRow]:
    """Rows of the index whose shard is there as it was written; damaged lines are passed over."""
    path = folder / INDEX_FILE
    if not path.exists():
        return []
    rows = {
        row.shard: row
        for line in read_text(path).splitlines()
        if (row := _parsed(line)) is not None
    }
    files = {row.shard: folder / SHARDS_FOLDER / row.file for row in rows.values()}
    return [
        row
        for row in rows.values()
        if files[row.shard].is_file()
        and hashlib.sha256(read_bytes(files[row.shard])).hexdigest() == row.sha256
    ]


def _parsed(line: str) -> IndexRow | None:
    fields = line.split(",")
    if len(fields) != len(COLUMNS) or not all(
        f.isascii() and f.isdigit() for f in (fields[0], *fields[2:])
    ):
        return None
    return IndexRow(int(fields[0]), fields[1], int(fields[2]), int(fields[3]))


def read_index(folder: Path) -> list[IndexRow]:
    """Lines of the index;
    InvalidInputError when it is missing or damaged, lists nothing, or a shard twice.
    """
    path = folder / INDEX_FILE
    text = read_text(require_regular_file(path))
    first, *lines = text.splitlines() or [""]
    if first != ",".join(COLUMNS):
        raise InvalidInputError(f"{path}: the first line must be {','.join(COLUMNS)}")
    if not text.endswith("\n"):
        raise InvalidInputError(f"{path} is cut short; generate again, which completes it")
    rows = []
    for number, line in enumerate(lines, 2):
        row = _parsed(line)
        if row is None:
            raise InvalidInputError(
                f"{path}, line {number} is damaged; generate again, which repairs it"
            )
        rows.append(row)
    if not rows:
        raise InvalidInputError(f"{path} lists no shard; generate paths first")
    if len({row.shard for row in rows}) < len(rows):
        raise InvalidInputError(f"{path} lists a shard twice; generate again, which repairs it")
    return rows


def _read_arrays(path: Path, data: bytes) -> dict[str, np.ndarray]:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception as error:  # what a damaged archive raises depends on the byte
        raise InvalidInputError(f"{path} is not a readable archive of arrays: {error}") from error


def _shard_arrays(folder: Path, row: IndexRow) -> tuple[Path, dict[str, np.ndarray]]:
    """File and arrays of one shard;
    InvalidInputError where it is missing, or not as it was written.
    """
    path = folder / SHARDS_FOLDER / row.file
    data = read_bytes(require_regular_file(path))
    if hashlib.sha256(data).hexdigest() != row.sha256:
        raise InvalidInputError(f"{path} is damaged (sha256); fetch or generate it again")
    return path, _read_arrays(path, data)


def read_shard(folder: Path, row: IndexRow, joints: int, families: int) -> dict[str, np.ndarray]:
    """Arrays of one shard; InvalidInputError names those that contradict each other or the index."""
    path, arrays = _shard_arrays(folder, row)
    for name, (dimensions, kinds) in _REQUIRED.items():
        if (
            name not in arrays
            or arrays[name].ndim != dimensions
            or arrays[name].dtype.kind not in kinds
        ):
            raise InvalidInputError(f"{path}: array {name} is missing or not as described")
    wrong = [name for name, passes in _checks(arrays, row, joints, families) if not passes]
    if wrong:
        raise InvalidInputError(
            f"{path}: {', '.join(wrong)} does not fit the other arrays; generate it again"
        )
    return arrays


def _checks(
    arrays: dict[str, np.ndarray], row: IndexRow, joints: int, families: int
) -> Iterator[tuple[str, bool]]:
    """What must hold, by the array to name when it does not."""
    s, m, p = (len(arrays[name]) for name in ("scene_seed", "shape_kind", "path_scene"))
    waypoints, path_start = arrays["waypoints"], arrays["path_start"]
    yield "scenes in the index", row.scenes == s
    yield "paths in the index", row.paths == p
    yield "family", len(arrays["family"]) == s and _within(arrays["family"], 0, families)
    yield "shape_kind", _within(arrays["shape_kind"], 0, 3)
    yield "shape_size", arrays["shape_size"].shape == (m, 3) and _are_finite(arrays["shape_size"])
    yield (
        "shape_pose",
        arrays["shape_pose"].shape == (m, 3, 4) and _are_finite(arrays["shape_pose"]),
    )
    yield "shape_start", _are_ranges(arrays["shape_start"], s, m)
    yield "waypoints", waypoints.dtype == np.uint16 and waypoints.shape[1] == joints
    yield (
        "path_start",
        _are_ranges(path_start, p, len(waypoints)) and bool((np.diff(path_start) >= 2).all()),
    )
    yield "path_scene", _within(arrays["path_scene"], 0, s)
    yield "twin_of", len(arrays["twin_of"]) == p and _within(arrays["twin_of"], -1, p)
    for name in ("length", "straight", "trivial"):
        yield name, len(arrays[name]) == p and _are_finite(arrays[name])


def _within(values: np.ndarray, lower: int, upper: int) -> bool:
    return bool(((values >= lower) & (values < upper)).all())


def _are_finite(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all())


def _are_ranges(start: np.ndarray, count: int, total: int) -> bool:
    """Whether start (count + 1,) divides a total of items into ranges."""
    return (
        len(start) == count + 1
        and start[0] == 0
        and start[-1] == total
        and bool((np.diff(start) >= 0).all())
    )


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
        """Which nodes these are: sha256 of them."""
        return hashlib.sha256(self.nodes.tobytes()).hexdigest()

    def write(self, folder: Path) -> None:
        """Put it into a dataset's folder."""
        file = io.BytesIO()
        np.savez_compressed(file, **vars(self))
        write_bytes(folder / ROADMAP_FILE, file.getvalue())

    @classmethod
    def read(cls, folder: Path) -> Self:
        """What `write` wrote; InvalidInputError where it is missing or damaged."""
        path = folder / ROADMAP_FILE
        arrays = _read_arrays(path, read_bytes(require_regular_file(path)))
        try:
            return cls(**{name: arrays[name] for name in cls.__annotations__})
        except KeyError as error:
            raise InvalidInputError(
                f"{path}: array {error} is missing; generate it again"
            ) from error


class RoadmapShard(NamedTuple):
    """Labels of the scenes of one shard: the arrays as on disk."""

    arrays: dict[str, np.ndarray]
    graph: RoadmapGraph

    @classmethod
    def read(cls, folder: Path, row: IndexRow, graph: RoadmapGraph) -> Self:
        """One shard; InvalidInputError where it is missing, damaged or of another roadmap."""
        path, arrays = _shard_arrays(folder, row)
        bits = [(row.scenes, -(-len(part) // 8)) for part in (graph.nodes, graph.edges)]
        try:
            fits = [arrays["node_free"].shape, arrays["edge_free"].shape] == bits
            fits = fits and len(arrays["code_start"]) == len(arrays["ends"]) + 1 == row.paths + 1
            fits = fits and _links_fit(arrays, row.scenes, graph)
        except KeyError as error:
            raise InvalidInputError(
                f"{path}: array {error} is missing; generate it again"
            ) from error
        if not fits:
            raise InvalidInputError(
                f"{path} does not fit {ROADMAP_FILE} or the index; generate it again"
            )
        return cls(arrays, graph)

    def node_free(self, scene: int) -> np.ndarray:
        """(N,) bool."""
        return np.unpackbits(self.arrays["node_free"][scene], count=len(self.graph.nodes)).astype(
            bool
        )

    def edge_free(self, scene: int) -> np.ndarray:
        """(E,) bool."""
        return np.unpackbits(self.arrays["edge_free"][scene], count=len(self.graph.edges)).astype(
            bool
        )


def _links_fit(arrays: dict[str, np.ndarray], scenes: int, graph: RoadmapGraph) -> bool:
    """Whether the arrays of links fit each other and the roadmap."""
    start, ends, codes, free = (
        arrays[name] for name in ("link_start", "link_end", "link_code", "link_free")
    )
    return (
        _are_ranges(start, scenes, len(ends))
        and ends.shape == (len(ends), graph.nodes.shape[1])
        and codes.shape == free.shape == (len(ends), LINKS)
        and _within(codes, 0, len(graph.nodes))
    )


def read_roadmap_shards(folder: Path) -> list[RoadmapShard]:
    """All shards of a folder; errors as in `RoadmapShard.read` and `read_index`."""
    graph = RoadmapGraph.read(folder)
    return [RoadmapShard.read(folder, row, graph) for row in read_index(folder)]
