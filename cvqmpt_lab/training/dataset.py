"""Read a folder of training paths: scenes as shape parameters, paths as waypoints of 16 bits a joint.

The format, as ``cvqmpt data generate`` writes it::

    dataset.json     schema 1, robot, lower, upper [rad], joints, kinematics_digest, families, kinematics (see
                     link_positions), provenance
    shards.csv       shard, sha256, scenes, paths; lines are only ever appended
    shards/NNNNNN.npz
        family (s,) uint8, scene_seed (s,) int64
        shape_start (s+1,) int32: ranges into the shapes; shape_kind (m,) uint8: 0 box, 1 cylinder, 2 sphere
        shape_size (m,3) float32 [m]: edges; radius, radius, height (axis z); radius three times
        shape_pose (m,3,4) float32: of the shape in the world [m]
        path_scene (p,) int32: row of the scene in this shard; path_start (p+1,) int32: ranges into the waypoints
        waypoints (w,n) uint16: u * 65535, at most 0.13 rad apart along a path
        length, straight (p,) float32 [rad]; trivial (p,) bool: the straight line is free
        twin_of (p,) int32: row of the path in this shard of which this is a second label, or -1
        probe_q (s,c,n) uint16, probe_free (s,c) bool: optional, configurations and whether they are free
        edge_q (s,e,2,n) uint16, edge_free (s,e) bool: optional, straight motions and whether they are free

Joints u are normalised to [0, 1] between the limits. Scenes whose seed is divisible by 20 validate, the others
train; twins do neither.
"""

import csv
import hashlib
import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cvqmpt_lab.codec import from_plain
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import read_bytes, read_json_object, require_regular_file
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.training.link_positions import SerialChain

SCHEMA = 1
DESCRIPTION_FILE = "dataset.json"
INDEX_FILE = "shards.csv"
SHARDS_FOLDER = "shards"
VALIDATION_EVERY = 20
FULL_SCALE = 65535.0

SplitName = Literal["train", "validation"]


@dataclass(frozen=True, eq=False)
class Labels:
    """Configurations of each scene (s, c, ..., n) uint16 and whether they are free (s, c) bool."""

    joints: np.ndarray
    free: np.ndarray


