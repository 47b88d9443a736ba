"""Network layers in numpy, float32, equal to torch's up to rounding.

Planning uses them for the scene transformer and MPNet, so that it does not need torch.
"""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.vqmpt.weights import StoredModel


class Linear(NamedTuple):
    """Linear layer y = x W^T + b."""

    weight: np.ndarray  # (inputs, outputs), W^T
    bias: np.ndarray  # (outputs,), b

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map rows (r, inputs) to (r, outputs)."""
        y = x @ self.weight
        y += self.bias
        return y


class Norm(NamedTuple):
    """Layer norm: y = gain (x - mean(x)) / std(x) + offset."""

    gain: np.ndarray  # (d,)
    offset: np.ndarray  # (d,)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Map rows (r, d) to the same shape."""
        y = standardised(x)
        y *= self.gain
        y += self.offset
        return y

    def then(self, linear: Linear) -> Linear:
        """Merge this norm and the linear layer after it into a layer for `standardised` rows."""
        return Linear(self.gain[:, None] * linear.weight, linear.bias + self.offset @ linear.weight)


class Layers:
    """Layers of one part of a model by name; InvalidInputError if an array does not fit."""

    def __init__(self, model: StoredModel, part: str) -> None:
        self._model, self._part = model, part

    def array(self, name: str, *shape: int) -> np.ndarray:
        """Return the array of this name, which must have this shape."""
        return self._model.array(self._part, name, *shape).astype(np.float32)

    def linear(self, name: str, inputs: int, outputs: int) -> Linear:
        """Return the linear layer of this name."""
        weight, bias = self._model.linear(self._part, name, inputs, outputs)
        return Linear(np.ascontiguousarray(weight.T, dtype=np.float32), bias.astype(np.float32))

    def norm(self, name: str, width: int) -> Norm:
        """Return the layer norm of this name, for rows of this width."""
        return Norm(self.array(f"{name}.weight", width), self.array(f"{name}.bias", width))


class Block:
    """Attention and a feed-forward block, each after a layer norm.

    The queries q are linear in the normalised tokens. The keys k and values v are linear in the
    same normalised tokens, or in the normalised tokens of a context. With heads h,

        x <- x + W_o [softmax(q_h k_h^T / sqrt(d_h)) v_h]_h,    x <- x + W_2 gelu(W_1 norm(x)).

    The gains and offsets of norms and the scale of q are multiplied into the next layers.
    """

    def __init__(
        self, layers: Layers, name: str, width: int, heads: int, inner: int, context: bool = False
    ) -> None:
        """Read the layers of a block.

        Args:
            layers: layers of the model's part.
            name: name of the block.
            width: d, width of tokens.
            heads: number of heads.
            inner: width between the two layers of the feed-forward block.
            context: whether keys and values are computed from a context, with a norm of its own.
        """
        norm = layers.norm(f"{name}.norm", width)
        inner_norm = layers.norm(f"{name}.inner_norm", width)
        weight, bias = layers.linear(f"{name}.query", width, width)
        scale = np.float32((width // heads) ** -0.5)  # 1 / sqrt(d_h), multiplied into the queries
        self.heads, self.width = heads, width
        self.query = norm.then(Linear(scale * weight, scale * bias))
        context_norm = layers.norm(f"{name}.context_norm", width)
        self.key_value = (context_norm if context else norm).then(
            layers.linear(f"{name}.key_value", width, 2 * width)
        )
        # queries, keys and values by one product, for tokens that attend to their own row
        both = zip(self.query, self.key_value, strict=True)
        self.all = Linear(*(np.concatenate(parts, axis=-1) for parts in both))
        self.out = layers.linear(f"{name}.out", width, width)
        self.first = inner_norm.then(layers.linear(f"{name}.first", width, inner))
        self.second = layers.linear(f"{name}.second", inner, width)

    def keys_values(self, tokens: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return keys (heads, d / heads, t) and values (heads, t, d / heads) of tokens (t, d)."""
        split = self.key_value(standardised(tokens)).reshape(len(tokens), 2, self.heads, -1)
        keys, values = split[:, 0].transpose(1, 2, 0), split[:, 1].transpose(1, 0, 2)
        return np.ascontiguousarray(keys), np.ascontiguousarray(values)

    def attend(self, x: np.ndarray, keys: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Map rows x (r, d), each of which attends to all tokens of these keys and values."""
        q = self.query(standardised(x)).reshape(len(x), self.heads, -1).transpose(1, 0, 2)
        heads = softmax(q @ keys) @ values
        return self._feed_forward(x, heads.transpose(1, 0, 2).reshape(x.shape))

    def append(self, x: np.ndarray, cache: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Map the next token of each row, which attends to itself and the row's earlier tokens.

        Args:
            x: (r, d), the next tokens.
            cache: (r, t, 2 d), keys and values of the t earlier tokens; None if there are none.

        Returns:
            Outputs (r, d), and the cache with the next tokens appended (r, t + 1, 2 d).
        """
        y = self.all(standardised(x))
        r, d = len(x), self.width
        new = y[:, None, d:]
        cache = new if cache is None else np.concatenate([cache, new], axis=1)
        split = cache.reshape(r, -1, 2, self.heads, d // self.heads)
        q = y[:, :d].reshape(r, self.heads, 1, -1)
        weights = softmax(q @ split[:, :, 0].transpose(0, 2, 3, 1))
        heads = (weights @ split[:, :, 1].transpose(0, 2, 1, 3)).reshape(r, d)
        return self._feed_forward(x, heads), cache

    def _feed_forward(self, x: np.ndarray, heads: np.ndarray) -> np.ndarray:
        x = x + self.out(heads)
        x += self.second(gelu(self.first(standardised(x))))
        return x


def standardised(x: np.ndarray, epsilon: float = 1e-5) -> np.ndarray:
    """Return (x - mean(x)) / sqrt(var(x) + epsilon) of rows (r, d); epsilon as in torch."""
    d = x.shape[1]
    y = x - (np.add.reduce(x, axis=1, keepdims=True) * np.float32(1.0 / d))
    # einsum does not allocate an array of squares
    variance = np.einsum("ri,ri->r", y, y) * np.float32(1.0 / d) + np.float32(epsilon)
    y *= (np.float32(1.0) / np.sqrt(variance))[:, None]
    return y


def gelu(x: np.ndarray) -> np.ndarray:
    """Gaussian error linear unit x Phi(x), as 0.5 x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3)))."""
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
    """max(x, 0), computed in place."""
    return np.maximum(x, np.float32(0.0), out=x)


def softmax(x: np.ndarray) -> np.ndarray:
    """exp(x_i) / sum_j exp(x_j) over the last axis, computed in place."""
    x -= x.max(axis=-1, keepdims=True)
    np.exp(x, out=x)
    x /= x.sum(axis=-1, keepdims=True)
    return x
