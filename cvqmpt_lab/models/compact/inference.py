"""The compact model made ready for prediction on a CPU: one token at a time, nothing computed twice.

Same mathematics as `compact.transformer`, in numpy: for a few rows of one token a torch call costs several
times what it computes.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.compact.sequence_model import CompactScene, CompactSequenceModel
from cvqmpt_lab.models.compact.transformer import CompactLayer
from cvqmpt_lab.models.decoding.step_decoder import rows_per_scene
from cvqmpt_lab.models.dictionary.dictionary import Dictionary

_ROOM = 16
"""Places for codes that a cache is made or extended with."""


@dataclass(frozen=True, eq=False)
class _Affine:
    """x -> normalised x @ weight + bias; scale and shift of the layer norm before it are folded in."""

    weight: np.ndarray
    bias: np.ndarray

    @classmethod
    def of(cls, linear: nn.Linear, norm: nn.LayerNorm | None = None) -> "_Affine":
        weight, bias = (tensor.detach().cpu().double() for tensor in (linear.weight, linear.bias))
        if norm is not None:
            scale, shift = (tensor.detach().cpu().double() for tensor in (norm.weight, norm.bias))
            weight, bias = weight * scale, bias + weight @ shift
        return cls(np.ascontiguousarray(weight.T.float().numpy()), bias.float().numpy())

    def __call__(self, x: np.ndarray) -> np.ndarray:
        y = x @ self.weight
        y += self.bias
        return y


@dataclass(frozen=True, eq=False)
class _Layer:
    n_heads: int
    attention_width: int
    epsilon: float
    project: _Affine
    out: _Affine

    @classmethod
    def of(cls, layer: CompactLayer) -> "_Layer":
        project, out = _Affine.of(layer.project, layer.norm), _Affine.of(layer.out)
        width = layer.widths[0]
        query = slice(0, width // 3)  # 1 / sqrt(d_k) of the attention is folded into the queries
        scale = math.sqrt(layer.n_heads / (width // 3))
        project.weight[:, query] *= scale
        project.bias[query] *= scale
        return cls(layer.n_heads, width, layer.norm.eps, project, out)

    def __call__(self, tokens: np.ndarray, known: np.ndarray, place: int) -> np.ndarray:
        """Map tokens (rows * t, d_model), t of each row, that stand at `place` and after.

        known: (rows, 2, heads, length, d_k), filled up to `place`; takes the tokens' keys and values in.
        """
        rows = len(known)
        t = len(tokens) // rows
        both = self.project(_normalised(tokens, self.epsilon))
        projected = both[:, : self.attention_width].reshape(rows, t, 3, self.n_heads, -1)
        projected = projected.transpose(0, 2, 3, 1, 4)
        known[:, :, :, place : place + t] = projected[:, 1:]
        seen = known[:, :, :, : place + t]
        scores = projected[:, 0] @ seen[:, 0].swapaxes(-1, -2)
        if t > 1:  # no token looks at later ones
            scores[..., place:][..., np.triu(np.ones((t, t), dtype=bool), 1)] = -np.inf
        scores -= np.maximum.reduce(scores, axis=-1, keepdims=True)
        np.exp(scores, out=scores)
        heads = scores @ seen[:, 1]
        heads /= np.add.reduce(scores, axis=-1, keepdims=True)
        hidden = np.maximum(both[:, self.attention_width :], 0.0)
        branches = np.concatenate((heads.transpose(0, 2, 1, 3).reshape(rows * t, -1), hidden), axis=1)
        return tokens + self.out(branches)


def _normalised(x: np.ndarray, epsilon: float) -> np.ndarray:
    """Layer norm of x (r, d) without scale and shift."""
    d = x.shape[1]
    y = x - np.add.reduce(x, axis=1, keepdims=True) / d
    y *= 1.0 / np.sqrt(np.add.reduce(y * y, axis=1, keepdims=True) / d + epsilon)
    return y


def _with_room(known: np.ndarray, room: int) -> np.ndarray:
    """Keys and values (n_layers, rows, 2, heads, t, d_k) with places for more tokens."""
    more = np.zeros_like(known, shape=(*known.shape[:4], room, known.shape[5]))
    return np.concatenate((known, more), axis=4)


class CompactInference:
    """A snapshot of a compact model's weights that decodes fast; make it anew when the weights change."""

    def __init__(self, model: CompactSequenceModel, dictionary: Dictionary) -> None:
        self._model, self._dictionary = model, dictionary
        self.layers = [_Layer.of(layer) for layer in model.compact_layers()]
        self.classify_normalised = _Affine.of(model.class_pred, model.norm)
        self.epsilon = model.norm.eps
        with torch.no_grad():
            n_codes = len(model.code_configurations)
            every = torch.arange(n_codes, device=model.code_configurations.device)
            self.code_tokens = model.embed_codes(every).cpu().numpy()
        self.positions = model.positions.cpu().numpy()

    @torch.inference_mode()
    def decoder(self, scene: CompactScene, start: Tensor, goal: Tensor) -> "CachedDecoder":
        """Decoder for starts and goals (q, configuration_dim), queries grouped by scene."""
        times = rows_per_scene(len(start), len(scene.tokens.coarse.centres))
        of_scene = scene.keys_values.detach().cpu().numpy().repeat(times, axis=1)
        prefix = self._model.query_tokens(self._dictionary, start, goal)
        return CachedDecoder(self, of_scene, prefix.cpu().numpy())


