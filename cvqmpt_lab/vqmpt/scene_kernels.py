"""Compiled parts of the scene transformer at planning time: groups, attention reads, path costs."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.jit import entry, kernel
from cvqmpt_lab.search.lazy_roadmap import drop_smallest, push

HEAP_ENTRIES = 40  # of `shortest_paths`, a node


@entry
def fill_groups(
    points: Annotated[np.ndarray, "float32 3 p"],
    centres: Annotated[np.ndarray, "float32 groups 3"],
    offsets: Annotated[np.ndarray, "float32 groups size 3"],
    away: Annotated[np.ndarray, "float32 p"],
    near: Annotated[np.ndarray, "float32 p"],
    chosen: Annotated[np.ndarray, "int64 size"],
):
    """Groups of points as of `scene_arrays.group_points`. away, near, chosen: work arrays."""
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
        # the first points are a guess; nearer ones replace the farthest of them
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


@entry
def gather_reads(
    read: Annotated[np.ndarray, "float32 k u columns"],
    points: Annotated[np.ndarray, "float32 u k 3"],
    mixed: Annotated[np.ndarray, "float32 u numbers"],
):
    """What body points read: sum_j w_j (v_j + V_j p), m values, and the tokens' distance.

    The distance is 5 sqrt(sum_j w_j |p - c_j|^2 + 1e-4).

    Args:
        read: sums over tokens with unnormalised weights; the last column is their sum.
        points: p, body points [m].
        mixed: written, m + 1 numbers of each body point.
    """
    m = (read.shape[2] - 5) // 4
    for j in range(read.shape[0]):
        for i in range(read.shape[1]):
            x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            # the last column is the sum of the unnormalised weights
            share, begin = np.float32(1.0) / read[j, i, 4 * m + 4], j * (m + 1)
            for c in range(m):
                value = read[j, i, c] + read[j, i, m + c] * x
                value += read[j, i, 2 * m + c] * y + read[j, i, 3 * m + c] * z
                mixed[i, begin + c] = share * value
            away = read[j, i, 4 * m] + read[j, i, 4 * m + 1] * x
            away += read[j, i, 4 * m + 2] * y + read[j, i, 4 * m + 3] * z
            away = share * away + (x * x + y * y + z * z)
            mixed[i, begin + m] = np.float32(5.0) * np.sqrt(
                max(away, np.float32(0.0)) + np.float32(1e-4)
            )


@entry
def shortest_paths(
    first: Annotated[np.ndarray, "int32 inner"],
    neighbour: Annotated[np.ndarray, "int32 arcs"],
    arc_cost: Annotated[np.ndarray, "arcs"],
    cost: Annotated[np.ndarray, "ends nodes"],
    heap: Annotated[np.ndarray, "queue"],
    heap_node: Annotated[np.ndarray, "int32 queue"],
):
    """Cost of the shortest path between each end and every node, by Dijkstra's algorithm.

    Args:
        first: where each node's arcs begin.
        neighbour: where arcs lead.
        arc_cost: of arcs [rad].
        cost: given, that of the links from each end, inf for other nodes; lowered to that of paths.
        heap: work array.
        heap_node: work array.
    """
    for end in range(cost.shape[0]):
        known, size = cost[end], 0
        for i in range(cost.shape[1]):
            if known[i] < np.inf:
                push(heap, heap_node, size, known[i], i)
                size += 1
        while size > 0:
            least, here = heap[0], np.int64(heap_node[0])
            drop_smallest(heap, heap_node, size)
            size -= 1
            # an entry that a shorter path has made obsolete
            if least > known[here]:
                continue
            for arc in range(first[here], first[here + 1]):
                there = np.int64(neighbour[arc])
                more = least + arc_cost[arc]
                if more < known[there] and size < heap.shape[0]:
                    known[there] = more
                    push(heap, heap_node, size, more, there)
                    size += 1
