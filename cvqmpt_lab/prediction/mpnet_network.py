"""MPNet made ready for planning on a CPU: one proposal at a time, in numpy, repeatable by seed.

For one row a torch call takes several times what it computes; several rows at once gain nothing, because a
product with one row reads each weight once and needs no preparation.
"""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.models.config import MPNetConfig
from cvqmpt_lab.models.point_cloud.clouds import checked_cloud
from cvqmpt_lab.models.stored import StoredModel, Tensors
from cvqmpt_lab.prediction.layers import Affine


@dataclass(frozen=True, eq=False)
class _Layer:
    """A linear map and its activation."""

    affine: Affine
    slope: np.ndarray
    """(1,), what negative values are multiplied by."""

    def __call__(self, x: np.ndarray) -> np.ndarray:
        y = self.affine(x)
        return np.where(y > 0.0, y, self.slope * y)


class MPNetNetwork:
    """MPNet's weights, ready to propose; the same mathematics as `models.mpnet`, which trains it."""

    def __init__(self, model: StoredModel) -> None:
        """Take the weights over; raises InvalidInputError when they do not fit the configuration."""
        self.config: MPNetConfig = model.config
        config, tensors = self.config, model.part("mpnet")
        widths = (3 * config.n_points, *config.encoder_widths)
        last = len(config.encoder_widths)
        self._encoder = [
            _layer(tensors, f"encoder.{2 * i}", f"encoder.{2 * i + 1}", widths[i], widths[i + 1])
            for i in range(last)
        ]
        self._code = Affine.of(tensors, f"encoder.{2 * last}", widths[-1], config.code_dim)
        widths = (config.code_dim + 2 * config.joint_dim, *config.planner_widths)
        self._hidden = [
            _layer(tensors, f"hidden.{i}.0", f"hidden.{i}.1", widths[i], widths[i + 1])
            for i in range(len(config.planner_widths))
        ]
        self._out = Affine.of(tensors, "out", widths[-1], config.joint_dim)
        tensors.require_used()

    def draw_points(self, cloud: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Points (n_points, 3) of a cloud (m, 3) [m] in random order; all of them again when they run out.

        Raises
        ------
        InvalidInputError
            For fewer than two points, another shape, NaN, or an extent that cannot be metres.
        """
        points = checked_cloud(cloud)
        return points[rng.permutation(len(points))[np.arange(self.config.n_points) % len(points)]]

    def encode(self, points: np.ndarray) -> np.ndarray:
        """Code (code_dim,) of points (n_points, 3) [m]."""
        x = np.ascontiguousarray(points, dtype=np.float32).ravel()
        for layer in self._encoder:
            x = layer(x)
        return self._code(x)

    def propose(
        self,
        current: np.ndarray,
        goal: np.ndarray,
        code: np.ndarray,
        rng: np.random.Generator | None = None,
    ) -> np.ndarray:
        """Next configuration (joint_dim,) from current towards goal (joint_dim,), not clipped.

        Configurations are normalised to [-1, 1]. Dropout is drawn from rng; without one there is none.
        """
        x = np.concatenate((code, current, goal)).astype(np.float32)
        share = np.float32(self.config.dropout)
        last = len(self._hidden) - 1
        for i, layer in enumerate(self._hidden):
            x = layer(x)
            if rng is not None and share > 0.0 and i < last:
                x = x * (rng.random(len(x), dtype=np.float32) >= share) / (np.float32(1.0) - share)
        return self._out(x)


def _layer(tensors: Tensors, linear: str, slope: str, before: int, after: int) -> _Layer:
    affine = Affine.of(tensors, linear, before, after)
    return _Layer(affine, tensors(f"{slope}.weight", 1).astype(np.float32))
