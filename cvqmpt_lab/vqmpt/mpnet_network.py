"""MPNet: one network encodes the cloud, another proposes the next configuration on the way to the goal."""

import torch
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.config import MPNetConfig
from cvqmpt_lab.vqmpt.inputs import require_point_cloud


class Dropout(nn.Module):
    """Dropout that can stay on after training, and can draw from a generator."""

    def __init__(self, probability: float) -> None:
        super().__init__()
        self.probability = probability

    def forward(self, x: Tensor, active: bool, generator: torch.Generator | None) -> Tensor:
        """Drop units of x and scale up the others, when active."""
        if not active or self.probability == 0.0:
            return x
        kept = torch.rand(x.shape, generator=generator, device=x.device) >= self.probability
        return x * kept / (1.0 - self.probability)


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
        self.dropout = Dropout(config.dropout)
        self.out = nn.Linear(widths[-1], config.joint_dim)

    def encode(self, points: Tensor) -> Tensor:
        """Codes (b, code_dim) of clouds (b, n_points, 3) [m], as `draw_points` gives them."""
        if points.shape[1:] != (self.config.n_points, 3):
            raise InvalidInputError(
                f"clouds are {tuple(points.shape[1:])}; this network takes ({self.config.n_points}, 3)"
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
        """Propose the next configuration (b, joint_dim), not clipped.

        Parameters
        ----------
        current, goal
            (b, joint_dim) in [-1, 1].
        code
            (b, code_dim), of `encode`.
        stochastic
            Dropout on, in training and, as in the published code, in planning.
        generator
            Source of the dropout, for runs that repeat.
        """
        x = torch.cat((code, current, goal), dim=-1)
        for i, layer in enumerate(self.hidden):
            x = layer(x)
            if i < len(self.hidden) - 1:
                x = self.dropout(x, stochastic, generator)
        return self.out(x)


def draw_points(cloud: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Draw points (count, 3) of a cloud (n, 3) without replacement; all of them again when they run out.

    Raises
    ------
    InvalidInputError
        For clouds that `require_point_cloud` refuses.
    """
    require_point_cloud(cloud)
    order = torch.randperm(len(cloud), generator=generator)
    return cloud[order[torch.arange(count) % len(cloud)].to(cloud.device)]
