"""Published stage 2, first half: start and goal look at the scene."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.vqmpt.attention import CrossAttentionLayer, SelfAttentionLayer
from cvqmpt_lab.vqmpt.beam_search import StepDecoder, rows_per_scene
from cvqmpt_lab.vqmpt.config import EPSILON, ModelConfig, PointCloudConfig, TransformerConfig
from cvqmpt_lab.vqmpt.dictionary import Dictionary, Quantizer
from cvqmpt_lab.vqmpt.inputs import require_point_cloud
from cvqmpt_lab.vqmpt.point_encoder import PointCloudEncoder


class CrossAttentionContext(nn.Module):
    """Embeds start and goal and lets each attend to the scene tokens, but not to the other."""

    def __init__(self, joint_dim: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.to_latent_embedding = nn.Sequential(
            nn.Linear(joint_dim, sizes.d_inner),
            nn.ReLU(),
            nn.Linear(sizes.d_inner, sizes.d_model),
            nn.Dropout(sizes.dropout),
            nn.LayerNorm(sizes.d_model),
        )
        self.layer_stack = nn.ModuleList(CrossAttentionLayer(sizes) for _ in range(sizes.n_layers))
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=EPSILON)

    def forward(self, start_goal: Tensor, scene: Tensor, visible: Tensor | None = None) -> Tensor:
        """Map start_goal (b, 2, joint_dim), scene (b, m, d_model), visible (b, m) to (b, 2, d_model)."""
        tokens = self.to_latent_embedding(start_goal)
        for layer in self.layer_stack:
            tokens = layer(tokens, scene, visible)
        return self.layer_norm(tokens)


class SceneContext(nn.Module):
    """Point cloud encoder and cross attention: the ``context_state`` of published checkpoints."""

    def __init__(self, joint_dim: int, point_cloud: PointCloudConfig, sizes: TransformerConfig) -> None:
        super().__init__()
        self.env_encoder = PointCloudEncoder(point_cloud)
        self.context_encoder = CrossAttentionContext(joint_dim, sizes)

    def encode_scene(self, clouds: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Tokens (b, m, d_model) of clouds (n_i, 3) [m], padded to the longest, and which are real (b, m).

        Batch norm statistics are per cloud when training on clouds of unequal sizes.
        """
        if len({len(cloud) for cloud in clouds}) == 1:
            tokens = self.env_encoder(torch.stack(clouds)).features
            return tokens, tokens.new_ones(tokens.shape[:2], dtype=torch.bool)
        each = [self.env_encoder(cloud[None]).features[0] for cloud in clouds]
        longest = max(len(tokens) for tokens in each)
        padded = torch.stack([F.pad(tokens, (0, 0, 0, longest - len(tokens))) for tokens in each])
        sizes = torch.tensor([len(tokens) for tokens in each], device=padded.device)
        return padded, torch.arange(longest, device=padded.device) < sizes[:, None]


