"""The nearest node of a growing tree, exactly, in sub-linear time.

Nodes are indexed in blocks of BLOCK by their number. Blocks are merged as in a binary counter: 13
blocks make balanced search trees over the first 8, the next 4 and the last one (Bentley and Saxe
1980, "Decomposable searching problems"). Nodes after the last block are compared one by one, so
small trees are searched without an index.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import kernel

BLOCK = 1024  # nodes
LEAF = 16  # nodes in a leaf; BLOCK is LEAF times a power of two


class NearestIndex(NamedTuple):
    """Balanced search trees over the nodes of two growing trees, and work arrays of a search."""

    # node numbers, sorted by leaves within each search tree
    order: Annotated[np.ndarray, "int32 2 capacity"]
    # lower and upper corner of the nodes below each inner node and leaf, heap by heap [rad or m]
    box: Annotated[np.ndarray, "2 boxes 2 n"]
    indexed: Annotated[np.ndarray, "int64 2"]  # nodes in the index, a multiple of BLOCK
    stack: Annotated[np.ndarray, "int64 levels"]  # boxes still to be searched
    bound: Annotated[np.ndarray, "levels"]  # squared distances of these


def nearest_index(capacity: int, n: int) -> NearestIndex:
    """An empty index for `capacity` nodes of n joints."""
    capacity = BLOCK * -(-capacity // BLOCK)
    return NearestIndex(
        np.zeros((2, capacity), dtype=np.int32),
        np.empty((2, 2 * capacity // LEAF, 2, n)),
        np.zeros(2, dtype=np.int64),
        np.zeros(64, dtype=np.int64),
        np.zeros(64),
    )


def enlarged_index(index: NearestIndex, capacity: int) -> NearestIndex:
    """The same index for `capacity` nodes."""
    larger = nearest_index(capacity, index.box.shape[3])
    larger.order[:, : index.order.shape[1]] = index.order
    larger.box[:, : index.box.shape[1]] = index.box
    larger.indexed[:] = index.indexed
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
    """Make a search tree over nodes first to first + count - 1; its boxes are box[1:]."""
    n = nodes.shape[1]
    for k in range(first, first + count):
        order[k] = k
    leaves = count // LEAF
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
    """Add the whole blocks among the first `size` nodes (capacity, n) of a tree to the index."""
    while index.indexed[tree] + BLOCK <= size:
        end = index.indexed[tree] // BLOCK + 1
        count = (end & -end) * BLOCK
        first = end * BLOCK - count
        _build(nodes, index.order[tree], index.box[tree, 2 * first // LEAF :], first, count)
        index.indexed[tree] = end * BLOCK


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
    """Squared distance of a box from target (n,), at most that of any node in it."""
    square = 0.0
    for j in range(target.shape[0]):
        outside = max(max(box[i, 0, j] - target[j], target[j] - box[i, 1, j]), 0.0)
        square += outside * outside
    # lowered, so that rounding never makes it too large
    return (1.0 - 1e-12) * square


@kernel
def _search(index, tree, nodes, target, first, count, best, nearest):
    """Improve the squared distance and the number of the nearest node by one search tree."""
    order, box = index.order[tree], index.box[tree, 2 * first // LEAF :]
    leaves, depth = count // LEAF, 1
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
        begin = first + (i - leaves) * LEAF
        for k in range(begin, begin + LEAF):
            square = _square(nodes, order[k], target)
            if square < best or (square == best and order[k] < nearest):
                best, nearest = square, np.int64(order[k])
    return best, nearest


@kernel
def nearest_node(index, tree, nodes, size, target):
    """The row argmin_i |nodes_i - target| among the first `size`; the first of equals."""
    best, nearest = np.inf, np.int64(0)
    for i in range(index.indexed[tree], size):
        square = _square(nodes, i, target)
        if square < best:
            best, nearest = square, np.int64(i)
    first, left = np.int64(0), index.indexed[tree]
    while left > 0:
        count = np.int64(BLOCK)
        while 2 * count <= left:
            count *= 2
        best, nearest = _search(index, tree, nodes, target, first, count, best, nearest)
        first += count
        left -= count
    return nearest
