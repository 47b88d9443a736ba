"""Pre-norm attention and feed-forward blocks of both stages, as the published checkpoints have them."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.vqmpt.config import EPSILON, TransformerConfig


class MultiHeadAttention(nn.Module):
    """softmax(q k^T / sqrt(d_k)) v per head, projections without bias, plus the residual.

    One layer norm is applied to the query and to the context (keys and values) alike; the residual is the query
    before it.
    """

    def __init__(self, sizes: TransformerConfig) -> None:
        super().__init__()
        self.n_heads = sizes.n_heads
        self.w_qs = nn.Linear(sizes.d_model, sizes.n_heads * sizes.d_k, bias=False)
        self.w_ks = nn.Linear(sizes.d_model, sizes.n_heads * sizes.d_k, bias=False)
        self.w_vs = nn.Linear(sizes.d_model, sizes.n_heads * sizes.d_v, bias=False)
        self.fc = nn.Linear(sizes.n_heads * sizes.d_v, sizes.d_model, bias=False)
        self.layer_norm = nn.LayerNorm(sizes.d_model, eps=EPSILON)
        self.dropout = sizes.dropout

    def forward(self, query: Tensor, context: Tensor, visible: Tensor | None = None) -> Tensor:
        """Attend from query (b, t, d_model) to context (b, m, d_model), both before normalisation.

        context: the query itself in self-attention. visible (b, m) bool: context tokens that are no padding; None
        for all.
        """
        keys_of = self.layer_norm(context)
        queries_of = keys_of if query is context else self.layer_norm(query)
        q, k, v = (
            projection(tokens).unflatten(-1, (self.n_heads, -1)).transpose(1, 2)
            for projection, tokens in ((self.w_qs, queries_of), (self.w_ks, keys_of), (self.w_vs, keys_of))
        )
        mask = None if visible is None else visible[:, None, None, :]
        dropout = self.dropout if self.training else 0.0
        heads = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, dropout_p=dropout)
        heads = heads.transpose(1, 2).flatten(2)
        return query + F.dropout(self.fc(heads), self.dropout, self.training)


class FeedForward(nn.Module):
    """Two linear layers with a ReLU between and a residual; normalised before them, or after the sum."""

    def __init__(self, d_model: int, d_inner: int, dropout: float, *, norm_first: bool = True) -> None:
        super().__init__()
        self.w_1 = nn.Linear(d_model, d_inner)
        self.w_2 = nn.Linear(d_inner, d_model)
        self.layer_norm = nn.LayerNorm(d_model, eps=EPSILON)
        self.dropout = dropout
        self.norm_first = norm_first

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., d_model) to the same shape."""
        inner = self.w_1(self.layer_norm(x) if self.norm_first else x).relu()
        y = x + F.dropout(self.w_2(inner), self.dropout, self.training)
        return y if self.norm_first else self.layer_norm(y)


class SelfAttentionLayer(nn.Module):
    """Tokens attend to each other, then a feed-forward block."""

    def __init__(self, sizes: TransformerConfig) -> None:
        super().__init__()
        self.slf_attn = MultiHeadAttention(sizes)
        self.pos_ffn = FeedForward(sizes.d_model, sizes.d_inner, sizes.dropout)

    def forward(self, tokens: Tensor, visible: Tensor | None = None) -> Tensor:
        """Map tokens (b, t, d_model) to the same shape; `visible` (b, t) as in `MultiHeadAttention`."""
        return self.pos_ffn(self.slf_attn(tokens, tokens, visible))


class CrossAttentionLayer(nn.Module):
    """Queries attend to a context, not to each other, then a feed-forward block."""

    def __init__(self, sizes: TransformerConfig) -> None:
        super().__init__()
        self.enc_attn = MultiHeadAttention(sizes)
        self.pos_ffn = FeedForward(sizes.d_model, sizes.d_inner, sizes.dropout)

    def forward(self, query: Tensor, context: Tensor, visible: Tensor | None = None) -> Tensor:
        """Map query (b, t, d_model), given context (b, m, d_model), to the query's shape."""
        return self.pos_ffn(self.enc_attn(query, context, visible))


def sinusoid_table(n_position: int, d_model: int) -> Tensor:
    """Positions as waves (n_position, d_model): sines on even, cosines on odd dimensions, base 10000."""
    dimension = torch.arange(d_model, dtype=torch.float64)
    wavelength = 10000.0 ** (2.0 * (dimension // 2) / d_model)
    angle = torch.arange(n_position, dtype=torch.float64)[:, None] / wavelength
    return torch.where(dimension % 2 == 0, angle.sin(), angle.cos()).float()
