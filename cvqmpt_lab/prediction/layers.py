"""Layers of trained networks in numpy: for a few rows a torch call costs several times what it computes."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from cvqmpt_lab.models.stored import Tensors


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
