"""Feature extractor of stage 2: PointNet++ set abstraction, from a point cloud to scene tokens e_1
... e_n.

Two levels. Each takes farthest points as centres p_i and summarises the ball around each by the
maximum, over its points p_j with features x_j, of a perceptron of [x_j, p_j - p_i].
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.config import PointCloudConfig, SetAbstractionConfig

PAIRS_AT_ONCE = 1 << 17  # distances held at once: half a megabyte, so that they stay in the cache
CONSTANT = 1e-6  # variance of a feature below which it tells nothing of its cloud


@dataclass(frozen=True, eq=False)
class TokenLevel:
    """Tokens of one level."""

    features: Tensor  # (b, m, d)
    centres: Tensor  # (b, m, 3): the points they stand for [m]


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

    def forward(self, edges: Tensor, centre: Tensor, n_centres: int) -> Tensor:
        """Reduce edges (e, d + 3) to centres (n_centres, widths[-1]).

        centre (e,) int64, ascending: the centre each edge belongs to; every centre has at least one
        edge.
        """
        messages = self.local_nn(edges)
        if messages.requires_grad:  # the same values; slower, but with a far faster gradient
            lengths = torch.bincount(centre, minlength=n_centres)
            return torch.segment_reduce(messages, "max", lengths=lengths, axis=0, unsafe=True)
        index = centre[:, None].expand_as(messages)
        start = messages.new_zeros(n_centres, messages.shape[-1])
        return start.scatter_reduce(0, index, messages, "amax", include_self=False)


class SetAbstraction(nn.Module):
    """One level."""

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
        point, centre = ball_query(points, centres, self.config.radius, self.config.max_neighbours)
        offsets = points.reshape(-1, 3)[point] - centres.reshape(-1, 3)[centre]
        edges = torch.cat((features.flatten(0, 1)[point], offsets), dim=-1)
        return TokenLevel(self.conv(edges, centre, batch * m).unflatten(0, (batch, m)), centres)


class PointCloudEncoder(nn.Module):
    """Two set abstractions on raw metric points; no further code of position is added."""

    def __init__(self, config: PointCloudConfig) -> None:
        super().__init__()
        self.sa1_module = SetAbstraction(3, config.sa1)
        self.sa2_module = SetAbstraction(config.sa1.widths[-1], config.sa2)

    def forward(self, points: Tensor) -> TokenLevel:
        """Encode clouds (b, n, 3) [m, robot base frame], checked by `require_point_cloud`."""
        return self.sa2_module(self.sa1_module(TokenLevel(points, points)))

    def constant_features(self) -> float:
        """Share of token features that no cloud changes: their units never get through the ReLU."""
        variance = [
            part.running_var for part in self.modules() if isinstance(part, nn.BatchNorm1d)
        ][-1]
        assert variance is not None
        return float((variance < CONSTANT).float().mean())


def farthest_point_sampling(points: Tensor, count: int) -> Tensor:
    """Indices (b, count) of points (b, n, 3), each the farthest from those before it; the first is
    0.

    Ties go to the lowest index. InvalidInputError when count is not in 1..n.
    """
    n = points.shape[1]
    if not 1 <= count <= n:
        raise InvalidInputError(
            f"farthest point sampling of {count} from {n} points; give 1 to {n}"
        )
    if points.device.type == "cpu":
        each = [_farthest_of_one(cloud.detach().numpy(), count) for cloud in points]
        return torch.from_numpy(np.stack(each))
    return _farthest_of_batch(points.detach(), count)


def _farthest_of_one(points: np.ndarray, count: int) -> np.ndarray:
    """Farthest points (count,) of one cloud (n, 3); numpy calls cost a fifth of torch calls here."""
    axes = points.T.copy()
    indices = np.zeros(count, dtype=np.int64)
    nearest = np.full(len(points), np.inf, dtype=points.dtype)
    offsets, distance = np.empty_like(axes), np.empty_like(nearest)
    latest = 0
    for k in range(1, count):
        np.subtract(axes, axes[:, latest, None], out=offsets)
        np.multiply(offsets, offsets, out=offsets)
        np.add.reduce(offsets, axis=0, out=distance)
        np.minimum(nearest, distance, out=nearest)
        latest = int(nearest.argmax())
        indices[k] = latest
    return indices


def _farthest_of_batch(points: Tensor, count: int) -> Tensor:
    """Farthest points (b, count) of all clouds (b, n, 3) at once, for an accelerator."""
    rows = torch.arange(len(points), device=points.device)
    indices = torch.zeros(len(points), count, dtype=torch.int64, device=points.device)
    nearest = torch.full(points.shape[:2], torch.inf, dtype=points.dtype, device=points.device)
    for k in range(1, count):
        squares = (points - points[rows, indices[:, k - 1]][:, None]).square()
        nearest = torch.minimum(nearest, squares[..., 0] + squares[..., 1] + squares[..., 2])
        indices[:, k] = nearest.argmax(dim=1)
    return indices


def ball_query(
    points: Tensor, centres: Tensor, radius: float, max_neighbours: int
) -> tuple[Tensor, Tensor]:
    """Pairs (e,), (e,) int64 of a point of (b, n, 3) [m] and a centre of (b, m, 3) [m] closer than
    radius [m].

    Both are indices into the clouds laid end to end; centres ascend, and the points of one centre
    too. Of more than max_neighbours those of lowest index are taken. A centre that is one of the
    points is its own neighbour.
    """
    batch, n, m = len(points), points.shape[1], centres.shape[1]
    axes = points.mT.contiguous()
    near = torch.empty(batch, m, n, dtype=torch.bool, device=points.device)
    at_once = max(1, PAIRS_AT_ONCE // (batch * n))
    for first in range(0, m, at_once):
        block = centres[:, first : first + at_once, :, None]
        squares = (axes[:, None, 0] - block[:, :, 0]).square_()
        for axis in (1, 2):
            squares += (axes[:, None, axis] - block[:, :, axis]).square_()
        torch.lt(squares, radius * radius, out=near[:, first : first + at_once])
    row, point = _true_places(near.flatten(0, 1))
    sizes = torch.bincount(row, minlength=batch * m)
    rank = torch.arange(len(row), device=row.device) - (sizes.cumsum(0) - sizes)[row]
    first_ones = rank < max_neighbours
    row, point = row[first_ones], point[first_ones]
    return row // m * n + point, row


def _true_places(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and columns of what is true in mask (r, c), row by row; numpy is ten times faster at it."""
    if mask.device.type != "cpu":
        row, column = mask.nonzero(as_tuple=True)
        return row, column
    flat = torch.from_numpy(np.flatnonzero(mask.numpy()))
    return flat // mask.shape[1], flat % mask.shape[1]