# Decoding with a model that keeps nothing between two codes.
class PrefixDecoder:
    """A `decoding.StepDecoder` that keeps nothing and runs the model on whole prefixes."""

    def __init__(self, queries: Tensor, logits_of: Callable[[Tensor, Tensor], Tensor]) -> None:
        """Decode for queries (q,), their indices.

        `logits_of` maps query indices (rows,) and prefixes (rows, t) to logits (rows, n_classes).
        """
        self._queries = queries
        self._codes = queries.new_zeros(len(queries), 0)
        self._logits_of = logits_of

    def start(self) -> np.ndarray:
        """Logits (queries, n_classes) of the first code."""
        return self._logits()

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Replace the rows; see `decoding.StepDecoder`."""
        rows, added = (torch.from_numpy(given).to(self._queries.device) for given in (parents, codes))
        self._queries, self._codes = (
            self._queries[rows],
            torch.cat((self._codes[rows], added[:, None]), dim=1),
        )
        return self._logits()

    @torch.inference_mode()
    def _logits(self) -> np.ndarray:
        return self._logits_of(self._queries, self._codes).float().cpu().numpy()


# Published stage 2: scene, start and goal to a sequence of codes.
START_TOKEN = -1.0
"""Every entry of the vector that stands between the context and the first code."""
MOST_PREFIXES = 40
"""Training samples taken of one sequence."""


@dataclass(frozen=True, eq=False)
class PublishedScene:
    """Encoded scenes, padded to the one with most tokens."""

    tokens: Tensor
    """(s, m, d_model)."""
    visible: Tensor
    """(s, m) bool: no padding."""


@dataclass(frozen=True, eq=False)
class PrefixSamples:
    """Training samples of one sequence, prefixes of it."""

    codes: Tensor
    """(p, n) int64."""
    lengths: Tensor
    """(p,) int64: how many of them count."""
    targets: Tensor
    """(p,) int64: the class that follows."""


def prefix_samples(codes: Tensor, goal_class: int) -> PrefixSamples:
    """Every prefix of codes (n,) and the next code, the goal class after the last.

    Never more than 40 (published code): the first ones, of 80 and more every k-th.
    """
    following = torch.cat((codes, codes.new_tensor([goal_class])))
    every = max(1, len(following) // MOST_PREFIXES)
    lengths = torch.arange(0, len(following), every, device=codes.device)[:MOST_PREFIXES]
    return PrefixSamples(codes.expand(len(lengths), -1), lengths, following[lengths])


class AutoRegressiveModel(nn.Module):
    """Transformer without position code whose visible tokens all look at each other."""

    def __init__(self, n_classes: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.layer_stack = nn.ModuleList(SelfAttentionLayer(sizes) for _ in range(sizes.n_layers))
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=EPSILON)
        self.class_pred = nn.Linear(sizes.d_model, n_classes)

    def forward(self, tokens: Tensor, read: Tensor, visible: Tensor | None = None) -> Tensor:
        """Logits (b, n_classes) at token read (b,) of tokens (b, t, d_model); visible (b, t) hides padding."""
        for layer in self.layer_stack:
            tokens = layer(tokens, visible)
        return self.class_pred(self.layer_norm(tokens[torch.arange(len(tokens)), read]))


class PublishedSequenceModel(nn.Module):
    """Context and autoregressive model: P(next code | scene, start, goal, codes so far).

    The sequence is [start, goal, S, c_1, ..., c_i]. Since tokens are not causal, each prefix is a
    sample of its own, and prediction is read at its last token. Codes enter through the dictionary's
    `Quantizer.lookup`, without gradient.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        point_cloud, sequence = config.stage2
        self.context = SceneContext(config.joint_dim, point_cloud, sequence.context)
        self.autoregressive = AutoRegressiveModel(config.goal_class + 1, sequence.transformer)

    def encode_scene(self, clouds: Sequence[Tensor] | Tensor) -> PublishedScene:
        """Encode clouds (n_i, 3) [m, robot base frame].

        Raises
        ------
        InvalidInputError
            For clouds that `require_point_cloud` refuses.
        """
        for cloud in clouds:
            require_point_cloud(cloud)
        return PublishedScene(*self.context.encode_scene(list(clouds)))

    def encode_context(self, scene: PublishedScene, start: Tensor, goal: Tensor) -> Tensor:
        """Context tokens (b, 2, d_model) of starts and goals (b, joint_dim).

        Rows are grouped by scene, equally many each.
        """
        times = rows_per_scene(len(start), len(scene.tokens))
        tokens = scene.tokens.repeat_interleave(times, 0)
        visible = scene.visible.repeat_interleave(times, 0)
        return self.context.context_encoder(torch.stack((start, goal), 1), tokens, visible)

    def prefix_logits(
        self, context: Tensor, codes: Tensor, quantizer: Quantizer, lengths: Tensor | None = None
    ) -> Tensor:
        """Logits (b, n_classes) of what follows each prefix.

        Parameters
        ----------
        context
            (b, 2, d_model), of `encode_context`.
        codes
            (b, t) int64: the codes so far, padded with any valid code beyond `lengths`.
        quantizer
            The dictionary's, frozen.
        lengths
            (b,) codes that count; None for all t.
        """
        with torch.no_grad():
            embedded = quantizer.lookup(codes)
        start_token = torch.full_like(context[:, :1], START_TOKEN)
        tokens = torch.cat((context, start_token, embedded), dim=1)
        if lengths is None:
            last = torch.full((len(tokens),), tokens.shape[1] - 1, device=tokens.device)
            return self.autoregressive(tokens, last)
        visible = torch.arange(tokens.shape[1], device=tokens.device) < 3 + lengths[:, None]
        return self.autoregressive(tokens, 2 + lengths, visible)

    def decoder(
        self, dictionary: Dictionary, scene: PublishedScene, start: Tensor, goal: Tensor
    ) -> StepDecoder:
        """Decoder for starts and goals (q, joint_dim), queries grouped by scene."""
        context = self.encode_context(scene, start, goal)

        def logits_of(queries: Tensor, sequences: Tensor) -> Tensor:
            return self.prefix_logits(context[queries], sequences, dictionary.quantizer)

        return PrefixDecoder(torch.arange(len(start), device=start.device), logits_of)
