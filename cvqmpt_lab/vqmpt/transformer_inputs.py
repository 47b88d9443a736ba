"""Inputs of the scene transformer that training in torch and planning in numpy have in common."""

from typing import Any, NamedTuple

import numpy as np


def group_points(cloud: np.ndarray, groups: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Divide a cloud into groups of points, whose centres are found by farthest point sampling.

    Args:
        cloud: (m, 3) [m]; if it has too few points, they repeat.
        groups: number of groups.
        size: number of points of each group.

    Returns:
        Centres (groups, 3) [m], each the point farthest from those before it, and the nearest
        points of each centre (groups, size, 3) [m], relative to the centre.
    """
    points = np.asarray(cloud, dtype=np.float32)
    # argpartition below needs more points than a group has
    points = points[np.arange(max(len(points), size + 1)) % len(points)]
    chosen = np.zeros(groups, dtype=np.int64)
    to_chosen = ((points - points[0]) ** 2).sum(1)  # squared distance to the nearest centre
    for k in range(1, groups):
        chosen[k] = to_chosen.argmax()
        offset = points - points[chosen[k]]
        np.minimum(to_chosen, np.einsum("ij,ij->i", offset, offset), out=to_chosen)
    centres = points[chosen]
    squared = (centres**2).sum(1)[:, None] + (points**2).sum(1) - 2.0 * centres @ points.T
    nearest = np.argpartition(squared, size, axis=1)[:, :size]
    return centres, points[nearest] - centres[:, None]


def arcs_of(count: int, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the neighbours of each node of a roadmap: every edge is an arc in both directions.

    Args:
        count: number of nodes N.
        edges: (E, 2), rows of the nodes of each undirected edge; no edge joins a node to itself.

    Returns:
        Neighbours of each node (N, w) int32, padded with the node itself, and the edges to them
        (N, w) int32, padded with 0.
    """
    arcs = np.concatenate([edges, edges[:, ::-1]])
    order = np.lexsort((arcs[:, 1], arcs[:, 0]))
    start, end = arcs[order].T
    degree = np.bincount(start, minlength=count)
    column = np.arange(len(start)) - np.repeat(degree.cumsum() - degree, degree)
    neighbour = np.repeat(np.arange(count, dtype=np.int32)[:, None], degree.max(), axis=1)
    edge = np.zeros_like(neighbour)
    neighbour[start, column] = end
    edge[start, column] = order % len(edges)
    return neighbour, edge


class Ends(NamedTuple):
    """Embedded starts or goals: arrays (u, ...) of a scene, or tensors (s, u, ...) of s scenes."""

    embedding: Any  # (u, d)
    near: Any  # (u, l) int64, the codes nearest to each
    cost: Any  # (u, l) [rad], length - w log P(free) of the motion to each of these codes
