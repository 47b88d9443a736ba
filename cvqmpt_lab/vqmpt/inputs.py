"""What networks take in beside normalised joints: point clouds, and the kinematics of link-position features."""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from cvqmpt_lab.codec.forms import Array, FloatArray
from cvqmpt_lab.errors import InvalidInputError

LARGEST_EXTENT = 50.0  # of a cloud [m]; a larger one was almost surely given in millimetres


def require_point_cloud(points: Any) -> None:
    """Check a cloud (..., m, 3) [m], an array or a tensor.

    Raises InvalidInputError for fewer than two points, another shape, NaN, or an extent that cannot be metres.
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
    """A cloud (m, 3) [m, robot base frame] as contiguous float32; errors as of `require_point_cloud`."""
    try:
        points = np.asarray(cloud, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"point cloud must be numbers: {error}") from error
    if points.ndim != 2:
        raise InvalidInputError(f"point cloud of shape {points.shape}; it must be (n, 3) [m]")
    require_point_cloud(points)
    return np.ascontiguousarray(points, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class SerialChain:
    """Joints in a row, each turning about its own z axis or sliding along it, and points fixed to their links.

    frame_j = frame_(j-1) (rotation_j, translation_j) Rz(q_j), the first in the robot's base; for sliders Tz(q_j).
    """

    rotation: Annotated[FloatArray, Array((None, 3, 3))]  # (n, 3, 3), from one joint's frame to the next
    translation: Annotated[FloatArray, Array((None, 3), "[m]")]  # (n, 3) [m], likewise
    points: tuple[int, ...]  # (k,), the frame that each point moves with
    offsets: Annotated[FloatArray, Array((None, 3), "[m]")]  # (k, 3) [m], where in that frame
    sliders: tuple[int, ...] = ()  # the joints that slide

    def __post_init__(self) -> None:
        joints = len(self.rotation)
        if len(self.translation) != joints or not self.points or len(self.points) != len(self.offsets):
            raise InvalidInputError(
                f"rotation, translation, points and offsets describe {joints}, {len(self.translation)}, "
                f"{len(self.points)} and {len(self.offsets)}; give as many of each pair, and one point at least"
            )
        for name, listed in (("points", self.points), ("sliders", self.sliders)):
            if max(listed, default=0) >= joints:
                raise InvalidInputError(f"{name} are frames 0 to {joints - 1}, not {list(listed)}")

    @property
    def feature_dim(self) -> int:
        """Numbers that the points' positions are."""
        return 3 * len(self.points)

    @property
    def turns_about_base(self) -> bool:
        """The first joint's axis is the base's z axis, so that turning it turns the whole robot."""
        if 0 in self.sliders:
            return False
        on_axis = np.abs(self.translation[0, :2]).max() < 1e-6
        return bool(on_axis and np.allclose(self.rotation[0, :, 2], (0.0, 0.0, 1.0), atol=1e-6))
