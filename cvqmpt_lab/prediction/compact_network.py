"""The compact VQ-MPT model ready for prediction on a CPU: numpy, one token at a time, nothing computed twice.

Same mathematics as `models.compact`, which trains it; tests compare the two.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.config import ModelConfig, TransformerConfig
from cvqmpt_lab.models.stored import StoredModel, Tensors
from cvqmpt_lab.prediction.cloud_encoder import PointCloudEncoder, SceneTokens
from cvqmpt_lab.prediction.code_decoder import Refinement
from cvqmpt_lab.prediction.code_encoder import CodeEncoder
from cvqmpt_lab.prediction.layers import Affine, LayerNorm, Perceptron, normalised, softmax
from cvqmpt_lab.prediction.prediction import CodeUnion

_ROOM = 16
"""Places for codes that a cache is made or extended with."""
UNUSED = ("connectivity.", "collision.", "num_batches_tracked")
"""Tensors of a sequence model that predicting sequences needs not."""


@dataclass(frozen=True, eq=False)
class CompactScene:
    """An encoded cloud."""

    tokens: SceneTokens
    keys_values: np.ndarray
    """(n_layers, 1, 2, heads, m, d_k): keys and values in each layer."""


@dataclass(frozen=True, eq=False)
class _Layer:
    n_heads: int
    attention_width: int
    """Of queries, keys and values together."""
    scene: Affine
    project: Affine
    out: Affine

    @classmethod
    def of(cls, tensors: Tensors, sizes: TransformerConfig) -> Self:
        width, d = sizes.n_heads * sizes.d_k, sizes.d_model
        project = Affine.of(tensors, "project", d, 3 * width + sizes.d_inner, norm="norm")
        scale = 1.0 / math.sqrt(sizes.d_k)  # of the attention, folded into the queries
        project.weight[:, :width] *= scale
        project.bias[:width] *= scale
        out = Affine.of(tensors, "out", width + sizes.d_inner, d)
        return cls(sizes.n_heads, 3 * width, Affine.of(tensors, "project_scene", d, 2 * width), project, out)

    def keys_values(self, scene: np.ndarray) -> np.ndarray:
        """Keys and values (2, heads, m, d_k) of scene tokens (m, d_model)."""
        return self.scene(scene).reshape(len(scene), 2, self.n_heads, -1).transpose(1, 2, 0, 3)

    def __call__(self, tokens: np.ndarray, known: np.ndarray, place: int) -> np.ndarray:
        """Map tokens (rows * t, d_model), t of each row, that stand at `place` and after.

        known: (rows, 2, heads, length, d_k), filled up to `place`; takes the tokens' keys and values in.
        """
        rows = len(known)
        t = len(tokens) // rows
        both = self.project(normalised(tokens))
        projected = both[:, : self.attention_width].reshape(rows, t, 3, self.n_heads, -1)
        projected = projected.transpose(0, 2, 3, 1, 4)
        known[:, :, :, place : place + t] = projected[:, 1:]
        seen = known[:, :, :, : place + t]
        scores = projected[:, 0] @ seen[:, 0].swapaxes(-1, -2)
        if t > 1:  # no token looks at later ones
            scores[..., place:][..., np.triu(np.ones((t, t), dtype=bool), 1)] = -np.inf
        heads = softmax(scores) @ seen[:, 1]
        hidden = np.maximum(both[:, self.attention_width :], 0.0)
        branches = np.concatenate((heads.transpose(0, 2, 1, 3).reshape(rows * t, -1), hidden), axis=1)
        return tokens + self.out(branches)


def _with_room(known: np.ndarray, room: int) -> np.ndarray:
    """Keys and values (n_layers, rows, 2, heads, t, d_k) with places for more tokens."""
    more = np.zeros_like(known, shape=(*known.shape[:4], room, known.shape[5]))
    return np.concatenate((known, more), axis=4)


class CompactNetwork:
    """A compact model's weights, ready to predict."""

    def __init__(self, model: StoredModel) -> None:
        """Take the weights over.

        Raises
        ------
        InvalidInputError
            When they do not fit the configuration, or there is no sequence model.
        """
        config: ModelConfig = model.config
        sizes, options, n_codes = config.sequence.transformer, config.sequence, config.dictionary.n_codes
        tensors, d, c = model.part("sequence_model"), sizes.d_model, config.configuration_dim
        self.config = config
        self._codes = CodeEncoder.of(model) if options.start_goal_codes else None
        self._encoder = PointCloudEncoder(tensors.under("point_cloud_encoder"), config.point_cloud)
        coarse = config.point_cloud.sa2.widths[1]
        self._scene_in = Affine.of(tensors, "scene_projection.0", coarse + 3, d)
        self._scene_norm = LayerNorm.of(tensors, "scene_projection.1", d)
        self._configurations = Perceptron.of(tensors, "configuration_embedding", c, sizes.d_inner, d)
        self._roles = tensors("role_embedding.weight", 3, d).astype(np.float32)
        at_means = tensors("code_configurations", n_codes, c) @ tensors("code_projection.weight", d, c).T
        self.code_tokens = (tensors("code_embedding.weight", n_codes, d) + at_means).astype(np.float32)
        self.positions = sinusoid_table(options.max_length, d)
        self.layers = [_Layer.of(tensors.under(f"layers.{i}"), sizes) for i in range(sizes.n_layers)]
        self.classify_normalised = Affine.of(tensors, "class_pred", d, config.goal_class + 1, norm="norm")
        self._refine: Affine | None = None
        if options.refinement:
            self._refine = Affine.of(tensors, "refinement.linear", d, 2 * config.joint_dim)
        tensors.require_used(*UNUSED)

    def encode_scene(self, points: np.ndarray) -> CompactScene:
        """Encode a cloud (m, 3) of `checked_cloud`."""
        tokens = self._encoder(points)
        scene = self._scene_norm(self._scene_in(tokens.coarse.both))
        return CompactScene(tokens, np.stack([layer.keys_values(scene)[None] for layer in self.layers]))

    def decoder(self, scene: CompactScene, starts: np.ndarray, goals: np.ndarray) -> "CachedDecoder":
        """Decoder for starts and goals (q, configuration_dim)."""
        return CachedDecoder(self, scene, self._prefix(starts, goals))

    def refinement(
        self, scene: CompactScene, starts: np.ndarray, goals: np.ndarray, union: CodeUnion
    ) -> Refinement | None:
        """Shift and width of each code's Gaussian at its place in the sequence it is taken from."""
        if self._refine is None:
            return None
        n = self.config.joint_dim
        if len(union.codes) == 0:
            return Refinement(np.empty((0, n), np.float32), np.empty((0, n), np.float32))
        rows = union.goal_of_sequence
        states = self.states(scene, starts[rows], goals[rows], union.padded)
        both = self._refine(states[union.sequence, union.place])
        return Refinement(both[:, :n], np.exp(both[:, n:]))

    def states(
        self, scene: CompactScene, starts: np.ndarray, goals: np.ndarray, codes: np.ndarray
    ) -> np.ndarray:
        """States (r, t, d_model) at codes (r, t) of known sequences; padding at their end needs no mask here."""
        rows, t = codes.shape
        prefix = self._prefix(starts, goals)
        first = prefix.shape[1]
        tokens = np.concatenate((prefix, self.code_tokens[codes] + self.positions[:t]), axis=1)
        known = _with_room(scene.keys_values.repeat(rows, axis=1), first + t)
        flat = self.run(tokens.reshape(rows * (first + t), -1), known, scene.keys_values.shape[4])
        return flat.reshape(tokens.shape)[:, first:]

    def run(self, tokens: np.ndarray, known: np.ndarray, place: int) -> np.ndarray:
        """Send tokens (rows * t, d_model), t of each row, through the layers; known as in a layer, of all."""
        for layer, of_layer in zip(self.layers, known, strict=True):
            tokens = layer(tokens, of_layer, place)
        return tokens

    def classify(self, states: np.ndarray) -> np.ndarray:
        """Logits (rows, n_classes) at states (rows, d_model)."""
        return self.classify_normalised(normalised(states))

    def _prefix(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Tokens (q, 3, d_model) of start, goal and start token."""
        ends = np.stack((starts, goals), axis=1).reshape(2 * len(starts), -1)
        tokens = self._configurations(ends)
        if self._codes is not None:
            tokens += self.code_tokens[self._codes(ends)]
        whole = np.zeros((len(starts), 3, tokens.shape[1]), dtype=np.float32)
        whole[:, :2] = tokens.reshape(len(starts), 2, -1)
        return whole + self._roles


class CachedDecoder:
    """A `decoding.StepDecoder` that computes each token once."""

    def __init__(self, network: CompactNetwork, scene: CompactScene, prefix: np.ndarray) -> None:
        """Decode behind prefix tokens (q, p, d_model)."""
        self._network, self._prefix = network, prefix
        self._first = scene.keys_values.shape[4] + prefix.shape[1]  # place of the first code
        self._known = _with_room(scene.keys_values.repeat(len(prefix), axis=1), prefix.shape[1] + _ROOM)
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
        tokens = self._prefix.reshape(-1, self._prefix.shape[2])
        return self._network.classify(self._network.run(tokens, self._known, self._first - p)[p - 1 :: p])

    def advance(self, parents: np.ndarray | None, codes: np.ndarray) -> np.ndarray:
        """Replace the rows; see `decoding.StepDecoder`.

        Raises
        ------
        InvalidInputError
            When sequences grow beyond the model's length.
        """
        network, most = self._network, len(self._network.positions)
        if self._length >= most:
            raise InvalidInputError(f"sequence of {self._length + 1} codes; this model takes {most} at most")
        if parents is not None:
            self._reorder(parents)
        place = self._first + self._length
        if place == self._known.shape[4]:
            self._known = _with_room(self._known, _ROOM)
        tokens = network.code_tokens[codes] + network.positions[self._length]
        self._length += 1
        return network.classify(network.run(tokens, self._known, place))

    def _reorder(self, parents: np.ndarray) -> None:
        """Let rows continue their parents; what precedes the codes is the same for rows of one query."""
        if self._length == 0:
            self._known = self._known.take(parents, axis=1)
        else:
            codes = self._known[..., self._first : self._first + self._length, :]
            codes[:] = codes.take(parents, axis=1)


def sinusoid_table(n_position: int, d_model: int) -> np.ndarray:
    """Positions as waves (n_position, d_model) float32: those of `models.published.attention`."""
    dimension = np.arange(d_model)
    angle = np.arange(n_position)[:, None] / 10000.0 ** (2.0 * (dimension // 2) / d_model)
    return np.where(dimension % 2 == 0, np.sin(angle), np.cos(angle)).astype(np.float32)
