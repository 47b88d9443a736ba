"""Point clouds for networks: far-apart points of a cloud, and the points around each."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.entry import entry


@entry
@kernel
def write_neighbourhoods(
    axes: Annotated[np.ndarray, "float32 3 m"],
    radius2: Annotated[np.ndarray, "float32 1"],
    distance: Annotated[np.ndarray, "float32 m"],
    nearest: Annotated[np.ndarray, "float32 m"],
    chosen: Annotated[np.ndarray, "int64 count"],
    near: Annotated[np.ndarray, "int64 count most"],
):
    """Write what `neighbourhoods` returns; axes: coordinates of points, distance and nearest: work arrays."""
    m, count, most = axes.shape[1], chosen.shape[0], near.shape[1]
    x, y, z = axes[0], axes[1], axes[2]
    for j in range(m):
        nearest[j] = np.inf
    chosen[0] = 0
    for k in range(count):
        i = chosen[k]
        cx, cy, cz = x[i], y[i], z[i]
        for j in range(m):
            dx, dy, dz = x[j] - cx, y[j] - cy, z[j] - cz
            distance[j] = dx * dx + dy * dy + dz * dz
        found = 0
        for j in range(m):
            if distance[j] < radius2[0]:
                near[k, found] = j
                found += 1
                if found == most:
                    break
        for j in range(found, most):
            near[k, j] = near[k, 0]
        if k + 1 == count:
            break
        farthest, place = np.float32(-1.0), 0
        for j in range(m):
            nearest[j] = min(nearest[j], distance[j])
        for j in range(m):
            if nearest[j] > farthest:
                farthest, place = nearest[j], j
        chosen[k + 1] = place


def neighbourhoods(
    points: np.ndarray, count: int, most: int, radius2: np.float32
) -> tuple[np.ndarray, np.ndarray]:
    """Choose points, each the farthest from those before it, and find the neighbours of each.

    Parameters
    ----------
    points: (m, 3) float32.
    count: how many are chosen, 1 to m; the first is point 0, ties go to the lowest index.
    most: neighbours of each at most; of more those of lowest index.
    radius2: squared distance below which a point is a neighbour, float32.

    Returns
    -------
    chosen (count,) int64, and neighbours (count, most) int64, filled up with the first of each.
    """
    m = len(points)
    chosen, near = np.empty(count, dtype=np.int64), np.empty((count, most), dtype=np.int64)
    work = np.empty(m, dtype=np.float32), np.empty(m, dtype=np.float32)
    write_neighbourhoods(np.ascontiguousarray(points.T), np.array([radius2]), *work, chosen, near)
    return chosen, near
