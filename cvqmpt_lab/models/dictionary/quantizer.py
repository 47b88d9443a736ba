"""The dictionary's codes: unit vectors, the nearest by cosine, learnt through a straight-through step."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cvqmpt_lab.errors import InvalidInputError


@dataclass(frozen=True, eq=False)
class Quantized:
    """Latents before and after quantization."""

    latent: Tensor
    """(..., d_model)."""
    quantized: Tensor
    """(..., d_model), of the nearest code."""
    codes: Tensor
    """(...) int64: which that is."""


class Quantizer(nn.Module):
    """Projects latents to few dimensions, replaces them by the nearest code, projects back.

    Every forward call scales the codes back to unit length, in place; after the last optimizer step call
    `normalise_codes` before saving. The batch norm is never applied; it is part of the published
    checkpoints' layout.
    """

    def __init__(self, n_codes: int, code_dim: int, d_model: int) -> None:
        super().__init__()
        self.input_linear_map = nn.Linear(d_model, code_dim)
        self.output_linear_map = nn.Linear(code_dim, d_model)
        self.embedding = nn.Embedding(n_codes, code_dim)
        nn.init.xavier_uniform_(self.embedding.weight)
        self.batch_norm = nn.BatchNorm1d(code_dim, affine=False)
        self.normalise_codes()

    @torch.no_grad()
    def normalise_codes(self) -> None:
        """Scale every code to unit length, in place."""
        self.embedding.weight.copy_(F.normalize(self.embedding.weight, dim=1))

    def project(self, latent: Tensor) -> Tensor:
        """Unit vectors (..., code_dim) that stand for latents (..., d_model)."""
        return F.normalize(self.input_linear_map(latent), dim=-1)

    def nearest(self, z: Tensor) -> Tensor:
        """Index (...) of the code with the largest cosine to each unit vector z (..., code_dim)."""
        with torch.no_grad():
            return (z @ self.embedding.weight.T).argmax(dim=-1)

    def forward(self, latent: Tensor) -> Quantized:
        """Quantize latents (..., d_model).

        The value passed on is e; its gradient reaches the encoder (as if z had been passed on) and the
        code e alike: z + e - stop_gradient(z).
        """
        self.normalise_codes()
        z = self.project(latent)
        codes = self.nearest(z)
        through = z + self.embedding(codes) - z.detach()
        return Quantized(latent, self.output_linear_map(through), codes)

    def lookup(self, codes: Tensor) -> Tensor:
        """Latents (..., d_model) of codes (...), ready for the decoder."""
        return self.output_linear_map(self.embedding(codes))

    def restart_codes(self, dead: Tensor, latents: Tensor, generator: torch.Generator | None = None) -> int:
        """Put codes onto encoded waypoints drawn at random; return how many were moved.

        Parameters
        ----------
        dead
            (n_codes,) bool: codes that no waypoint used lately; all of them to initialise from data.
        latents
            (m, d_model): encoded waypoints.
        generator
            Source of the draw (without replacement while `latents` last).

        Raises
        ------
        InvalidInputError
            When there are no latents to move to.
        """
        indices = dead.nonzero()[:, 0]
        if len(indices) == 0:
            return 0
        if len(latents) == 0:
            raise InvalidInputError("restart of codes from 0 latents; give at least one encoded waypoint")
        order = torch.randperm(len(latents), generator=generator)
        chosen = order[torch.arange(len(indices)) % len(latents)].to(latents.device)
        with torch.no_grad():
            self.embedding.weight[indices] = self.project(latents[chosen])
        return len(indices)
