"""`point_groups`, compiled: training works without this."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.jit import entry, kernel


def compiled_groups(points: np.ndarray, groups: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """As `point_groups.group_points`, of points (m, 3) float32."""
    points = points[np.arange(max(len(points), size + 1)) % len(points)]
    centres, offsets = np.empty((groups, 3), np.float32), np.empty((groups, size, 3), np.float32)
    away, near = np.empty((2, len(points)), np.float32)
    fill_groups(
        np.ascontiguousarray(points.T), centres, offsets, away, near, np.empty(size, np.int64)
    )
    return centres, offsets


@entry
def fill_groups(
    points: Annotated[np.ndarray, "float32 3 p"],
    centres: Annotated[np.ndarray, "float32 groups 3"],
    offsets: Annotated[np.ndarray, "float32 groups size 3"],
    away: Annotated[np.ndarray, "float32 p"],
    near: Annotated[np.ndarray, "float32 p"],
    chosen: Annotated[np.ndarray, "int64 size"],
):
    """Groups of points as of `point_groups.group_points`. away, near, chosen: work arrays."""
    count, size = points.shape[1], chosen.shape[0]
    for i in range(count):
        away[i] = np.float32(np.inf)
    centre = 0
    for g in range(centres.shape[0]):
        x, y, z = points[0, centre], points[1, centre], points[2, centre]
        centres[g, 0], centres[g, 1], centres[g, 2] = x, y, z
        for i in range(count):
            a, b, c = points[0, i] - x, points[1, i] - y, points[2, i] - z
            near[i] = a * a + b * b + c * c
            away[i] = near[i] if near[i] < away[i] else away[i]
        for i in range(size):
            chosen[i] = i
        worst = _farthest(near, chosen)
        for i in range(size, count):
            if near[i] < near[chosen[worst]]:
                chosen[worst] = i
                worst = _farthest(near, chosen)
        centre = 0
        for i in range(count):
            if away[i] > away[centre]:
                centre = i
        for k in range(size):
            for axis in range(3):
                offsets[g, k, axis] = points[axis, chosen[k]] - centres[g, axis]


@kernel
def _farthest(near, chosen):
    """Which of the chosen points is farthest."""
    worst = 0
    for k in range(1, chosen.shape[0]):
        if near[chosen[k]] > near[chosen[worst]]:
            worst = k
    return worst
