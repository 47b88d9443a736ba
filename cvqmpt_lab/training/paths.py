"""Training paths in memory: scenes as shape parameters, paths as waypoints of 16 bits a joint."""

from dataclasses import dataclass, replace

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.shards import FULL_SCALE


@dataclass(frozen=True, eq=False)
class Shapes:
    """Boxes, cylinders and spheres, m of them."""

    kind: np.ndarray
    """(m,) uint8: 0 box, 1 cylinder, 2 sphere."""
    size: np.ndarray
    """(m, 3) float32 [m]: edges; radius, radius, height (axis z); radius three times."""
    pose: np.ndarray
    """(m, 3, 4) float32: T_world_shape [m]."""

    def __len__(self) -> int:
        return len(self.kind)


@dataclass(frozen=True, eq=False)
class Scenes:
    """All s scenes, m shapes in all."""

    family: np.ndarray
    """(s,) uint8: index into the dataset's families."""
    seed: np.ndarray
    """(s,) int64."""
    shape_start: np.ndarray
    """(s + 1,) int64: ranges into the shapes."""
    shape: Shapes
    """Of all scenes."""

    def __len__(self) -> int:
        return len(self.seed)

    def shapes(self, scene: int) -> Shapes:
        """Those of one scene."""
        rows = slice(int(self.shape_start[scene]), int(self.shape_start[scene + 1]))
        return Shapes(self.shape.kind[rows], self.shape.size[rows], self.shape.pose[rows])


@dataclass(frozen=True, eq=False)
class Paths:
    """All p paths, w waypoints in all."""

    scene: np.ndarray
    """(p,) int64: row of the scene."""
    start: np.ndarray
    """(p + 1,) int64: ranges into the waypoints."""
    waypoints: np.ndarray
    """(w, n) uint16: u times `FULL_SCALE`."""
    trivial: np.ndarray
    """(p,) bool: the straight line is free."""
    twin_of: np.ndarray
    """(p,) int64: row of the path of which this is a second label, or -1."""
    length: np.ndarray
    """(p,) float32 [rad]."""
    straight: np.ndarray
    """(p,) float32: length of the straight line [rad]."""

    def __len__(self) -> int:
        return len(self.scene)

    def joints(self, path: int) -> np.ndarray:
        """Normalised joints u (t, n) float32 of one path."""
        return unpacked(self.waypoints[self.start[path] : self.start[path + 1]])

    def counts(self, paths: np.ndarray) -> np.ndarray:
        """Waypoints of each path."""
        return self.start[paths + 1] - self.start[paths]

    def padded(self, paths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normalised joints (b, t, n) float32 of paths (b,), the last waypoint repeated, and their counts (b,)."""
        counts = self.counts(paths)
        place = np.minimum(np.arange(counts.max()), counts[:, None] - 1)
        return unpacked(self.waypoints[self.start[paths][:, None] + place]), counts


def unpacked(joints: np.ndarray) -> np.ndarray:
    """Normalised joints u float32 of stored ones, uint16."""
    return joints.astype(np.float32) / np.float32(FULL_SCALE)


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


def thinned(paths: Paths, span: np.ndarray, spacing: float) -> Paths:
    """Fewer waypoints: both ends of each path, and the first waypoint after every `spacing` of it, evenly.

    span: (n,) range of each joint [rad]. spacing: [rad].

    Raises
    ------
    InvalidInputError
        For a spacing that is not positive.
    """
    if not spacing > 0.0:
        raise InvalidInputError(f"spacing of waypoints is {spacing} rad; it must be positive")
    scale = span / FULL_SCALE
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
