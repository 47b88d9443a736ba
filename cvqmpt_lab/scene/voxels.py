"""Voxel down-sampling: the mean of the points in each cell of a grid."""

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.errors import InvalidInputError

DENSE = 8
"""Grids of at most this many cells a point are counted cell by cell, which needs no sorting."""
MOST_CELLS = 2**62


def voxel_means(points: FloatArray, voxel: float) -> FloatArray:
    """Mean (m, 3) of the points (p, 3) in each cell of a grid, in order of the cells.

    The least coordinates lie in the middle of their cells.

    Raises
    ------
    InvalidInputError: a voxel [m] so small that its cells cannot be numbered.
    """
    if len(points) == 0:
        return points
    columns = np.ascontiguousarray(points.T)
    places = [(axis - axis.min()) / voxel + 0.5 for axis in columns]
    across = [np.floor(place.max()) + 1.0 for place in places]
    cells = float(np.prod(across))
    if not cells < MOST_CELLS:
        raise InvalidInputError(
            f"voxel of {voxel:g} m is too small for a cloud that is {np.ptp(points, axis=0).max():.3g} m long; "
            "give a larger one, or crop the cloud"
        )
    x, y, z = (place.astype(np.int64) for place in places)
    cell = (x * int(across[1]) + y) * int(across[2]) + z
    if cells <= DENSE * len(points):
        count = np.bincount(cell)
    else:
        _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    taken = count > 0
    sums = [np.bincount(cell, weights=axis)[taken] for axis in columns]
    return np.stack(sums, axis=1) / count[taken, None]
