"""Published stage 2: scene, start and goal to a sequence of codes."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from cvqmpt_lab.models.config import EPSILON, ModelConfig, TransformerConfig
from cvqmpt_lab.models.decoding.step_decoder import StepDecoder, rows_per_scene
from cvqmpt_lab.models.dictionary.dictionary import Dictionary
from cvqmpt_lab.models.dictionary.quantizer import Quantizer
from cvqmpt_lab.models.point_cloud.clouds import require_point_cloud
from cvqmpt_lab.models.published.attention import SelfAttentionLayer
from cvqmpt_lab.models.published.prefix_decoder import PrefixDecoder
from cvqmpt_lab.models.published.scene_context import SceneContext

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
