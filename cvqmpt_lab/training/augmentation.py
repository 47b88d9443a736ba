"""New training examples from old ones: the whole robot turned about its base, or mirrored."""

import math
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.dataset import FULL_SCALE, PathDataset


@dataclass(frozen=True)
class Mirror:
    """Reflection in the plane y = 0: q -> sign q + offset [rad]. Exact for joint axes, nearly so for links."""

    sign: tuple[float, ...]
    offset: tuple[float, ...]


MIRRORS = {
    "panda": Mirror((-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2)),
}


@dataclass(frozen=True, eq=False)
class Change:
    """What happens to one scene and its paths: mirrored first, then turned by `angle` [rad]."""

    angle: float = 0.0
    mirrored: bool = False


class Augmentation:
    """Draws changes that keep paths between the joint limits, and applies them."""

    def __init__(self, dataset: PathDataset, *, turn_base: bool, mirror: bool) -> None:
        """Prepare for a dataset.

        Raises
        ------
        InvalidInputError
            When the robot cannot be turned or mirrored so.
        """
        if turn_base and (dataset.chain is None or not dataset.chain.turns_about_base):
            raise InvalidInputError(
                "turn_base needs kinematics in the dataset whose first joint turns about the base's z axis; "
                "set it to false"
            )
        if mirror and dataset.robot.name not in MIRRORS:
            known = ", ".join(MIRRORS)
            raise InvalidInputError(f"mirror knows {known}, not {dataset.robot.name!r}; set it to false")
        self._turn_base = turn_base
        self._mirror = MIRRORS[dataset.robot.name] if mirror else None
        self._lower = np.array(dataset.robot.lower)
        self._range = np.array(dataset.robot.upper) - self._lower
        self._paths = dataset.paths
        first, starts = dataset.paths.waypoints[:, 0], dataset.paths.start[:-1]
        self.least = np.minimum.reduceat(first, starts) / FULL_SCALE if len(starts) else np.empty(0)
        self.most = np.maximum.reduceat(first, starts) / FULL_SCALE if len(starts) else np.empty(0)

    def draw(self, paths: np.ndarray, rng: np.random.Generator) -> Change:
        """One change for all of these paths together."""
        place, flip = rng.random(2)
        mirrored = self._mirror is not None and flip < 0.5 and self._stay_inside(paths)
        least, most = float(self.least[paths].min()), float(self.most[paths].max())
        if mirrored:
            ends = self.joints(np.array([[least], [most]]).repeat(len(self._range), 1), Change(0.0, True))
            least, most = float(ends[:, 0].min()), float(ends[:, 0].max())
        shift = -least + place * (1.0 - most + least) if self._turn_base else 0.0
        return Change(float(shift * self._range[0]), mirrored)

    def draw_each(self, paths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Shifts of the normalised first joint (b,), one for each of these paths; without mirroring."""
        place = rng.random(len(paths))
        if not self._turn_base:
            return np.zeros(len(paths))
        return -self.least[paths] + place * (1.0 - self.most[paths] + self.least[paths])

    def _stay_inside(self, paths: np.ndarray) -> bool:
        for path in paths.tolist():
            u = self.joints(self._paths.joints(path), Change(0.0, True))
            if u.min() < 0.0 or u.max() > 1.0:
                return False
        return True

    def joints(self, u: np.ndarray, change: Change, *, wrap: bool = False) -> np.ndarray:
        """Change normalised joints u (..., n); `wrap` the first by a whole turn that leaves its limits."""
        u = np.array(u, dtype=np.float32)
        if change.mirrored and self._mirror is not None:
            q = self._lower + u * self._range
            u = ((q * self._mirror.sign + self._mirror.offset - self._lower) / self._range).astype(np.float32)
        u[..., 0] += np.float32(change.angle / self._range[0])
        if wrap:
            turn = 2.0 * math.pi / self._range[0]
            first = u[..., 0]
            u[..., 0] = np.where(first > 1.0, first - turn, np.where(first < 0.0, first + turn, first))
        return u

    def points(self, cloud: np.ndarray, change: Change) -> np.ndarray:
        """Change a cloud (k, 3) with its scene."""
        if change.mirrored:
            cloud = cloud * np.array((1.0, -1.0, 1.0), dtype=np.float32)
        c, s = math.cos(change.angle), math.sin(change.angle)
        turn = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)), dtype=np.float32)  # transposed
        return cloud @ turn
