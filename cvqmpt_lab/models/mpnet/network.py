"""MPNet: one network encodes the cloud, another proposes the next configuration on the way to the goal."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from cvqmpt_lab.codec.plain import from_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.models.config import require_probability, require_sizes
from cvqmpt_lab.models.point_cloud.sampling import require_point_cloud
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.models.weights_folder import load_part, read_description


@dataclass(frozen=True, kw_only=True)
class MPNetConfig:
    """Sizes; defaults are those of the published 7-joint model."""

    joint_dim: int = 7
    n_points: int = 4120
    """Points of a cloud, drawn at random from what there is."""
    encoder_widths: tuple[int, ...] = (786, 512, 256)
    """Hidden layers of the cloud encoder."""
    code_dim: int = 60
    """Of an encoded cloud."""
    planner_widths: tuple[int, ...] = (1280, 896, 512, 384, 256, 128, 64, 32)
    """Hidden layers of the planner."""
    dropout: float = 0.5
    """Probability to drop a unit, after every hidden layer of the planner but the last."""

    def __post_init__(self) -> None:
        require_sizes(
            joint_dim=self.joint_dim,
            n_points=self.n_points,
            code_dim=self.code_dim,
            encoder_widths=self.encoder_widths,
            planner_widths=self.planner_widths,
        )
        require_probability("dropout", self.dropout)
        if not self.encoder_widths or not self.planner_widths:
            raise InvalidInputError("encoder_widths and planner_widths need a layer each")


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


@dataclass(frozen=True, eq=False)
class MPNetCheckpoint:
    """A trained MPNet and what it belongs to."""

    architecture: ClassVar[str] = "mpnet"

    robot: RobotSignature
    network: MPNet
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Json values: how it was trained."""

    @property
    def config(self) -> MPNetConfig:
        """Sizes of the network."""
        return self.network.config

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Modules by the name of their weights file."""
        return {"mpnet": self.network}


def load_mpnet(folder: Path, robot: RobotSignature | None = None) -> MPNetCheckpoint:
    """Read a folder of MPNet's weights; errors as in `checkpoint.load_checkpoint`."""
    description = read_description(folder, MPNetCheckpoint.architecture, robot)
    config = from_plain(MPNetConfig, description.model, "model", complete=True)
    network = load_part(folder, description, "mpnet", lambda: MPNet(config))
    return MPNetCheckpoint(description.robot, network, description.metadata)
