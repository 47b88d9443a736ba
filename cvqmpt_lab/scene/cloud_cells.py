"""Large point clouds as cells of an octree: the same cells for the compiled checker and for coal."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.scene.shapes import PointCloud

MOST_BALLS = 1000
"""Clouds of more points are checked as cells, which are only roughly the balls around the points."""
MOST_CELLS_ACROSS = 60_000
"""Along an edge of what is left of a cloud; coal's octrees have room for 2^16."""


@dataclass(frozen=True, eq=False)
class CloudCells:
    """Cubes that hold the points of a cloud; the frame's origin lies among them."""

    centres: np.ndarray
    """(k, 3), different from each other [m]."""
    edge: float
    """Of each cube [m]: the diameter of the cloud's balls, or more where that would take too many cubes."""
    T_parent_cells: np.ndarray
    """(4, 4), pose of the cells' frame in the parent's, the world or the hand [m]."""


def cloud_cells(cloud: PointCloud, T_parent_cloud: np.ndarray, reach: float = np.inf) -> CloudCells | None:
    """Cells of the points within reach [m] of the parent's origin; None when there are none.

    Points out of reach would only cost range: an octree silently drops what lies beyond its own.
    """
    far = np.linalg.norm(cloud.points @ T_parent_cloud[:3, :3].T + T_parent_cloud[:3, 3], axis=1)
    points = cloud.points[far <= reach + cloud.radius]
    if len(points) == 0:
        return None
    edge = max(2.0 * cloud.radius, float(np.ptp(points, axis=0).max()) / MOST_CELLS_ACROSS)
    index = np.floor(points * (1.0 / edge))
    first = index.min(axis=0)
    index = (index - first).astype(np.int64)
    across = index.max(axis=0) + 1
    keys = np.unique((index[:, 0] * across[1] + index[:, 1]) * across[2] + index[:, 2])
    cells = np.stack(
        [keys // (across[1] * across[2]), keys // across[2] % across[1], keys % across[2]], axis=1
    )
    middle = across // 2
    T_parent_cells = T_parent_cloud.copy()
    T_parent_cells[:3, 3] += T_parent_cloud[:3, :3] @ ((first + middle) * edge)
    return CloudCells((cells - middle + 0.5) * edge, edge, T_parent_cells)
