"""MPNet at planning time, in numpy: one proposal at a time, repeatable by seed.

For one row a torch call takes several times what it computes; several rows at once gain nothing, because a product
with one row reads each weight once and needs no preparation. Same mathematics as `mpnet`, which is trained.
"""

from itertools import pairwise

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.config import MPNetConfig
from cvqmpt_lab.vqmpt.inputs import checked_cloud
from cvqmpt_lab.vqmpt.weights import StoredModel

PART = "mpnet"


class MPNetNetwork:
    """MPNet's weights, ready to propose."""

    def __init__(self, model: StoredModel) -> None:
        """Take the weights over; raises InvalidInputError when they do not fit the configuration."""
        self.config: MPNetConfig = model.config
        config = self.config
        encoder = (3 * config.n_points, *config.encoder_widths)
        hidden = (config.code_dim + 2 * config.joint_dim, *config.planner_widths)
        last = 2 * len(config.encoder_widths)
        self._encoder = [
            _Layer(model, f"encoder.{2 * i}", *widths, slope=f"encoder.{2 * i + 1}")
            for i, widths in enumerate(pairwise(encoder))
        ]
        self._encoder.append(_Layer(model, f"encoder.{last}", encoder[-1], config.code_dim))
        self._hidden = [
            _Layer(model, f"hidden.{i}.0", *widths, slope=f"hidden.{i}.1")
            for i, widths in enumerate(pairwise(hidden))
        ]
        self._out = _Layer(model, "out", hidden[-1], config.joint_dim)
        expected = 2 + sum(2 if layer.slope is None else 3 for layer in (*self._encoder, *self._hidden))
        if len(model.parts[PART]) != expected:
            raise InvalidInputError(
                f"{PART} does not fit its configuration: {len(model.parts[PART])} arrays, not {expected}"
            )

    def draw_points(self, cloud: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Points (n_points, 3) of a cloud (m, 3) [m] in random order; all of them again when they run out.

        Raises InvalidInputError for a cloud that `checked_cloud` refuses.
        """
        points = checked_cloud(cloud)
        return points[rng.permutation(len(points))[np.arange(self.config.n_points) % len(points)]]

    def encode(self, points: np.ndarray) -> np.ndarray:
        """Code (code_dim,) of points (n_points, 3) [m]."""
        x = np.ascontiguousarray(points, dtype=np.float32).ravel()
        for layer in self._encoder:
            x = layer(x)
        return x

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


class _Layer:
    """x -> W x + b, then a PReLU where a slope is named."""

    def __init__(
        self, model: StoredModel, name: str, inputs: int, outputs: int, slope: str | None = None
    ) -> None:
        weight, bias = model.linear(PART, name, inputs, outputs)
        self.weight, self.bias = np.ascontiguousarray(weight.T, dtype=np.float32), bias.astype(np.float32)
        self.slope = None if slope is None else model.array(PART, f"{slope}.weight", 1).astype(np.float32)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        y = x @ self.weight
        y += self.bias
        return y if self.slope is None else np.where(y > 0.0, y, self.slope * y)