@dataclass(frozen=True, eq=False)
class Scenes:
    """Shapes of every scene; the format is described above.

    Attributes
    ----------
    probes: labelled configurations, None when a shard has none; edges: labelled straight motions.
    """

    family: np.ndarray
    seed: np.ndarray
    shape_start: np.ndarray
    shape_kind: np.ndarray
    shape_size: np.ndarray
    shape_pose: np.ndarray
    probes: Labels | None
    edges: Labels | None

    def __len__(self) -> int:
        return len(self.seed)

    def shapes(self, scene: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Kinds (m,), sizes (m, 3) and poses (m, 3, 4) of one scene's shapes."""
        rows = slice(int(self.shape_start[scene]), int(self.shape_start[scene + 1]))
        return self.shape_kind[rows], self.shape_size[rows], self.shape_pose[rows]


@dataclass(frozen=True, eq=False)
class Paths:
    """All paths; `scene` and `twin_of` are rows of the whole dataset, not of a shard."""

    scene: np.ndarray
    start: np.ndarray
    waypoints: np.ndarray
    length: np.ndarray
    straight: np.ndarray
    trivial: np.ndarray
    twin_of: np.ndarray

    def __len__(self) -> int:
        return len(self.scene)

    def joints(self, path: int) -> np.ndarray:
        """Normalised joints u (t, n) float32 of one path."""
        rows = slice(int(self.start[path]), int(self.start[path + 1]))
        return self.waypoints[rows].astype(np.float32) / np.float32(FULL_SCALE)

    def counts(self, paths: np.ndarray) -> np.ndarray:
        """Waypoints of each path."""
        return self.start[paths + 1] - self.start[paths]


@dataclass(frozen=True, eq=False)
class PathDataset:
    """An opened dataset.

    Attributes
    ----------
    sha256: of the description and the index, which holds those of the shards.
    chain: kinematics for link positions; None when the description has none.
    """

    folder: Path
    robot: RobotSignature
    families: tuple[str, ...]
    chain: SerialChain | None
    sha256: str
    scenes: Scenes
    paths: Paths

    @property
    def joint_dim(self) -> int:
        """Joints of the robot."""
        return len(self.robot.lower)

    def split(self, name: SplitName) -> np.ndarray:
        """Rows of the paths that train or validate, without twins."""
        if name not in ("train", "validation"):
            raise UnknownChoiceError("split", name, ("train", "validation"))
        validates = self.scenes.seed[self.paths.scene] % VALIDATION_EVERY == 0
        return np.flatnonzero((validates == (name == "validation")) & (self.paths.twin_of < 0))

    def require_splits(self) -> None:
        """Check that there is something to train on and something to validate with.

        Raises
        ------
        InvalidInputError
            Naming the split that has no path.
        """
        for name in ("train", "validation"):
            if len(self.split(name)) == 0:
                raise InvalidInputError(
                    f"{self.folder} has no {name} path (scene seeds divisible by {VALIDATION_EVERY} validate); "
                    "generate more scenes"
                )

    def thinned(self, spacing: float) -> "PathDataset":
        """The dataset with fewer waypoints: both ends of a path, and the first
        waypoint after every `spacing` [rad] of it, evenly.
        """
        return replace(self, paths=_thinned(self.paths, self.robot, spacing))


def with_few_trivial(paths: Paths, rows: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Rows in which at most this share is of trivial paths; which of those stay is drawn, order is kept."""
    trivial = paths.trivial[rows]
    others = int((~trivial).sum())
    most = int(share / (1.0 - share) * others) if share < 1.0 else len(rows)
    if others == 0 or trivial.sum() <= most:  # nothing but straight lines is better than nothing
        return rows
    kept = ~trivial
    kept[rng.choice(np.flatnonzero(trivial), most, replace=False)] = True
    return rows[kept]


def _thinned(paths: Paths, robot: RobotSignature, spacing: float) -> Paths:
    if not spacing > 0.0:
        raise InvalidInputError(f"spacing of waypoints is {spacing} rad; it must be positive")
    scale = (np.array(robot.upper) - np.array(robot.lower)) / FULL_SCALE
    steps = np.zeros(len(paths.waypoints))
    block = 1 << 18
    for first in range(1, len(steps), block):  # in blocks: the whole in floats would not fit everywhere
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
    return replace(paths, start=start, waypoints=paths.waypoints[kept])


def open_dataset(folder: Path, *, verify: bool = True) -> PathDataset:
    """Read a whole dataset into memory.

    Parameters
    ----------
    folder
        What ``cvqmpt data generate`` wrote.
    verify
        Compare every shard with its sha256.

    Raises
    ------
    InvalidInputError
        Naming the file that is missing, damaged or of another schema.
    """
    folder = Path(folder)
    if not (folder / DESCRIPTION_FILE).is_file():
        raise InvalidInputError(
            f"no dataset in {folder}: it has no {DESCRIPTION_FILE}; generate one there first"
        )
    path = folder / DESCRIPTION_FILE
    description = read_json_object(require_regular_file(path))
    if description.get("schema") != SCHEMA:
        raise InvalidInputError(
            f"{path}: schema is {description.get('schema')!r}; this version reads {SCHEMA}"
        )
    known = {
        "robot": "name",
        "lower": "lower",
        "upper": "upper",
        "joints": "joints",
        "kinematics_digest": "kinematics",
    }
    described = {ours: description[theirs] for theirs, ours in known.items() if theirs in description}
    robot = from_plain(RobotSignature, described, f"{path}: ")
    families = _families(description, path)
    kinematics = description.get("kinematics")
    chain = (
        None
        if kinematics is None
        else SerialChain.from_json(kinematics, len(robot.lower), f"{path}: kinematics")
    )
    index = read_bytes(folder / INDEX_FILE)
    shards = []
    for row in _index_rows(folder / INDEX_FILE, index):
        name = f"{int(row['shard']):06d}.npz" if row["shard"].isdigit() else row["shard"]
        data = read_bytes(folder / SHARDS_FOLDER / name)
        if verify and hashlib.sha256(data).hexdigest() != row["sha256"]:
            raise InvalidInputError(
                f"{folder / SHARDS_FOLDER / name} is damaged (sha256); fetch or generate it again"
            )
        shards.append(_shard(folder / SHARDS_FOLDER / name, data, row, len(robot.lower), len(families)))
    digest = hashlib.sha256(read_bytes(path) + index).hexdigest()
    scenes, paths = _joined(shards)
    return PathDataset(folder, robot, families, chain, digest, scenes, paths)


def _families(description: Mapping[str, Any], path: Path) -> tuple[str, ...]:
    families = description.get("families")
    if not isinstance(families, list) or not families or not all(isinstance(f, str) for f in families):
        raise InvalidInputError(f"{path}: families is {families!r}; it must be a list of names")
    return tuple(families)


def _index_rows(path: Path, data: bytes) -> list[dict[str, str]]:
    """Lines of the index; one cut short at the end, by a generator at work or killed, does not count."""
    text = data[: data.rfind(b"\n") + 1].decode("utf-8", errors="replace")
    reader = csv.DictReader(io.StringIO(text, newline=""))
    columns = ["shard", "sha256", "scenes", "paths"]
    if not set(columns) <= set(reader.fieldnames or ()):
        raise InvalidInputError(f"{path}: columns are {reader.fieldnames}; expected {', '.join(columns)}")
    rows = list(reader)
    if not rows:
        raise InvalidInputError(f"{path} lists no shard; generate paths first")
    if any(row[name] is None for row in rows for name in columns):
        raise InvalidInputError(f"{path} has a line with too few fields")
    return rows


_SCENE_ARRAYS = {"family": 1, "scene_seed": 1, "shape_start": 1}
_SHAPE_ARRAYS = {"shape_kind": 1, "shape_size": 2, "shape_pose": 3}
_PATH_ARRAYS = {"path_scene": 1, "path_start": 1, "length": 1, "straight": 1, "trivial": 1, "twin_of": 1}
_OPTIONAL = {"probe": 3, "edge": 4}


def _shard(
    path: Path, data: bytes, row: Mapping[str, str], joints: int, families: int
) -> dict[str, np.ndarray]:
    """Arrays of one shard, checked against each other and the index."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InvalidInputError(f"{path} is not a readable shard: {error}") from error
    expected = {**_SCENE_ARRAYS, **_SHAPE_ARRAYS, **_PATH_ARRAYS, "waypoints": 2}
    for name, dimensions in expected.items():
        if name not in arrays or arrays[name].ndim != dimensions:
            raise InvalidInputError(f"{path}: array {name} is missing or not {dimensions}-dimensional")
    s, m, p = len(arrays["scene_seed"]), len(arrays["shape_kind"]), len(arrays["path_scene"])
    waypoints = arrays["waypoints"]
    checks = {
        "waypoints": waypoints.dtype == np.uint16 and waypoints.shape[1] == joints,
        "shape_size": arrays["shape_size"].shape == (m, 3),
        "shape_pose": arrays["shape_pose"].shape == (m, 3, 4)
        and bool(np.isfinite(arrays["shape_pose"]).all()),
        "shape_kind": m == 0 or int(arrays["shape_kind"].max()) <= 2,
        "shape_start": _are_ranges(arrays["shape_start"], s, m),
        "path_start": _are_ranges(arrays["path_start"], p, len(waypoints))
        and (p == 0 or int(np.diff(arrays["path_start"]).min()) >= 2),
        "path_scene": p == 0 or (arrays["path_scene"].min() >= 0 and arrays["path_scene"].max() < s),
        "twin_of": p == 0 or (arrays["twin_of"].min() >= -1 and arrays["twin_of"].max() < p),
        "family": len(arrays["family"]) == s and (s == 0 or int(arrays["family"].max()) < families),
        **{name: len(arrays[name]) == p for name in ("length", "straight", "trivial")},
        "scenes in the index": row["scenes"] == str(s),
        "paths in the index": row["paths"] == str(p),
    }
    for name, dimensions in _OPTIONAL.items():
        if f"{name}_q" in arrays:
            q, free = arrays[f"{name}_q"], arrays.get(f"{name}_free")
            checks[f"{name}_q"] = q.ndim == dimensions and q.shape[:: dimensions - 1] == (s, joints)
            checks[f"{name}_free"] = free is not None and free.shape == q.shape[:2]
    wrong = [name for name, passes in checks.items() if not passes]
    if wrong:
        raise InvalidInputError(
            f"{path}: {', '.join(wrong)} does not fit the other arrays; generate it again"
        )
    return arrays


def _are_ranges(start: np.ndarray, count: int, total: int) -> bool:
    return (
        len(start) == count + 1 and start[0] == 0 and start[-1] == total and bool((np.diff(start) >= 0).all())
    )


def _joined(shards: list[dict[str, np.ndarray]]) -> tuple[Scenes, Paths]:
    """All shards as one, rows counted through."""

    def together(name: str) -> np.ndarray:
        return np.concatenate([shard[name] for shard in shards])

    def offsets(name: str) -> list[int]:
        return np.concatenate(([0], np.cumsum([len(shard[name]) for shard in shards]))).tolist()

    def ranges(name: str, items: str) -> np.ndarray:
        starts = [s[name][:-1].astype(np.int64) + o for s, o in zip(shards, offsets(items), strict=False)]
        return np.concatenate([*starts, [offsets(items)[-1]]])

    def labels(name: str) -> Labels | None:
        if not all(f"{name}_q" in shard for shard in shards):
            return None
        counts = {shard[f"{name}_q"].shape[1] for shard in shards}
        least = min(counts)
        if least == 0:
            return None
        return Labels(
            np.concatenate([shard[f"{name}_q"][:, :least] for shard in shards]),
            np.concatenate([shard[f"{name}_free"][:, :least] for shard in shards]).astype(bool),
        )

    scene_rows = [
        s["path_scene"].astype(np.int64) + o for s, o in zip(shards, offsets("scene_seed"), strict=False)
    ]
    twins = [
        np.where(s["twin_of"] < 0, -1, s["twin_of"].astype(np.int64) + o)
        for s, o in zip(shards, offsets("path_scene"), strict=False)
    ]
    scenes = Scenes(
        together("family"),
        together("scene_seed"),
        ranges("shape_start", "shape_kind"),
        together("shape_kind"),
        together("shape_size").astype(np.float32),
        together("shape_pose").astype(np.float32),
        labels("probe"),
        labels("edge"),
    )
    paths = Paths(
        np.concatenate(scene_rows),
        ranges("path_start", "waypoints"),
        together("waypoints"),
        together("length"),
        together("straight"),
        together("trivial").astype(bool),
        np.concatenate(twins),
    )
    return scenes, paths
