"""Layers of trained networks in numpy: for a few rows a torch call costs several times what it computes."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from cvqmpt_lab.vqmpt.config import MPNetConfig
from cvqmpt_lab.vqmpt.inputs import checked_cloud
from cvqmpt_lab.vqmpt.weights import StoredModel, Tensors


@dataclass(frozen=True, eq=False)
class Affine:
    """x -> x @ weight + bias, of rows x (r, d)."""

    weight: np.ndarray
    """(d, m) float32."""
    bias: np.ndarray
    """(m,) float32."""

    @classmethod
    def folded(cls, weight: np.ndarray, bias: np.ndarray) -> Self:
        """Of a torch layer's weight (m, d) and bias (m,) in float64."""
        return cls(np.ascontiguousarray(weight.T, dtype=np.float32), bias.astype(np.float32))

    @classmethod
    def of(cls, tensors: Tensors, name: str, inner: int, outer: int, norm: str | None = None) -> Self:
        """A linear layer by name; scale and shift of the layer norm before it, if one is named, are folded in."""
        weight, bias = tensors(f"{name}.weight", outer, inner), tensors(f"{name}.bias", outer)
        if norm is not None:
            bias = bias + weight @ tensors(f"{norm}.bias", inner)
            weight = weight * tensors(f"{norm}.weight", inner)
        return cls.folded(weight, bias)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map rows."""
        y = x @ self.weight
        y += self.bias
        return y


@dataclass(frozen=True, eq=False)
class Perceptron:
    """Linear layers with a ReLU between each two."""

    layers: tuple[Affine, ...]

    @classmethod
    def of(cls, tensors: Tensors, name: str, *widths: int) -> Self:
        """The layers of a torch sequence of that name, in which every second module is a ReLU."""
        pairs = enumerate(pairwise(widths))
        return cls(tuple(Affine.of(tensors, f"{name}.{2 * i}", *pair) for i, pair in pairs))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map rows (r, d)."""
        for layer in self.layers[:-1]:
            x = layer(x)
            np.maximum(x, 0.0, out=x)
        return self.layers[-1](x)


def normalised(x: np.ndarray, epsilon: float) -> np.ndarray:
    """Layer norm of rows x (r, d) without scale and shift."""
    d = x.shape[1]
    y = x - np.add.reduce(x, axis=1, keepdims=True) / d
    y *= 1.0 / np.sqrt(np.add.reduce(y * y, axis=1, keepdims=True) / d + epsilon)
    return y


# MPNet made ready for planning on a CPU: one proposal at a time, in numpy, repeatable by seed.
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
    """MPNet's weights, ready to propose; the same mathematics as `mpnet_network`, which trains it."""

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
