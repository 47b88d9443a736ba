"""Stage 2 of VQ-MPT, as published: from scene, start and goal to a sequence of codes.

Set abstraction turns the point cloud into scene tokens E. Start and goal, embedded by a perceptron,
attend to E and give the context M (two tokens). The autoregressive transformer predicts the next
code (paper, eqn. ar_prob),

    pi(h_j = i | z_(h_1) ... z_(h_(j-1)), M) = p_i,   i one of the N codes or the goal token.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.beam_search import StepDecoder, log_softmax
from cvqmpt_lab.vqmpt.config import (
    EPSILON,
    ModelConfig,
    PointCloudConfig,
    TransformerConfig,
    require_point_cloud,
)
from cvqmpt_lab.vqmpt.dictionary import (
    CrossAttentionLayer,
    Dictionary,
    Quantizer,
    SelfAttentionLayer,
)
from cvqmpt_lab.vqmpt.point_encoder import PointCloudEncoder

START_TOKEN = -1.0  # every entry of the vector that stands between the context and the first code

Scene = tuple[Tensor, Tensor]
"""Scene tokens (s, m, d_model), padded to the scene with most of them, and which are no padding (s,
m) bool.
"""


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
        """Map start_goal (b, t, joint_dim), scene (b, m, d_model), visible (b, m) to M (b, t,
        d_model).
        """
        tokens = self.to_latent_embedding(start_goal)
        for layer in self.layer_stack:
            tokens = layer(tokens, scene, visible)
        return self.layer_norm(tokens)


class SceneContext(nn.Module):
    """Point cloud encoder and cross attention: the ``context_state`` of published checkpoints."""

    def __init__(
        self, joint_dim: int, point_cloud: PointCloudConfig, sizes: TransformerConfig
    ) -> None:
        super().__init__()
        self.env_encoder = PointCloudEncoder(point_cloud)
        self.context_encoder = CrossAttentionContext(joint_dim, sizes)

    def encode_scene(self, clouds: list[Tensor]) -> Scene:
        """Tokens of clouds (n_i, 3) [m];
        batch norm statistics are per cloud when clouds differ in size.
        """
        if len({len(cloud) for cloud in clouds}) == 1:
            tokens = self.env_encoder(torch.stack(clouds)).features
            return tokens, tokens.new_ones(tokens.shape[:2], dtype=torch.bool)
        each = [self.env_encoder(cloud[None]).features[0] for cloud in clouds]
        longest = max(len(tokens) for tokens in each)
        padded = torch.stack([F.pad(tokens, (0, 0, 0, longest - len(tokens))) for tokens in each])
        sizes = torch.tensor([len(tokens) for tokens in each], device=padded.device)
        return padded, torch.arange(longest, device=padded.device) < sizes[:, None]


class AutoRegressiveModel(nn.Module):
    """Transformer without position code whose tokens all attend to each other."""

    def __init__(self, n_classes: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.layer_stack = nn.ModuleList(SelfAttentionLayer(sizes) for _ in range(sizes.n_layers))
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=EPSILON)
        self.class_pred = nn.Linear(sizes.d_model, n_classes)

    def forward(self, tokens: Tensor) -> Tensor:
        """Logits (b, n_classes) of what follows tokens (b, t, d_model), read at the last one."""
        *before, last = self.layer_stack
        for layer in before:
            tokens = layer(tokens)
        token = last(tokens, read=tokens[:, -1:])
        return self.class_pred(self.layer_norm(token[:, 0]))


class PublishedSequenceModel(nn.Module):
    """Context and autoregressive model.

    The sequence is [M_start, M_goal, S, c_1, ..., c_i], S a constant. Since tokens are not causal,
    each prefix is a sample of its own, and prediction is read at its last token. Codes enter
    through the dictionary's `Quantizer.lookup`, without gradient, and a linear layer where the
    dictionary has another width.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        point_cloud, sequence = config.stage2
        self.context = SceneContext(config.joint_dim, point_cloud, sequence.context)
        self.autoregressive = AutoRegressiveModel(config.goal_class + 1, sequence.transformer)
        given, width = config.dictionary.transformer.d_model, sequence.transformer.d_model
        self.enter = nn.Identity() if given == width else nn.Linear(given, width)

    def encode_scene(self, clouds: Sequence[Tensor] | Tensor) -> Scene:
        """Encode clouds (n_i, 3) [m, robot base frame]; errors as of `require_point_cloud`."""
        for cloud in clouds:
            require_point_cloud(cloud)
        return self.context.encode_scene(list(clouds))

    @torch.inference_mode()
    def encode_cloud(self, points: np.ndarray) -> Scene:
        """Encode one cloud (m, 3) float32 [m, robot base frame], for planning."""
        return self.encode_scene([torch.tensor(points)])

    def encode_context(self, scene: Scene, start: Tensor, goal: Tensor) -> Tensor:
        """Context M (b, 2, d_model) of starts and goals (b, joint_dim), grouped by scene, equally
        many each.
        """
        times, left = divmod(len(start), len(scene[0]))
        if left:
            raise InvalidInputError(
                f"{len(start)} starts and goals for {len(scene[0])} scenes; give equally many for "
                f"each"
            )
        # which ignore each other
        ends = torch.stack((start, goal), 1).view(len(scene[0]), 2 * times, -1)
        return self.context.context_encoder(ends, *scene).view(len(start), 2, -1)

    def prefix_logits(self, context: Tensor, codes: Tensor, quantizer: Quantizer) -> Tensor:
        """Logits of what follows a prefix, of pi(h_j = i | h_1 ... h_(j-1), M).

        Args:
            context: (b, 2, d_model) M, of `encode_context`.
            codes: (b, t) int64, h_1 ... h_t.
            quantizer: the dictionary's, frozen.

        Returns:
            (b, n_classes): the codes, the start token and the goal token.
        """
        with torch.no_grad():
            embedded = quantizer.lookup(codes)
        start_token = torch.full_like(context[:, :1], START_TOKEN)
        tokens = torch.cat((context, start_token, self.enter(embedded)), dim=1)
        return self.autoregressive(tokens)

    @torch.inference_mode()
    def decoder(
        self,
        dictionary: Dictionary,
        scene: Scene,
        start: np.ndarray | Tensor,
        goal: np.ndarray | Tensor,
    ) -> StepDecoder:
        """What beam search asks, for starts and goals (q, joint_dim), queries grouped by scene."""
        context = self.encode_context(scene, torch.as_tensor(start), torch.as_tensor(goal))
        return _PrefixDecoder(self, dictionary.quantizer, context)


