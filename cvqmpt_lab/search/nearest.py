"""The nearest node of a growing tree, exactly, in sub-linear time.

Nodes are indexed in blocks of NODES_PER_BLOCK, in the order of their numbers. Blocks are merged as
in a binary counter: 13 blocks make three balanced search trees, over the first 8, the next 4 and
the last one (Bentley and Saxe 1980, "Decomposable searching problems"). Nodes after the last block
are compared one by one, so small trees are searched without an index.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import kernel

NODES_PER_BLOCK = 1024  # NODES_PER_LEAF times a power of two
NODES_PER_LEAF = 16


class NearestIndex(NamedTuple):
    """Balanced search trees over the nodes of two growing trees, and work arrays of a search."""

    # node numbers; nodes of a leaf are neighbours
    order: Annotated[np.ndarray, "int32 2 capacity"]
    # lower and upper corner of the nodes below each inner node and leaf, heap by heap [rad or m]
    box: Annotated[np.ndarray, "2 boxes 2 n"]
    indexed: Annotated[np.ndarray, "int64 2"]  # nodes in the index, a multiple of NODES_PER_BLOCK
    # coordinates of the nodes after the last block, joint by joint: processors compare four of them
    # at once [rad or m]
    recent: Annotated[np.ndarray, "2 n block"]
    copied: Annotated[np.ndarray, "int64 2"]  # nodes that are in the index or in `recent`
    square: Annotated[np.ndarray, "block"]  # work array: their squared distances [rad^2]
    stack: Annotated[np.ndarray, "int64 levels"]  # work array: boxes still to be searched
    bound: Annotated[np.ndarray, "levels"]  # work array: their squared distances [rad^2]


def nearest_index(capacity: int, n: int) -> NearestIndex:
    """Return an empty index for `capacity` nodes of n joints."""
    blocks = -(-capacity // NODES_PER_BLOCK)  # rounded up
    capacity = NODES_PER_BLOCK * blocks
    return NearestIndex(
        np.zeros((2, capacity), dtype=np.int32),
        np.empty((2, 2 * capacity // NODES_PER_LEAF, 2, n)),
        np.zeros(2, dtype=np.int64),
        np.empty((2, n, NODES_PER_BLOCK)),
        np.zeros(2, dtype=np.int64),
        np.empty(NODES_PER_BLOCK),
        np.zeros(64, dtype=np.int64),
        np.zeros(64),
    )


def enlarged_index(index: NearestIndex, capacity: int) -> NearestIndex:
    """Return a copy of the index with space for `capacity` nodes."""
    larger = nearest_index(capacity, index.box.shape[3])
    larger.order[:, : index.order.shape[1]] = index.order
    larger.box[:, : index.box.shape[1]] = index.box
    larger.indexed[:] = larger.copied[:] = index.indexed
    return larger


@kernel
def _split(nodes, order, first, last, axis):
    """Partition order[first:last] at its middle along an axis (quickselect)."""
    low, high, middle = first, last - 1, (first + last) // 2
    while low < high:
        pivot = nodes[order[(low + high) // 2], axis]
        i, j = low, high
        while i <= j:
            while nodes[order[i], axis] < pivot:
                i += 1
            while nodes[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                swap = order[i]
                order[i] = order[j]
                order[j] = swap
                i += 1
                j -= 1
        if j < middle:
            low = i
        if i > middle:
            high = j


@kernel
def _build(nodes, order, box, first, count):
    """Build a search tree over the nodes from `first` to `first + count - 1`.

    Args:
        nodes: configurations (capacity, n) [rad or m].
        order: node numbers (capacity,), written from `first` on.
        box: corners (2 count / NODES_PER_LEAF, 2, n), written from row 1 on.
        first: first node.
        count: number of nodes.
    """
    n = nodes.shape[1]
    for k in range(first, first + count):
        order[k] = k
    leaves = count // NODES_PER_LEAF
    for i in range(1, 2 * leaves):
        level = 1
        while 2 * level <= i:
            level *= 2
        length = count // level
        begin = first + (i - level) * length
        axis, widest = 0, -1.0
        for j in range(n):
            low = high = nodes[order[begin], j]
            for k in range(begin + 1, begin + length):
                low, high = min(low, nodes[order[k], j]), max(high, nodes[order[k], j])
            box[i, 0, j], box[i, 1, j] = low, high
            if high - low > widest:
                axis, widest = j, high - low
        if i < leaves:
            _split(nodes, order, begin, begin + length, axis)


@kernel
def index_new_nodes(index, tree, nodes, size):
    """Add all complete blocks of a tree's nodes to its index, and copy the nodes after them.

    Args:
        index: changed in place.
        tree: 0 or 1.
        nodes: configurations (capacity, n) [rad or m].
        size: number of nodes that the tree has.
    """
    while index.indexed[tree] + NODES_PER_BLOCK <= size:
        end = index.indexed[tree] // NODES_PER_BLOCK + 1
        # the lowest set bit of `end`: the blocks that merge into one search tree
        count = (end & -end) * NODES_PER_BLOCK
        first = end * NODES_PER_BLOCK - count
        box = index.box[tree, 2 * first // NODES_PER_LEAF :]
        _build(nodes, index.order[tree], box, first, count)
        index.indexed[tree] = index.copied[tree] = end * NODES_PER_BLOCK
    for i in range(index.copied[tree], size):
        for j in range(nodes.shape[1]):
            index.recent[tree, j, i - index.indexed[tree]] = nodes[i, j]
    index.copied[tree] = size


@kernel(inline="machine")
def _square(nodes, i, target):
    """Squared distance of row i from target (n,)."""
    square = 0.0
    for j in range(target.shape[0]):
        difference = nodes[i, j] - target[j]
        square += difference * difference
    return square


@kernel(inline="machine")
def _square_of_box(box, i, target):
    """Squared distance of a box from target (n,): a lower bound for the nodes in it."""
    square = 0.0
    for j in range(target.shape[0]):
        outside = max(max(box[i, 0, j] - target[j], target[j] - box[i, 1, j]), 0.0)
        square += outside * outside
    # rounding must not make the lower bound too large
    return (1.0 - 1e-12) * square


@kernel
def _search(index, tree, nodes, target, first, count, best, nearest):
    """Search one search tree for a node nearer than `nearest`.

    Args:
        index: of both trees' nodes.
        tree: 0 or 1.
        nodes: configurations (capacity, n) [rad or m].
        target: (n,) [rad or m].
        first: first node of the search tree.
        count: number of its nodes.
        best: squared distance of the nearest node so far [rad^2].
        nearest: number of the nearest node so far.

    Returns:
        Squared distance and number of the nearest node now.
    """
    order, box = index.order[tree], index.box[tree, 2 * first // NODES_PER_LEAF :]
    leaves, depth = count // NODES_PER_LEAF, 1
    index.stack[0], index.bound[0] = 1, _square_of_box(box, 1, target)
    while depth > 0:
        depth -= 1
        i = index.stack[depth]
        if index.bound[depth] > best:
            continue
        while i < leaves:  # down to the leaf on the nearer side
            left, right = _square_of_box(box, 2 * i, target), _square_of_box(box, 2 * i + 1, target)
            near, far, rest = (
                (2 * i, 2 * i + 1, right) if left <= right else (2 * i + 1, 2 * i, left)
            )
            if rest <= best:
                index.stack[depth], index.bound[depth] = far, rest
                depth += 1
            i = near
        begin = first + (i - leaves) * NODES_PER_LEAF
        for k in range(begin, begin + NODES_PER_LEAF):
            square = _square(nodes, order[k], target)
            if square < best or (square == best and order[k] < nearest):
                best, nearest = square, np.int64(order[k])
    return best, nearest


@kernel
def nearest_node(index, tree, nodes, size, target):
    """Return argmin_i |nodes_i - target|; of several nearest nodes, the one with the lowest number.

    Args:
        index: of both trees' nodes, after `index_new_nodes`.
        tree: 0 or 1.
        nodes: configurations (capacity, n) [rad or m].
        size: number of nodes that the tree has.
        target: (n,) [rad or m].
    """
    best, nearest = np.inf, np.int64(0)
    begin = index.indexed[tree]
    squares = index.square[: size - begin]
    for i in range(squares.shape[0]):
        squares[i] = 0.0
    for j in range(target.shape[0]):
        recent, value = index.recent[tree, j], target[j]
        for i in range(squares.shape[0]):
            squares[i] += (recent[i] - value) * (recent[i] - value)
    for i in range(squares.shape[0]):
        if squares[i] < best:
            best, nearest = squares[i], begin + i
    first, left = np.int64(0), index.indexed[tree]
    while left > 0:
        count = np.int64(NODES_PER_BLOCK)
        while 2 * count <= left:
            count *= 2
        best, nearest = _search(index, tree, nodes, target, first, count, best, nearest)
        first += count
        left -= count
    return nearest
