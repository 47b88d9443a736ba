"""What may be given as a point cloud, as an array or a tensor."""

import math
from typing import Any

import numpy as np

from cvqmpt_lab.errors import InvalidInputError

LARGEST_EXTENT = 50.0
"""Of a cloud [m]; a larger one was almost surely given in millimetres."""


def require_point_cloud(points: Any) -> None:
    """Check a cloud (..., n, 3) [m], an array or a tensor.

    Raises
    ------
    InvalidInputError
        When it has fewer than two points, a wrong shape, NaN or infinite values, or is so large that
        its unit cannot be metres.
    """
    if points.ndim < 2 or points.shape[-1] != 3:
        raise InvalidInputError(f"point cloud of shape {tuple(points.shape)}; it must be (n, 3) [m]")
    if points.shape[-2] < 2:
        raise InvalidInputError(f"point cloud of {points.shape[-2]} points; give at least 2")
    size = abs(points)
    largest = float(size.max())
    if not largest < math.inf:
        bad = int((~(size < math.inf)).any(-1).sum())
        raise InvalidInputError(f"point cloud has {bad} points with NaN or infinite values; drop them")
    if largest > LARGEST_EXTENT:
        raise InvalidInputError(
            f"point cloud reaches {largest:g} m; at most {LARGEST_EXTENT:g} m: give metres, not millimetres"
        )


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
