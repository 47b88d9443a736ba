"""PointNet++ set abstraction: a point cloud becomes scene tokens."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from cvqmpt_lab.models.config import PointCloudConfig, SetAbstractionConfig
from cvqmpt_lab.models.point_cloud.sampling import ball_query, farthest_point_sampling


@dataclass(frozen=True, eq=False)
class TokenLevel:
    """Tokens of one level."""

    features: Tensor
    """(b, m, d)."""
    centres: Tensor
    """(b, m, 3): the points they stand for [m]."""


class PointConvolution(nn.Module):
    """Perceptron over every edge [x_j, p_j - p_i], maximum over the edges of a centre.

    Each layer is linear, ReLU, batch norm, in this order; the statistics are taken over edges.
    """

    def __init__(self, input_dim: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.local_nn = nn.Sequential(
            *(
                nn.Sequential(nn.Linear(before, after), nn.ReLU(), nn.BatchNorm1d(after))
                for before, after in zip((input_dim + 3, *widths), widths, strict=False)
            )
        )

    def forward(self, features: Tensor, offsets: Tensor, centre: Tensor, n_centres: int) -> Tensor:
        """Reduce edges to centres.

        Parameters
        ----------
        features, offsets
            (e, d), (e, 3) [m]: of each edge's neighbour; offsets from the centre to it.
        centre
            (e,) int64, ascending: the centre each edge belongs to; every centre has at least one edge.

        Returns
        -------
        (n_centres, widths[-1]).
        """
        messages = self.local_nn(torch.cat((features, offsets), dim=-1))
        if messages.requires_grad:  # the same values, dearer, but with a far cheaper gradient
            lengths = torch.bincount(centre, minlength=n_centres)
            return torch.segment_reduce(messages, "max", lengths=lengths, axis=0, unsafe=True)
        index = centre[:, None].expand_as(messages)
        start = messages.new_zeros(n_centres, messages.shape[-1])
        return start.scatter_reduce(0, index, messages, "amax", include_self=False)


class SetAbstraction(nn.Module):
    """Farthest points as centres, the ball around each summarised by a point convolution."""

    def __init__(self, input_dim: int, config: SetAbstractionConfig) -> None:
        super().__init__()
        self.conv = PointConvolution(input_dim, config.widths)
        self.config = config

    def forward(self, level: TokenLevel) -> TokenLevel:
        """Abstract features (b, n, d) at n points to fewer centres."""
        points, features = level.centres, level.features
        chosen = farthest_point_sampling(points, math.ceil(self.config.ratio * points.shape[1]))
        centres = points.gather(1, chosen[..., None].expand(-1, -1, 3))
        batch, m = centres.shape[:2]
        edges = ball_query(points, centres, self.config.radius, self.config.max_neighbours)
        offsets = points.reshape(-1, 3)[edges.point] - centres.reshape(-1, 3)[edges.centre]
        neighbours = features.flatten(0, 1)[edges.point]
        pooled = self.conv(neighbours, offsets, edges.centre, batch * m)
        return TokenLevel(pooled.unflatten(0, (batch, m)), centres)


class PointCloudEncoder(nn.Module):
    """Two set abstractions on raw metric points; no further code of position is added."""

    def __init__(self, config: PointCloudConfig) -> None:
        super().__init__()
        self.sa1_module = SetAbstraction(3, config.sa1)
        self.sa2_module = SetAbstraction(config.sa1.widths[-1], config.sa2)

    def forward(self, points: Tensor) -> TokenLevel:
        """Encode clouds (b, n, 3) [m, robot base frame], checked by `require_point_cloud`."""
        return self.sa2_module(self.sa1_module(TokenLevel(points, points)))
