"""Datasets in memory: scenes as shapes, with paths as waypoints or as labels on a roadmap.

Joints u are normalised to [0, 1] between the limits. Scenes whose seed is divisible by 20 validate,
the others train; twins, second labels of a path, do neither. `shards` describes the folder on disk.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from cvqmpt_lab.codec import from_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import read_bytes, read_json_object, require_regular_file
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    FULL_SCALE,
    INDEX_FILE,
    LABEL_ARRAYS,
    PATH_ARRAYS,
    ROADMAP_FILE,
    RoadmapGraph,
    joined,
    paths_of_labels,
    read_shards,
)
from cvqmpt_lab.vqmpt.config import SerialChain
from cvqmpt_lab.vqmpt.weights import RobotSignature

SCHEMA = 1
VALIDATION_EVERY = 20  # scenes whose seed is divisible by it validate

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

    @property
    def validate(self) -> np.ndarray:
        """Whether each scene (s,) is for validation, bool."""
        return self.seed % VALIDATION_EVERY == 0

    def shapes(self, scene: int) -> Shapes:
        """Shapes of one scene."""
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
        """Waypoints (b,) of each path."""
        return self.start[paths + 1] - self.start[paths]

    def padded(self, paths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Waypoints of paths (b,); shorter paths are padded with their last waypoint.

        Returns:
            Normalised joints (b, t, n) float32, and the counts (b,) of each path's own waypoints.
        """
        counts = self.counts(paths)
        place = np.minimum(np.arange(counts.max()), counts[:, None] - 1)
        return unpacked(self.waypoints[self.start[paths][:, None] + place]), counts


def unpacked(joints: np.ndarray) -> np.ndarray:
    """Normalised joints u = stored / 65535, float32 of uint16."""
    return joints.astype(np.float32) / np.float32(FULL_SCALE)


def with_few_trivial(
    paths: Paths, rows: np.ndarray, share: float, rng: np.random.Generator
) -> np.ndarray:
    """Rows (k,) in order, at most this share of them trivial paths; all if all are trivial."""
    trivial = paths.trivial[rows]
    others = int((~trivial).sum())
    most = int(share / (1.0 - share) * others) if share < 1.0 else len(rows)
    if others == 0 or trivial.sum() <= most:
        return rows
    kept = ~trivial
    kept[rng.choice(np.flatnonzero(trivial), most, replace=False)] = True
    return rows[kept]


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Fields that all datasets have."""

    folder: Path
    robot: RobotSignature
    families: tuple[str, ...]
    chain: SerialChain | None  # kinematics for link positions; None when the description has none
    sha256: str  # of the description and the index, which holds those of the shards
    scenes: Scenes
    path_scene: np.ndarray  # (p,) int64: row of each path's scene

    def split(self, name: SplitName) -> np.ndarray:
        """Rows of the paths for training or validation."""
        if name not in get_args(SplitName):
            raise UnknownChoiceError("split", name, get_args(SplitName))
        validates = self.scenes.validate[self.path_scene]
        return np.flatnonzero(validates == (name == "validation"))


@dataclass(frozen=True, eq=False)
class PathDataset(TrainingData):
    """A dataset of paths."""

    paths: Paths

    def split(self, name: SplitName) -> np.ndarray:
        """Rows of the paths for training or validation, without twins."""
        rows = super().split(name)
        return rows[self.paths.twin_of[rows] < 0]

    def require_splits(self) -> None:
        """Raise InvalidInputError without a path to train on or one to validate with."""
        for name in get_args(SplitName):
            if len(self.split(name)) == 0:
                raise InvalidInputError(
                    f"{self.folder} has no {name} path (scene seeds divisible by "
                    f"{VALIDATION_EVERY} validate); generate more scenes"
                )

    def thinned(self, spacing: float | None) -> "PathDataset":
        """The dataset with fewer waypoints: both ends of each path, and one every `spacing` [rad].

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


