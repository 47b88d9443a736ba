"""The compact model's point cloud encoder in numpy: the mathematics of `models.point_cloud.encoder`."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.points import neighbourhoods
from cvqmpt_lab.models.config import PointCloudConfig, SetAbstractionConfig
from cvqmpt_lab.models.point_cloud.clouds import require_point_cloud
from cvqmpt_lab.models.stored import Tensors
from cvqmpt_lab.prediction.layers import TORCH_EPSILON, Affine


@dataclass(frozen=True, eq=False)
class TokenLevel:
    """Tokens of one level."""

    features: np.ndarray
    """(m, d)."""
    centres: np.ndarray
    """(m, 3): the points they stand for [m]."""

    @property
    def both(self) -> np.ndarray:
        """Features with their points' coordinates (m, d + 3)."""
        return np.concatenate((self.features, self.centres), axis=1)


@dataclass(frozen=True, eq=False)
class SceneTokens:
    """What the encoder makes of a cloud."""

    fine: TokenLevel
    """Many."""
    coarse: TokenLevel
    """Few, that summarise them."""


@dataclass(frozen=True, eq=False)
class SetAbstraction:
    """Farthest points as centres, the ball around each summarised by a perceptron and a maximum.

    The first layer sees [x_j, p_j - p_i] of neighbour j and centre i: it is applied to points and to centres, of
    which there are fewer than of pairs. Its batch norm is folded into the second layer; bias, ReLU and batch norm
    of that one grow or fall with what they are given, so they follow the maximum.
    """

    config: SetAbstractionConfig
    neighbour: Affine
    """Of [x_j, p_j]."""
    centre: np.ndarray
    """(3, width), what p_i takes away."""
    second: np.ndarray
    """(width, d), columns times `sign`."""
    sign: np.ndarray
    """(d,) of `scale`: the maximum over pairs is the minimum where the scale is negative."""
    bias: np.ndarray
    scale: np.ndarray
    shift: np.ndarray

    @classmethod
    def of(cls, tensors: Tensors, input_dim: int, config: SetAbstractionConfig) -> Self:
        """By the names of `PointConvolution`."""
        width, outer = config.widths
        tensors = tensors.under("conv.local_nn")
        first, second = tensors("0.0.weight", width, input_dim + 3), tensors("1.0.weight", outer, width)
        inner_scale, inner_shift = _batch_norm(tensors, "0.2", width)
        scale, shift = _batch_norm(tensors, "1.2", outer)
        sign = np.where(scale < 0.0, -1.0, 1.0)
        folded = Affine.folded(
            second * inner_scale * sign[:, None], tensors("1.0.bias", outer) + second @ inner_shift
        )
        return cls(
            config,
            Affine.folded(first, tensors("0.0.bias", width)),
            np.ascontiguousarray(first[:, input_dim:].T, dtype=np.float32),
            folded.weight,
            sign.astype(np.float32),
            folded.bias,
            scale.astype(np.float32),
            shift.astype(np.float32),
        )

    def __call__(self, level: TokenLevel) -> TokenLevel:
        """Abstract tokens to fewer."""
        config, points = self.config, level.centres
        share = config.count or math.ceil((config.ratio or 1.0) * len(points))
        chosen, near = neighbourhoods(
            points, min(share, len(points)), config.max_neighbours, np.float32(config.radius * config.radius)
        )
        centres = points[chosen]
        pairs = self.neighbour(level.both)[near]
        pairs -= (centres @ self.centre)[:, None]
        np.maximum(pairs, 0.0, out=pairs)
        pooled = (pairs.reshape(-1, pairs.shape[2]) @ self.second).reshape(*near.shape, -1).max(axis=1)
        pooled *= self.sign
        pooled += self.bias
        np.maximum(pooled, 0.0, out=pooled)
        pooled *= self.scale
        pooled += self.shift
        return TokenLevel(pooled, centres)


class PointCloudEncoder:
    """Two set abstractions on raw metric points."""

    def __init__(self, tensors: Tensors, config: PointCloudConfig) -> None:
        self._most = config.max_points
        self._fine = SetAbstraction.of(tensors.under("sa1_module"), 3, config.sa1)
        self._coarse = SetAbstraction.of(tensors.under("sa2_module"), config.sa1.widths[1], config.sa2)

    def __call__(self, points: np.ndarray) -> SceneTokens:
        """Encode a cloud (m, 3) of `checked_cloud`; a larger one than the model takes is thinned."""
        most = self._most
        if most is not None and len(points) > most:
            points = points[np.arange(most) * len(points) // most]
        fine = self._fine(TokenLevel(points, points))
        return SceneTokens(fine, self._coarse(fine))


def checked_cloud(cloud: np.ndarray) -> np.ndarray:
    """A cloud (m, 3) [m, robot base frame] as contiguous float32.

    Raises
    ------
    InvalidInputError
        For fewer than two points, another shape, NaN, or an extent that cannot be metres.
    """
    try:
        points = np.asarray(cloud, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"point cloud must be numbers: {error}") from error
    if points.ndim != 2:
        raise InvalidInputError(f"point cloud of shape {points.shape}; it must be (n, 3) [m]")
    require_point_cloud(points)
    return np.ascontiguousarray(points, dtype=np.float32)


def _batch_norm(tensors: Tensors, name: str, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Scale and shift (width,) of a batch norm with its running statistics."""
    variance, mean = tensors(f"{name}.running_var", width), tensors(f"{name}.running_mean", width)
    scale = tensors(f"{name}.weight", width) / np.sqrt(variance + TORCH_EPSILON)
    return scale, tensors(f"{name}.bias", width) - mean * scale
