"""Small networks beside the sequence: a Gaussian per step, P(free) of configurations and of motions."""

import torch
from torch import Tensor, nn

from cvqmpt_lab.models.config import TransformerConfig
from cvqmpt_lab.models.dictionary.gaussian_decoder import Gaussians, diagonal_gaussians
from cvqmpt_lab.models.point_cloud.encoder import TokenLevel
from cvqmpt_lab.models.published.attention import CrossAttentionLayer

INITIAL_LOG_STD = -2.5
"""Of a refined Gaussian before training: 8 % of each joint's range."""

_LAYERS = 2


class RefinementHead(nn.Module):
    """Moves the mean of a code's Gaussian and gives it a width, from the transformer's state."""

    def __init__(self, d_model: int, joint_dim: int) -> None:
        super().__init__()
        self.linear = nn.Linear(d_model, 2 * joint_dim)
        nn.init.zeros_(self.linear.weight)
        with torch.no_grad():
            self.linear.bias.copy_(torch.tensor([0.0, INITIAL_LOG_STD]).repeat_interleave(joint_dim))

    def forward(self, states: Tensor, means: Tensor) -> Gaussians:
        """Gaussians (...) from states (..., d_model) after each code and the codes' means (..., n)."""
        shift, log_std = self.linear(states).chunk(2, dim=-1)
        return diagonal_gaussians(means + shift, log_std)


def scene_features(level: TokenLevel) -> Tensor:
    """Token features with the coordinates of the points they stand for (s, m, d + 3)."""
    return torch.cat((level.features, level.centres), dim=-1)


class _SceneQueries(nn.Module):
    """Queries look at scene tokens and become one logit each."""

    def __init__(self, scene_dim: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.scene = nn.Linear(scene_dim + 3, sizes.d_model)
        self.layers = nn.ModuleList(CrossAttentionLayer(sizes) for _ in range(_LAYERS))
        self.out = nn.Sequential(nn.LayerNorm(sizes.d_model), nn.Linear(sizes.d_model, 1))

    def forward(self, queries: Tensor, level: TokenLevel) -> Tensor:
        scene = self.scene(scene_features(level))
        for layer in self.layers:
            queries = layer(queries, scene)
        return self.out(queries)[..., 0]


def _perceptron(input_dim: int, sizes: TransformerConfig) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(input_dim, sizes.d_inner), nn.ReLU(), nn.Linear(sizes.d_inner, sizes.d_model)
    )


class CollisionHead(nn.Module):
    """Logit of P(configuration free | scene)."""

    def __init__(self, configuration_dim: int, scene_dim: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.embed = _perceptron(configuration_dim, sizes)
        self.look = _SceneQueries(scene_dim, sizes)

    def forward(self, configurations: Tensor, level: TokenLevel) -> Tensor:
        """Logits (s, c) of configurations (s, c, configuration_dim) in s scenes."""
        return self.look(self.embed(configurations), level)


class ConnectivityHead(nn.Module):
    """Logit of P(straight motion between two configurations free | scene), the same both ways."""

    def __init__(self, configuration_dim: int, scene_dim: int, sizes: TransformerConfig) -> None:
        super().__init__()
        self.embed = _perceptron(2 * configuration_dim, sizes)
        self.look = _SceneQueries(scene_dim, sizes)

    def forward(self, first: Tensor, second: Tensor, level: TokenLevel) -> Tensor:
        """Logits (s, c) of motions between first and second (s, c, configuration_dim) in s scenes."""
        there, back = torch.cat((first, second), -1), torch.cat((second, first), -1)
        return self.look(self.embed(there) + self.embed(back), level)
