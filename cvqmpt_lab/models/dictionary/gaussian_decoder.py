"""Stage 1, second half: from a quantized latent to a Gaussian over normalised configurations."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.models.published.attention import FeedForward


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A batch of Gaussians with covariance L D L^T (published code; the paper prints L D^2 L^T)."""

    mean: Tensor
    """(..., n), normalised joints."""
    lower: Tensor
    """(..., n, n), L, ones on the diagonal."""
    diagonal: Tensor
    """(..., n), D, positive."""

    @property
    def covariance(self) -> Tensor:
        """L D L^T (..., n, n)."""
        return (self.lower * self.diagonal[..., None, :]) @ self.lower.mT

    def log_prob(self, u: Tensor) -> Tensor:
        """Log density (...) at normalised joints u (..., n) [nats]."""
        offset = (u - self.mean)[..., None]
        whitened = torch.linalg.solve_triangular(
            self.lower.expand(*offset.shape[:-2], *self.lower.shape[-2:]),
            offset,
            upper=False,
            unitriangular=True,
        )
        mahalanobis = (whitened[..., 0].square() / self.diagonal).sum(-1)
        n = self.mean.shape[-1]
        return -0.5 * (mahalanobis + self.diagonal.log().sum(-1) + n * math.log(2.0 * math.pi))

    def entropy(self) -> Tensor:
        """Differential entropy (...) [nats]."""
        n = self.mean.shape[-1]
        return 0.5 * (self.diagonal.log().sum(-1) + n * (1.0 + math.log(2.0 * math.pi)))


class GaussianDecoder(nn.Module):
    """Feed-forward block (normalised at its end), then three linear heads: mean, D and L."""

    l_index: Tensor

    def __init__(self, d_model: int, d_inner: int, joint_dim: int, dropout: float) -> None:
        super().__init__()
        self.pos_ffn = FeedForward(d_model, d_inner, dropout, norm_first=False)
        self.mu = nn.Sequential(nn.Linear(d_model, joint_dim), nn.Tanh())
        self.diag = nn.Sequential(nn.Linear(d_model, joint_dim))
        self.l = nn.Sequential(nn.Linear(d_model, joint_dim * (joint_dim - 1) // 2))
        self.register_buffer("l_index", torch.tril_indices(joint_dim, joint_dim, offset=-1))

    def forward(self, latent: Tensor) -> Gaussians:
        """Decode latents (..., d_model): mean in (0, 1), D = softplus, L's strict lower triangle linear."""
        hidden = self.pos_ffn(latent)
        mean = 0.5 * (self.mu(hidden) + 1.0)
        n = mean.shape[-1]
        identity = torch.eye(n, dtype=mean.dtype, device=mean.device).expand(*mean.shape, n)
        lower = identity.flatten(-2).index_copy(-1, self.l_index[0] * n + self.l_index[1], self.l(hidden))
        return Gaussians(mean, lower.unflatten(-1, (n, n)), F.softplus(self.diag(hidden)))
