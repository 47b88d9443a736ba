"""Whether points span a volume that collision code can work with."""

import numpy as np
import numpy.typing as npt

from cvqmpt_lab.errors import InvalidInputError

MIN_THICKNESS = 1e-4  # [m] below which hulls are not built: their faces would be noise
FARTHEST = 1e4  # [m] that a corner may be from its frame


def thickness(points: npt.NDArray[np.float64]) -> float:
    """Extent [m] of points (n, 3) in the direction in which they extend least."""
    return float(np.ptp(points @ thin_direction(points)))


def thin_direction(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Direction (3,) in which points (n, 3) extend least; a normal of their plane if they have one."""
    centred = points - points.mean(axis=0)
    return np.linalg.eigh(centred.T @ centred)[1][:, 0]


def check_volume(points: npt.NDArray[np.float64], what: str) -> None:
    """Refuse finite points (n, 3) [m] that span no volume, or one too thin or too far for collision checks.

    Raises
    ------
    InvalidInputError: says which, after `what`.
    """
    farthest = float(np.abs(points).max(initial=0.0))
    if farthest > FARTHEST:
        raise InvalidInputError(
            f"{what} must lie within {FARTHEST:g} m of their frame, one is {farthest:.3g} m off: give metres"
        )
    if len(points) < 4 or thickness(points) < MIN_THICKNESS:
        raise InvalidInputError(
            f"{what} must span a volume: give 4 or more points that are not in one plane, and at least "
            f"{1e3 * MIN_THICKNESS:g} mm thick, got {len(points)} points"
        )
