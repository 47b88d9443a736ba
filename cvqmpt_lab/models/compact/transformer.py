"""Causal transformer layer whose tokens also look at the scene."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.models.config import TransformerConfig


class CompactLayer(nn.Module):
    """Attention of each token to the scene, earlier tokens and itself, beside a feed-forward branch.

    Both branches read the same normalised token and are summed, so that a layer is two matrix products
    and one attention: fewer steps for a processor that spends its time between them. Scene tokens are the
    same in every layer and look at nothing. `compact.inference` computes the same for one more token at
    a time.
    """

    def __init__(self, sizes: TransformerConfig) -> None:
        super().__init__()
        width = sizes.n_heads * sizes.d_k
        self.n_heads, self.dropout = sizes.n_heads, sizes.dropout
        self.widths = [3 * width, sizes.d_inner]
        self.norm = nn.LayerNorm(sizes.d_model)
        self.project = nn.Linear(sizes.d_model, sum(self.widths))
        self.project_scene = nn.Linear(sizes.d_model, 2 * width)
        self.out = nn.Linear(width + sizes.d_inner, sizes.d_model)

    def scene_keys_values(self, scene: Tensor) -> Tensor:
        """Keys and values (s, 2, heads, m, d_k) of scene tokens (s, m, d_model), once per scene."""
        s, m, _ = scene.shape
        return self.project_scene(scene).view(s, m, 2, self.n_heads, -1).permute(0, 2, 3, 1, 4)

    def forward(self, tokens: Tensor, scene: Tensor) -> Tensor:
        """Map whole sequences.

        Parameters
        ----------
        tokens
            (b, t, d_model).
        scene
            (b, 2, heads, m, d_k), of `scene_keys_values`, repeated for every row.

        Returns
        -------
        Tokens (b, t, d_model).
        """
        t = tokens.shape[1]
        projected, hidden = self.project(self.norm(tokens)).split(self.widths, dim=-1)
        projected = projected.unflatten(-1, (3, self.n_heads, -1)).permute(0, 2, 3, 1, 4)
        known = torch.cat((scene, projected[:, 1:]), dim=3)
        visible = torch.ones(t, known.shape[3], dtype=torch.bool, device=tokens.device)
        heads = F.scaled_dot_product_attention(
            projected[:, 0], known[:, 0], known[:, 1], attn_mask=visible.tril(scene.shape[3])
        )
        branches = torch.cat((heads.transpose(1, 2).flatten(2), hidden.relu()), dim=-1)
        return tokens + F.dropout(self.out(branches), self.dropout, self.training)
