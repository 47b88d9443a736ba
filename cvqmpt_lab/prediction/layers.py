"""Layers of trained networks in numpy: for a few rows a torch call costs several times what it computes."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from cvqmpt_lab.models.stored import Tensors

TORCH_EPSILON = 1e-5
"""Of layer and batch norms that say nothing else."""


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


@dataclass(frozen=True, eq=False)
class LayerNorm:
    """Rows scaled to mean 0 and variance 1, then each column by its own."""

    scale: np.ndarray
    shift: np.ndarray
    epsilon: float = TORCH_EPSILON

    @classmethod
    def of(cls, tensors: Tensors, name: str, width: int, epsilon: float = TORCH_EPSILON) -> Self:
        """By name."""
        scale, shift = (tensors(f"{name}.{kind}", width).astype(np.float32) for kind in ("weight", "bias"))
        return cls(scale, shift, epsilon)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map rows (r, d)."""
        return normalised(x, self.epsilon) * self.scale + self.shift


def normalised(x: np.ndarray, epsilon: float = TORCH_EPSILON) -> np.ndarray:
    """Layer norm of rows x (r, d) without scale and shift."""
    d = x.shape[1]
    y = x - np.add.reduce(x, axis=1, keepdims=True) / d
    y *= 1.0 / np.sqrt(np.add.reduce(y * y, axis=1, keepdims=True) / d + epsilon)
    return y


def softmax(scores: np.ndarray) -> np.ndarray:
    """Along the last axis, in place."""
    scores -= np.maximum.reduce(scores, axis=-1, keepdims=True)
    np.exp(scores, out=scores)
    scores /= np.add.reduce(scores, axis=-1, keepdims=True)
    return scores
