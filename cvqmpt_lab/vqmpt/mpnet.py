"""MPNet, a baseline:
one network encodes the cloud, another proposes the next configuration on the way to the goal.
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
        self,
        current: Tensor,
        goal: Tensor,
        code: Tensor,
        *,
        stochastic: bool = True,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Propose the next configuration (b, joint_dim) from current towards goal (b, joint_dim),
        not clipped.

        code (b, code_dim): of `encode`. stochastic: with dropout, as in training; drawn from
        generator, for runs that repeat. Planning computes the same without torch, see
        `mpnet_rollouts`.
        """
        x = torch.cat((code, current, goal), dim=-1)
        for i, layer in enumerate(self.hidden):
            x = layer(x)
            if stochastic and i < len(self.hidden) - 1:
                x = dropout(x, self.config.dropout, generator)
        return self.out(x)


def dropout(x: Tensor, probability: float, generator: torch.Generator | None = None) -> Tensor:
    """Drop units of x and scale up the others; unlike torch's own, repeatable by a generator."""
    if probability == 0.0:
        return x
    left = torch.rand(x.shape, generator=generator, device=x.device) >= probability
    return x * left / (1.0 - probability)
