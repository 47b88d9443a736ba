"""Arrays of the scene transformer: its layers in numpy, groups of points, the roadmap as arcs.

Groups, arcs and constants serve both training (torch) and planning (numpy). Layers are float32 and
compute the same as those of `scene_transformer`.
"""

from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.vqmpt.weights import StoredModel

WAVES = 5  # frequencies of the code of a position
RISK = 3.0  # w, what -log P(free) costs [rad]
UNREACHED = 30.0  # [rad] cost to go where no path leads to the goal
WORST = 10.0  # [rad] most that an advantage A counts
LONGEST = 13  # codes of a sequence
NOWHERE = (0.0, 0.0, -0.87)  # [m] where the points of an empty cloud lie


def group_points(cloud: np.ndarray, groups: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Groups of a cloud, by farthest point sampling.

    Args:
        cloud: (m, 3) [m]; a cloud of few points repeats them.
        groups: number of groups.
        size: points of each group.

    Returns:
        Centres (groups, 3), each the point farthest from those before it, and the nearest points
        around each (groups, size, 3), relative to their centre [m].
    """
    points = np.asarray(cloud, dtype=np.float32)
    # argpartition below needs more points than a group has
    points = points[np.arange(max(len(points), size + 1)) % len(points)]
    chosen, away = np.zeros(groups, dtype=np.int64), ((points - points[0]) ** 2).sum(1)
    for k in range(1, groups):
        chosen[k] = away.argmax()
        offset = points - points[chosen[k]]
        np.minimum(away, np.einsum("ij,ij->i", offset, offset), out=away)
    centres = points[chosen]
    squared = (centres**2).sum(1)[:, None] + (points**2).sum(1) - 2.0 * centres @ points.T
    nearest = np.argpartition(squared, size, axis=1)[:, :size]
    return centres, points[nearest] - centres[:, None]


def arcs_of(count: int, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A roadmap's undirected edges as arcs in both directions, by the node that they leave.

    Args:
        count: number of nodes N.
        edges: (E, 2), none of which joins a node to itself.

    Returns:
        Neighbours of each node (N, w) int32, padded with the node itself, and the edge to each
        (N, w) int32, padded with 0.
    """
    both = np.concatenate([edges, edges[:, ::-1]])
    order = np.lexsort((both[:, 1], both[:, 0]))
    here, there = both[order].T
    degree = np.bincount(here, minlength=count)
    column = np.arange(len(here)) - np.repeat(degree.cumsum() - degree, degree)
    neighbour = np.repeat(np.arange(count, dtype=np.int32)[:, None], degree.max(), axis=1)
    edge = np.zeros_like(neighbour)
    neighbour[here, column], edge[here, column] = there, order % len(edges)
    return neighbour, edge


class Ends(NamedTuple):
    """Starts or goals (u) in a scene, or (s, u) in s scenes: arrays, or tensors in training."""

    embedding: Any  # (u, d)
    near: Any  # (u, l) int64, the codes near each
    cost: Any  # (u, l), length - w log P(free) of the motion to each [rad]


class Linear(NamedTuple):
    """Linear layer y = x W^T + b."""

    weight: np.ndarray  # W^T (inputs, outputs)
    bias: np.ndarray  # b (outputs,)

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
        """This norm and a linear layer behind it, as one layer that takes `standardised` rows."""
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
    """Attention and a feed-forward block, both normalised first.

    With q, k, v linear in the normalised tokens (those of a context for k and v, where there is
    one) and h the heads,

        x <- x + W_o [softmax(q_h k_h^T / sqrt(d_h)) v_h]_h,    x <- x + W_2 gelu(W_1 norm(x)).

    The gains and offsets of norms and the scale of q are taken into the layers behind them.
    """

    def __init__(
        self, layers: Layers, name: str, width: int, heads: int, inner: int, context: bool = False
    ) -> None:
        """Read the layers of that name.

        Args:
            layers: the part's layers.
            name: of the block.
            width: d, of tokens.
            heads: of the attention.
            inner: width between the layers of the feed-forward block.
            context: keys and values are those of other tokens, which have a norm of their own.
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
        # one product in place of three where a token attends to its own row
        both = zip(self.query, self.key_value, strict=True)
        self.all = Linear(*(np.concatenate(parts, axis=-1) for parts in both))
        self.out = layers.linear(f"{name}.out", width, width)
        self.first = inner_norm.then(layers.linear(f"{name}.first", width, inner))
        self.second = layers.linear(f"{name}.second", inner, width)

    def keys_values(self, tokens: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keys (heads, d / heads, t) and values (heads, t, d / heads) of tokens (t, d)."""
        split = self.key_value(standardised(tokens)).reshape(len(tokens), 2, self.heads, -1)
        keys, values = split[:, 0].transpose(1, 2, 0), split[:, 1].transpose(1, 0, 2)
        return np.ascontiguousarray(keys), np.ascontiguousarray(values)

    def attend(self, x: np.ndarray, keys: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Map rows x (r, d), all of which attend to the same tokens, see `keys_values`."""
        q = self.query(standardised(x)).reshape(len(x), self.heads, -1).transpose(1, 0, 2)
        heads = softmax(q @ keys) @ values
        return self._feed_forward(x, heads.transpose(1, 0, 2).reshape(x.shape))

    def append(self, x: np.ndarray, cache: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Map the next token of each row, which attends to itself and the row's earlier tokens.

        Args:
            x: (r, d), the tokens.
            cache: (r, t, 2 d), keys and values of t earlier tokens; None for none.

        Returns:
            Outputs (r, d), and the cache with those of the tokens (r, t + 1, 2 d).
        """
        y, r, d = self.all(standardised(x)), len(x), self.width
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
    """(x - mean(x)) / sqrt(var(x) + epsilon), of rows (r, d); epsilon is torch's."""
    d = x.shape[1]
    y = x - (np.add.reduce(x, axis=1, keepdims=True) * np.float32(1.0 / d))
    # einsum makes no array of squares
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
    """max(x, 0), in place."""
    return np.maximum(x, np.float32(0.0), out=x)


def softmax(x: np.ndarray) -> np.ndarray:
    """exp(x_i) / sum_j exp(x_j) over the last axis, in place."""
    x -= x.max(axis=-1, keepdims=True)
    np.exp(x, out=x)
    x /= x.sum(axis=-1, keepdims=True)
    return x
