"""Groups of points, which the scene transformer makes its tokens of."""

import numpy as np

NOWHERE = (0.0, 0.0, -0.87)  # [m] where the points of an empty cloud lie


def group_points(cloud: np.ndarray, groups: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Groups of a cloud (m, 3) [m]: centres (groups, 3), far from each other, and the nearest
    points around each.

    The latter (groups, size, 3) are relative to their centre. A cloud of fewer points repeats them.
    """
    points = np.asarray(cloud, dtype=np.float32)
    points = points[np.arange(max(len(points), size + 1)) % len(points)]
    chosen, away = np.zeros(groups, dtype=np.int64), ((points - points[0]) ** 2).sum(1)
    for k in range(1, groups):
        chosen[k] = away.argmax()
        offset = points - points[chosen[k]]
        np.minimum(away, np.einsum("ij,ij->i", offset, offset), out=away)
    centres = points[chosen]
    squared = (centres**2).sum(1)[:, None] + (points**2).sum(1) - 2.0 * centres @ points.T
    nearest = np.argpartition(squared, size, axis=1)[:, :size]
    return centres, points[nearest] - centres[:, None]
