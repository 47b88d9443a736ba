"""Published stage 2, first half: start and goal look at the scene."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.models.config import EPSILON, PointCloudConfig, TransformerConfig
from cvqmpt_lab.models.point_cloud.encoder import PointCloudEncoder
from cvqmpt_lab.models.published.attention import CrossAttentionLayer


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
