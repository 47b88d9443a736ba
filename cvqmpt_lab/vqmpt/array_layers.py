"""Layers of trained networks in numpy, float32:
linear, layer norm, attention blocks as in `scene_transformer`.
"""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.vqmpt.weights import StoredModel

NORM_EPSILON = 1e-5  # of layer norms, torch's


class Linear(NamedTuple):
    """x W^T + b."""

    weight: np.ndarray  # (inputs, outputs)
    bias: np.ndarray  # (outputs,)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map rows (r, inputs) to (r, outputs)."""
        y = x @ self.weight
        y += self.bias
        return y


class Norm(NamedTuple):
    """Layer norm."""

    gain: np.ndarray  # (d,)
    offset: np.ndarray  # (d,)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map rows (r, d) to the same shape."""
        y = standardised(x)
        y *= self.gain
        y += self.offset
        return y

    def then(self, linear: Linear) -> Linear:
        """A linear layer behind this norm as one that takes `standardised` rows."""
        return Linear(self.gain[:, None] * linear.weight, linear.bias + self.offset @ linear.weight)


class Layers:
    """Layers of one part of a model by name; InvalidInputError names arrays that do not fit."""

    def __init__(self, model: StoredModel, part: str) -> None:
        self._model, self._part = model, part

    def array(self, name: str, *shape: int) -> np.ndarray:
        """An array of this shape."""
        return self._model.array(self._part, name, *shape).astype(np.float32)

    def linear(self, name: str, inputs: int, outputs: int) -> Linear:
        """A linear layer."""
        weight, bias = self._model.linear(self._part, name, inputs, outputs)
        return Linear(np.ascontiguousarray(weight.T, dtype=np.float32), bias.astype(np.float32))

    def norm(self, name: str, width: int) -> Norm:
        """A layer norm."""
        return Norm(self.array(f"{name}.weight", width), self.array(f"{name}.bias", width))


class Block:
    """Attention and a feed-forward block, both normalised first; the norms are taken into the
    layers behind them.

    context: keys and values are those of other tokens, which have a norm of their own.
    """

    def __init__(
        self, layers: Layers, name: str, width: int, heads: int, inner: int, context: bool = False
    ) -> None:
        norm, context_norm, inner_norm = (
            layers.norm(f"{name}.{which}", width)
            for which in ("norm", "context_norm", "inner_norm")
        )
        weight, bias = layers.linear(f"{name}.query", width, width)
        scale = np.float32((width // heads) ** -0.5)  # of scores, taken into the queries
        query = norm.then(Linear(scale * weight, scale * bias))
        key_value = (context_norm if context else norm).then(
            layers.linear(f"{name}.key_value", width, 2 * width)
        )
        self.heads, self.width = heads, width
        self.query, self.key_value = query, key_value
        self.all = Linear(
            *(np.concatenate(parts, axis=-1) for parts in zip(query, key_value, strict=True))
        )
        self.out = layers.linear(f"{name}.out", width, width)
        self.first = inner_norm.then(layers.linear(f"{name}.first", width, inner))
        self.second = layers.linear(f"{name}.second", inner, width)

    def keys_values(self, tokens: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keys (heads, d / heads, t) and values (heads, t, d / heads) of tokens (t, d) for
        `attend`.
        """
        split = self.key_value(standardised(tokens)).reshape(len(tokens), 2, self.heads, -1)
        keys, values = split[:, 0].transpose(1, 2, 0), split[:, 1].transpose(1, 0, 2)
        return np.ascontiguousarray(keys), np.ascontiguousarray(values)

    def attend(self, x: np.ndarray, keys: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Map rows x (r, d), all of which attend to the same tokens, see `keys_values`."""
        q = self.query(standardised(x)).reshape(len(x), self.heads, -1).transpose(1, 0, 2)
        heads = softmax(q @ keys) @ values
        return self.forward(x, heads.transpose(1, 0, 2).reshape(x.shape))

    def attend_own(self, x: np.ndarray, kept: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """What rows x (r, d) read from themselves and t earlier tokens of their own, kept (r, t, 2
        d).

        Also returns keys and values with those of the rows (r, t + 1, 2 d).
        """
        y, r, d = self.all(standardised(x)), len(x), self.width
        new = y[:, None, d:]
        kept = new if kept is None else np.concatenate([kept, new], axis=1)
        split = kept.reshape(r, -1, 2, self.heads, d // self.heads)
        q = y[:, :d].reshape(r, self.heads, 1, -1)
        weights = softmax(q @ split[:, :, 0].transpose(0, 2, 3, 1))
        return (weights @ split[:, :, 1].transpose(0, 2, 1, 3)).reshape(r, d), kept

    def forward(self, x: np.ndarray, heads: np.ndarray) -> np.ndarray:
        """Rows (r, d) from x and what its heads have read."""
        x = x + self.out(heads)
        x += self.second(gelu(self.first(standardised(x))))
        return x


def standardised(x: np.ndarray) -> np.ndarray:
    """Rows (r, d) less their mean, over their standard deviation."""
    d = x.shape[1]
    y = x - (np.add.reduce(x, axis=1, keepdims=True) * np.float32(1.0 / d))
    variance = np.einsum("ri,ri->r", y, y) * np.float32(1.0 / d) + np.float32(NORM_EPSILON)
    y *= (np.float32(1.0) / np.sqrt(variance))[:, None]
    return y


def gelu(x: np.ndarray) -> np.ndarray:
    """X Phi(x), in its form with tanh."""
    inner = x * x
    inner *= np.float32(0.7978845608 * 0.044715)
    inner += np.float32(0.7978845608)
    inner *= x
    np.tanh(inner, out=inner)
    inner += np.float32(1.0)
    inner *= x
    inner *= np.float32(0.5)
    return inner


def softplus(x: np.ndarray) -> np.ndarray:
    """log(1 + e^x)."""
    return np.logaddexp(np.float32(0.0), x)


def relu(x: np.ndarray) -> np.ndarray:
    """max(x, 0), in place."""
    return np.maximum(x, np.float32(0.0), out=x)


def softmax(x: np.ndarray) -> np.ndarray:
    """Over the last axis, in place."""
    x -= x.max(axis=-1, keepdims=True)
    np.exp(x, out=x)
    x /= x.sum(axis=-1, keepdims=True)
    return x
