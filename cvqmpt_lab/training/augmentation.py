"""New training examples from old ones: the whole robot turned about its base, with the scene."""

import math

import numpy as np

from cvqmpt_lab.training.dataset import PathDataset
from cvqmpt_lab.training.shards import FULL_SCALE


class BaseTurn:
    """Draws turns about the base that keep paths between the limits of the first joint, and applies them."""

    def __init__(self, dataset: PathDataset, active: bool) -> None:
        """Prepare for a dataset; all turns are 0 unless active and the first joint turns about the base's z axis."""
        self.active = active and dataset.chain is not None and dataset.chain.turns_about_base
        self._range = np.float64(dataset.robot.upper[0] - dataset.robot.lower[0])
        first, starts = dataset.paths.waypoints[:, 0], dataset.paths.start[:-1]
        self.least = np.minimum.reduceat(first, starts) / FULL_SCALE if len(starts) else np.empty(0)
        """(p,) of the normalised first joint along each path."""
        self.most = np.maximum.reduceat(first, starts) / FULL_SCALE if len(starts) else np.empty(0)
        """(p,), likewise."""

    def draw(self, paths: np.ndarray, rng: np.random.Generator) -> float:
        """One angle [rad] for all of these paths together."""
        place = rng.random(2)[0]  # two draws, as in the trainings of the shipped weights
        least, most = self.least[paths].min(), self.most[paths].max()
        return float((-least + place * (1.0 - most + least)) * self._range) if self.active else 0.0

    def draw_each(self, paths: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Shifts of the normalised first joint (b,), one for each of these paths."""
        place = rng.random(len(paths))
        shift = -self.least[paths] + place * (1.0 - self.most[paths] + self.least[paths])
        return shift if self.active else np.zeros(len(paths))

    def joints(self, u: np.ndarray, angle: float) -> np.ndarray:
        """Turn normalised joints u (..., n) by an angle [rad]."""
        u = np.array(u, dtype=np.float32)
        u[..., 0] += np.float32(angle / self._range)
        return u


def turned(cloud: np.ndarray, angle: float) -> np.ndarray:
    """A cloud (k, 3) turned with its scene by an angle [rad] about z."""
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)), dtype=np.float32)  # transposed
    return cloud @ turn
