"""Which places a measured body hides from the cameras of a scan."""

from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.scene.cloud_files import Cloud


def in_shadow(
    places: FloatArray, captures: Sequence[Cloud], edge: float, nearest: int = 4
) -> np.ndarray:
    """Return a mask (k,) of cells that lie behind a measured point, as some camera sees them.

    A point hides a cell if it is nearer to the camera, and its direction is at most
    sqrt(3) / 2 edge / r from that of the cell's centre, for the cell's distance r.

    Args:
        places: centres (k, 3) of cells [m, robot base frame].
        captures: points with the poses of their cameras.
        edge: of the cells [m].
        nearest: how many of the points with the nearest directions are compared.
    """
    from scipy.spatial import cKDTree  # takes 0.3 s to import

    hidden = np.zeros(len(places), dtype=bool)
    for capture in captures:
        eye = capture.T_world_camera[:3, 3]
        ray = places - eye
        r = np.maximum(np.linalg.norm(ray, axis=1), 0.5 * edge)
        width = 0.5 * np.sqrt(3.0) * edge / r
        directions, distances = _thinned(capture.in_world - eye, 0.5 * width.min(initial=1.0))
        if len(distances) == 0:
            continue
        tree, distances = cKDTree(directions), np.append(distances, np.inf)  # inf: of no point
        # a small bound makes searches fast: cells of similar distance have the same
        octaves = np.floor(np.log2(width))
        for octave in np.unique(octaves):
            group = np.flatnonzero((octaves == octave) & ~hidden)
            spans, points = tree.query(
                ray[group] / r[group, None],
                k=[*range(1, nearest + 1)],
                distance_upper_bound=width[group].max(initial=0.0),
            )
            within = spans <= width[group, None]
            hidden[group] = np.where(within, distances[points], np.inf).min(axis=1) < r[group]
    return hidden


def _thinned(sight: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Return directions (m, 3) about `width` [rad] apart, and the least distances (m,) there [m].

    sight: points (p, 3) in a frame with the camera at its origin [m].
    """
    distances = np.linalg.norm(sight, axis=1)
    sight, distances = sight[distances > 0.0], distances[distances > 0.0]
    order = np.argsort(distances, kind="stable")
    directions, distances = sight[order] / distances[order, None], distances[order]
    across = int(np.ceil(2.0 / max(width, 1e-6))) + 1
    x, y, z = np.floor((directions.T + 1.0) / max(width, 1e-6)).astype(np.int64)
    # the first of a direction is the nearest
    _, first = np.unique((x * across + y) * across + z, return_index=True)
    return directions[first], distances[first]