@dataclass(frozen=True, eq=False)
class RoadmapLabels:
    """Which of the N nodes and E edges of a roadmap are free in each of s scenes.

    Links are the straight motions from e configurations to the nodes nearest to each.
    """

    graph: RoadmapGraph
    node_bits: np.ndarray  # (s, N/8) uint8: packed bits, 1 where the node is free
    edge_bits: np.ndarray  # (s, E/8) uint8, likewise
    link_start: np.ndarray  # (s + 1,) int64: ranges into the ends of links
    link_end: np.ndarray  # (e, n) uint16: configurations, u times FULL_SCALE
    link_code: np.ndarray  # (e, LINKS) uint16: the nodes near each
    link_free: np.ndarray  # (e, LINKS) bool

    def free(self, scenes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which nodes (k, N) and edges (k, E) are free in scenes (k,), bool."""
        nodes = np.unpackbits(self.node_bits[scenes], axis=1, count=len(self.graph.nodes))
        edges = np.unpackbits(self.edge_bits[scenes], axis=1, count=len(self.graph.edges))
        return nodes.astype(bool), edges.astype(bool)


@dataclass(frozen=True, eq=False)
class SequenceDataset(TrainingData):
    """A dataset of code sequences h_1 ... h_l from starts to goals."""

    ends: np.ndarray  # (p, 2, n) uint16: start and goal, u times FULL_SCALE
    code_start: np.ndarray  # (p + 1,) int64: ranges into the codes
    codes: np.ndarray  # (c,) of all paths
    roadmap: RoadmapLabels | None  # None where sequences are those of encoded paths

    def configurations(self, joints: np.ndarray) -> np.ndarray:
        """Configurations q = lower + u (upper - lower) (..., n) float32 of stored joints."""
        lower, upper = np.array(self.robot.lower), np.array(self.robot.upper)
        return (lower + joints / FULL_SCALE * (upper - lower)).astype(np.float32)


def open_dataset(folder: Path) -> PathDataset:
    """Read a dataset's paths into memory; of labels on a roadmap some paths of each scene.

    InvalidInputError names the file that is missing, damaged or of another schema.
    """
    header = _header(folder)
    if holds_labels(folder):
        graph, labels = read_labels(folder)
        robot = header["robot"]
        limits = np.array(robot.lower), np.array(robot.upper)
        shards = [paths_of_labels(shard, graph.nodes, *limits) for shard in labels]
    else:
        sizes = {"families": len(header["families"]), "n": len(header["robot"].lower)}
        shards = read_shards(folder, PATH_ARRAYS, sizes)
    arrays = joined(shards, PATH_ARRAYS)
    paths = Paths(
        scene=arrays["path_scene"],
        start=arrays["path_start"],
        waypoints=arrays["waypoints"],
        trivial=arrays["trivial"],
        twin_of=arrays["twin_of"],
        length=arrays["length"],
        straight=arrays["straight"],
    )
    return PathDataset(**header, scenes=_scenes(arrays), path_scene=paths.scene, paths=paths)


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
    graph, shards = read_labels(folder)
    arrays = joined(shards, LABEL_ARRAYS)
    count = np.diff(arrays["code_start"])
    found = np.isfinite(arrays["cost"]) & (count > 0)
    return SequenceDataset(
        **header,
        scenes=_scenes(arrays),
        path_scene=arrays["path_scene"][found],
        ends=arrays["ends"][found],
        code_start=np.concatenate([[0], np.cumsum(count[found])]),
        codes=arrays["codes"][np.repeat(found, count)],
        roadmap=RoadmapLabels(
            graph,
            arrays["node_free"],
            arrays["edge_free"],
            arrays["link_start"],
            arrays["link_end"],
            arrays["link_code"],
            arrays["link_free"],
        ),
    )


def holds_labels(folder: Path) -> bool:
    """Whether a dataset holds labels on a roadmap instead of paths."""
    return (Path(folder) / ROADMAP_FILE).exists()


def read_labels(folder: Path) -> tuple[RoadmapGraph, list[dict[str, np.ndarray]]]:
    """The roadmap of a dataset of labels, and the arrays of its shards."""
    graph, header = RoadmapGraph.read(folder), _header(folder)
    sizes = {"families": len(header["families"]), "n": graph.nodes.shape[1]}
    for name, items in (("N", graph.nodes), ("E", graph.edges)):
        sizes |= {name: len(items), f"{name}/8": -(-len(items) // 8)}
    return graph, read_shards(folder, LABEL_ARRAYS, sizes)


def _header(folder: Path) -> dict[str, Any]:
    """Fields of `TrainingData` that are in a dataset's description."""
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
    ours = {"robot": "name", "kinematics_digest": "kinematics"}
    names = ("robot", "lower", "upper", "joints", "kinematics_digest")
    signature = {ours.get(name, name): description[name] for name in names if name in description}
    robot = from_plain(RobotSignature, signature, f"{path}: ")
    families = from_plain(tuple[str, ...], description.get("families"), f"{path}: families")
    if not families:
        raise InvalidInputError(f"{path}: families is empty; it must name one at least")
    chain = None
    if description.get("kinematics") is not None:
        chain = from_plain(SerialChain, description["kinematics"], f"{path}: kinematics")
        if len(chain.rotation) != len(robot.lower):
            raise InvalidInputError(
                f"{path}: kinematics has {len(chain.rotation)} joints, lower {len(robot.lower)}"
            )
    files = read_bytes(path) + read_bytes(folder / INDEX_FILE)
    digest = hashlib.sha256(files).hexdigest()
    header = {"folder": folder, "robot": robot, "families": families}
    return header | {"chain": chain, "sha256": digest}


def _scenes(arrays: dict[str, np.ndarray]) -> Scenes:
    size, pose = arrays["shape_size"].astype(np.float32), arrays["shape_pose"].astype(np.float32)
    shapes = Shapes(arrays["shape_kind"], size, pose)
    return Scenes(arrays["family"], arrays["scene_seed"], arrays["shape_start"], shapes)
