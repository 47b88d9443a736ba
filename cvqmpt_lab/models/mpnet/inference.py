"""MPNet made ready for planning on a CPU: one proposal at a time, in numpy, repeatable by seed.

For one row a torch call takes several times what it computes; several rows at once gain nothing, because a
product with one row reads each weight once and needs no preparation.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.mpnet.network import MPNet
from cvqmpt_lab.models.point_cloud.sampling import require_point_cloud


@dataclass(frozen=True, eq=False)
class _Layer:
    """x -> x @ weight + bias, then an activation."""

    weight: np.ndarray
    bias: np.ndarray
    slope: np.ndarray | None
    """What negative values are multiplied by; None for no activation."""

    @classmethod
    def of(cls, linear: nn.Linear, prelu: nn.PReLU | None) -> "_Layer":
        arrays = [
            tensor.detach().cpu().float().numpy().copy()
            for tensor in (linear.weight, linear.bias, *(prelu.parameters() if prelu else ()))
        ]
        return cls(np.ascontiguousarray(arrays[0].T), arrays[1], arrays[2] if prelu else None)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        y = x @ self.weight
        y += self.bias
        return y if self.slope is None else np.where(y > 0.0, y, self.slope * y)


class MPNetInference:
    """A snapshot of a network's weights; the same mathematics as `MPNet`, without a torch call per layer."""

    def __init__(self, network: MPNet) -> None:
        self.config = network.config
        modules = list(network.encoder)
        self._encoder = [
            _layer(modules[i], modules[i + 1] if i + 1 < len(modules) else None)
            for i in range(0, len(modules), 2)
        ]
        self._hidden = [_layer(*pair) for pair in network.hidden]  # type: ignore[misc]
        self._out = _layer(network.out, None)

    def draw_points(self, cloud: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Points (n_points, 3) of a cloud (m, 3) [m] in random order; all of them again when they run out.

        Raises
        ------
        InvalidInputError
            For fewer than two points, another shape, NaN, or an extent that cannot be metres.
        """
        points = np.asarray(cloud, dtype=np.float32)
        if points.ndim != 2:
            raise InvalidInputError(f"point cloud of shape {points.shape}; it must be (n, 3) [m]")
        require_point_cloud(torch.from_numpy(points))
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


def _layer(linear: nn.Module, prelu: nn.Module | None) -> _Layer:
    assert isinstance(linear, nn.Linear) and (prelu is None or isinstance(prelu, nn.PReLU))
    return _Layer.of(linear, prelu)
