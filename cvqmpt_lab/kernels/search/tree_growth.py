"""Bidirectional constrained tree growth: the paper's Algorithm 3, on preallocated arrays.

Samples come in from outside in batches, so any distribution serves and no Python runs per state.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.jit import entry, kernel
from cvqmpt_lab.kernels.search.motion import DEVIATION, REACHED, STOPPED, distance, step_towards
from cvqmpt_lab.kernels.search.nearest import (
    NearestIndex,
    enlarged_index,
    index_new_nodes,
    nearest_index,
    nearest_node,
)
from cvqmpt_lab.kernels.search.space_arrays import ITERATIONS, Space

GROWING, CONNECTED, FULL = range(3)
REMOVED = 1e6  # [rad] where a removed node is put, so that it is never nearest


class Trees(NamedTuple):
    """Two trees; row 0 grows from the start, row 1 from the goals."""

    nodes: Annotated[np.ndarray, "2 capacity n"]
    """Configurations [rad or m]."""
    parent: Annotated[np.ndarray, "int64 2 capacity"]
    """-1 for roots."""
    size: Annotated[np.ndarray, "int64 2"]
    """Nodes in each."""
    meeting: Annotated[np.ndarray, "int64 2"]
    """The nodes that met when CONNECTED."""
    turn: Annotated[np.ndarray, "int64 1"]
    """Which tree extends first."""
    nearest: NearestIndex
    """For nearest nodes."""


def plant(start: np.ndarray, goals: np.ndarray, capacity: int) -> Trees:
    """Trees with a start (n,) and goals (k, n) as roots, and room for capacity nodes each, at least 4 k."""
    capacity = max(capacity, 4 * len(goals))
    trees = Trees(
        nodes=np.empty((2, capacity, len(start))),
        parent=np.full((2, capacity), -1, dtype=np.int64),
        size=np.array([1, len(goals)]),
        meeting=np.zeros(2, dtype=np.int64),
        turn=np.zeros(1, dtype=np.int64),
        nearest=nearest_index(capacity, len(start)),
    )
    trees.nodes[0, 0] = start
    trees.nodes[1, : len(goals)] = goals
    return trees


def enlarged(trees: Trees) -> Trees:
    """The same trees with twice the room."""
    nodes = np.concatenate([trees.nodes, np.empty_like(trees.nodes)], axis=1)
    parent = np.concatenate([trees.parent, np.full_like(trees.parent, -1)], axis=1)
    return trees._replace(nodes=nodes, parent=parent, nearest=enlarged_index(trees.nearest, nodes.shape[1]))


@kernel(inline="source")
def extend(space, nodes, parent, size, which, origin, target, reach):
    """ConstrainedExtend: walk from node origin towards target (n,), adding every state to the tree.

    reach: longest walk [rad].

    Returns
    -------
    Index of the last node, and whether the target was reached.
    """
    start = distance(nodes[origin], target)
    if start < 1e-9:
        return origin, True
    allowance = min(DEVIATION * start, reach)
    node = origin
    while True:
        new = size[which]
        outcome = step_towards(space, nodes[node], target, allowance, nodes[new])
        if outcome == STOPPED:
            return node, False
        parent[new] = node
        size[which] = new + 1
        allowance -= distance(nodes[node], nodes[new])
        node = new
        if outcome == REACHED:
            return node, True
        if new + 2 >= nodes.shape[0]:
            return node, False


@entry
def grow(
    space: Space,
    trees: Trees,
    samples: Annotated[np.ndarray, "count n"],
    first: int,
    extend_both: bool,
    reach: float,
):
    """Grow both trees towards samples[first:] (m, n) until they meet.

    extend_both: Algorithm 3 as printed, both trees walk to the sample and are then connected;
    otherwise the second tree walks from its nearest node to where the first one stopped (CBiRRT).
    reach: longest walk towards a sample [rad].

    Returns
    -------
    status: GROWING (samples used up), CONNECTED (trees.meeting holds the nodes), FULL (no room left).
    next: index of the next unused sample.
    """
    room = trees.nodes.shape[1] // 4
    nodes, parent, size = trees.nodes, trees.parent, trees.size
    for i in range(first, samples.shape[0]):
        if max(size[0], size[1]) + room >= nodes.shape[1]:
            return FULL, i
        space.counters[ITERATIONS] += 1
        a = trees.turn[0]
        b = 1 - a
        trees.turn[0] = b  # Swap
        node_a, node_b, met = 0, 0, False
        for stage in range(3):  # tree a to the sample, tree b to the sample, tree b to tree a: one call site
            if stage == 1 and not extend_both:
                continue
            tree = a if stage == 0 else b
            target = samples[i] if stage < 2 else nodes[a, node_a]
            if stage == 2 and extend_both:
                near = node_b
            else:
                index_new_nodes(trees.nearest, tree, nodes[tree], size[tree])
                near = nearest_node(trees.nearest, tree, nodes[tree], size[tree], target)
            limit = reach if stage < 2 else np.inf
            node, met = extend(space, nodes[tree], parent[tree], size, tree, near, target, limit)
            if stage == 0:
                node_a = node
            else:
                node_b = node
        if met:
            trees.meeting[a] = node_a
            trees.meeting[b] = node_b
            return CONNECTED, i + 1
    return GROWING, samples.shape[0]


@entry
def extract_path(
    trees: Trees, out: Annotated[np.ndarray, "room n"], origin: Annotated[np.ndarray, "int64 room 2"]
):
    """Write the states from start root to goal root into out (k, n), and their (tree, node) into origin (k, 2).

    Returns
    -------
    Number of states, or -1 when out is too short.
    """
    count, node = 0, trees.meeting[0]
    while node >= 0:
        if count == out.shape[0]:
            return -1
        origin[count, 0], origin[count, 1] = 0, node
        count += 1
        node = trees.parent[0, node]
    for i in range(count // 2):
        swap = origin[i, 1]
        origin[i, 1] = origin[count - 1 - i, 1]
        origin[count - 1 - i, 1] = swap
    node = trees.parent[1, trees.meeting[1]]  # the meeting state itself stands in both trees
    while node >= 0:
        if count == out.shape[0]:
            return -1
        origin[count, 0], origin[count, 1] = 1, node
        count += 1
        node = trees.parent[1, node]
    for i in range(count):
        for j in range(out.shape[1]):
            out[i, j] = trees.nodes[origin[i, 0], origin[i, 1], j]
    return count


@kernel
def remove_subtree(trees, which, root):
    """Take node root of one tree and all its descendants out of the search."""
    nodes, parent = trees.nodes[which], trees.parent[which]
    nodes[root, 0] = REMOVED
    for i in range(root + 1, trees.size[which]):
        if parent[i] >= 0 and nodes[parent[i], 0] == REMOVED:
            nodes[i, 0] = REMOVED


@entry
def remove_child_of_segment(trees: Trees, origin: Annotated[np.ndarray, "int64 room 2"], segment: int):
    """Cut the motion between path states segment and segment + 1; origin (k, 2) is extract_path's."""
    later_in_start_tree = origin[segment + 1, 0] == 0
    if later_in_start_tree:
        remove_subtree(trees, 0, origin[segment + 1, 1])
    elif origin[segment, 0] == 1:
        remove_subtree(trees, 1, origin[segment, 1])
    else:
        remove_subtree(trees, 1, trees.meeting[1])
