"""MPNet, a baseline: a network encodes the cloud, another proposes the next configuration.

q_(t+1) = g(q_t, q_goal, z), z = e(cloud), both perceptrons with PReLU.
"""

import torch
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.config import MPNetConfig


class MPNet(nn.Module):
    """Cloud encoder and planner; configurations are normalised to [-1, 1], unlike in VQ-MPT."""

    def __init__(self, config: MPNetConfig) -> None:
        super().__init__()
        self.config = config
        encoder: list[nn.Module] = []
        widths = (3 * config.n_points, *config.encoder_widths)
        for before, after in zip(widths, config.encoder_widths, strict=False):
            encoder += [nn.Linear(before, after), nn.PReLU()]
        self.encoder = nn.Sequential(*encoder, nn.Linear(widths[-1], config.code_dim))
        widths = (config.code_dim + 2 * config.joint_dim, *config.planner_widths)
        self.hidden = nn.ModuleList(
            nn.Sequential(nn.Linear(before, after), nn.PReLU())
            for before, after in zip(widths, config.planner_widths, strict=False)
        )
        self.out = nn.Linear(widths[-1], config.joint_dim)

    def encode(self, points: Tensor) -> Tensor:
        """Codes (b, code_dim) of clouds (b, n_points, 3) [m], points in any order."""
        if points.shape[1:] != (self.config.n_points, 3):
            raise InvalidInputError(
                f"clouds are {tuple(points.shape[1:])}; this network takes "
                f"({self.config.n_points}, 3)"
            )
        return self.encoder(points.flatten(1))

    def forward(
        self, current: Tensor, goal: Tensor, code: Tensor, *, stochastic: bool = True
    ) -> Tensor:
        """Propose the next configuration; planning computes the same in numpy, `mpnet_rollouts`.

        Args:
            current: (b, joint_dim) q_t, normalised to [-1, 1].
            goal: (b, joint_dim), likewise.
            code: (b, code_dim) z, of `encode`.
            stochastic: with dropout, as in training.

        Returns:
            (b, joint_dim), not clipped.
        """
        x, share = torch.cat((code, current, goal), dim=-1), self.config.dropout
        for i, layer in enumerate(self.hidden):
            x = layer(x)
            if stochastic and share > 0.0 and i < len(self.hidden) - 1:
                kept = torch.rand(x.shape, device=x.device) >= share
                x = x * kept / (1.0 - share)
        return self.out(x)