class CachedDecoder:
    """A `decoding.StepDecoder` that computes each token once."""

    def __init__(self, weights: CompactInference, scene: np.ndarray, prefix: np.ndarray) -> None:
        """Decode behind prefix tokens (q, p, d_model).

        scene: keys and values (n_layers, q, 2, heads, m, d_k) of the scene tokens each query looks at.
        """
        self._weights, self._prefix = weights, prefix
        self._first = scene.shape[4] + prefix.shape[1]  # place of the first code
        self._known = _with_room(scene, prefix.shape[1] + _ROOM)
        self._length = -1

    def start(self) -> np.ndarray:
        """Logits (queries, n_classes) of the first code.

        Raises
        ------
        InvalidInputError
            When called twice.
        """
        if self._length >= 0:
            raise InvalidInputError("this decoder was used before; make a fresh one for each search")
        self._length = 0
        p = self._prefix.shape[1]
        state = self._run(self._prefix.reshape(-1, self._prefix.shape[2]), self._first - p)
        return self._classify(state[p - 1 :: p])

    def advance(self, parents: np.ndarray | None, codes: np.ndarray) -> np.ndarray:
        """Replace the rows; see `decoding.StepDecoder`.

        Raises
        ------
        InvalidInputError
            When sequences grow beyond the model's length.
        """
        most = len(self._weights.positions)
        if self._length >= most:
            raise InvalidInputError(f"sequence of {self._length + 1} codes; this model takes {most} at most")
        if parents is not None:
            self._reorder(parents)
        if self._first + self._length == self._known.shape[4]:
            self._known = _with_room(self._known, _ROOM)
        tokens = self._weights.code_tokens[codes] + self._weights.positions[self._length]
        self._length += 1
        return self._classify(self._run(tokens, self._first + self._length - 1))

    def _reorder(self, parents: np.ndarray) -> None:
        """Let rows continue their parents; what precedes the codes is the same for rows of one query."""
        if self._length == 0:
            self._known = self._known.take(parents, axis=1)
        else:
            codes = self._known[..., self._first : self._first + self._length, :]
            codes[:] = codes.take(parents, axis=1)

    def _run(self, tokens: np.ndarray, place: int) -> np.ndarray:
        """Send tokens (rows * t, d_model), t of each row, through the layers."""
        for layer, known in zip(self._weights.layers, self._known, strict=True):
            tokens = layer(tokens, known, place)
        return tokens

    def _classify(self, states: np.ndarray) -> np.ndarray:
        """Logits (rows, n_classes) at states (rows, d_model)."""
        return self._weights.classify_normalised(_normalised(states, self._weights.epsilon))
