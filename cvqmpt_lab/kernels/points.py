"""Point clouds for networks: far-apart points of a cloud, and the points around each."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.entry import entry


@entry
@kernel(allocates=True)
def neighbourhoods(points: Annotated[np.ndarray, "float32 m 3"], count, most, radius2):
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
    m = points.shape[0]
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    distance, nearest = np.empty(m, dtype=np.float32), np.full(m, np.inf, dtype=np.float32)
    chosen, near = np.zeros(count, dtype=np.int64), np.empty((count, most), dtype=np.int64)
    for k in range(count):
        i = chosen[k]
        cx, cy, cz = x[i], y[i], z[i]
        for j in range(m):
            dx, dy, dz = x[j] - cx, y[j] - cy, z[j] - cz
            distance[j] = dx * dx + dy * dy + dz * dz
        found = 0
        for j in range(m):
            if distance[j] < radius2:
                near[k, found] = j
                found += 1
                if found == most:
                    break
        near[k, found:] = near[k, 0]
        if k + 1 == count:
            break
        farthest, place = np.float32(-1.0), 0
        for j in range(m):
            nearest[j] = min(nearest[j], distance[j])
        for j in range(m):
            if nearest[j] > farthest:
                farthest, place = nearest[j], j
        chosen[k + 1] = place
    return chosen, near