class _PrefixDecoder:
    """A `StepDecoder` that keeps the prefixes alone and runs the model on all of each."""

    def __init__(
        self, model: PublishedSequenceModel, quantizer: Quantizer, context: Tensor
    ) -> None:
        # context (rows, 2, d_model)
        self._model, self._quantizer, self._context = model, quantizer, context
        self._codes = torch.zeros(len(context), 0, dtype=torch.int64, device=context.device)

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Classes and log-probabilities (queries, n_classes) of the first code."""
        classes, log_p = self._log_probabilities()
        log_p[:, -1] = -np.inf
        return classes, log_p

    def advance(self, parents: np.ndarray, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Replace the rows; see `StepDecoder`."""
        rows, added = (
            torch.from_numpy(given).to(self._context.device) for given in (parents, codes)
        )
        self._context = self._context[rows]
        self._codes = torch.cat((self._codes[rows], added[:, None]), dim=1)
        return self._log_probabilities()

    @torch.inference_mode()
    def _log_probabilities(self) -> tuple[np.ndarray, np.ndarray]:
        logits = self._model.prefix_logits(self._context, self._codes, self._quantizer)
        log_p = log_softmax(logits.float().cpu().numpy())
        log_p[:, -2] = -np.inf  # the start token
        return np.broadcast_to(np.arange(log_p.shape[1]), log_p.shape), log_p
