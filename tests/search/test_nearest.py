"""The index of growing trees returns the node of a plain search, the first among equals."""

import numpy as np
import pytest
from compiled_kernels import from_python

from cvqmpt_lab.search.nearest import (
    BLOCK,
    LEAF,
    enlarged_index,
    index_new_nodes,
    nearest_index,
    nearest_node,
)

index_new_nodes, nearest_node = map(from_python, (index_new_nodes, nearest_node))


def walks(rng, count, n=7):
    """Nodes like those of trees: short walks from earlier nodes."""
    nodes = np.zeros((count, n))
    for k in range(1, count):
        origin = nodes[k - 1] if k % 7 else nodes[rng.integers(k)]
        nodes[k] = origin + 0.15 * rng.standard_normal(n)
    return nodes


def queries(rng, nodes, count):
    """Near the nodes, between them, and far away."""
    picks = nodes[rng.integers(len(nodes), size=(count, 2))]
    spread = 10.0 ** rng.uniform(-4.0, 0.7, (count, 1))
    # never half way, where two nodes are equally far but for rounding
    share = rng.uniform(size=(count, 1))
    between = picks[:, 0] + share * (picks[:, 1] - picks[:, 0])
    return np.concatenate([picks[:, 0] + spread * rng.standard_normal(between.shape), between])


@pytest.mark.parametrize("count", [1, BLOCK - 1, BLOCK, BLOCK + 1, 5 * BLOCK + 77, 16 * BLOCK])
def test_the_nearest_node_is_that_of_a_plain_search(count):
    """Also after the index has grown."""
    rng = np.random.default_rng(count)
    nodes, index = walks(rng, count), nearest_index(2 * BLOCK, 7)
    for size in (*range(0, count, 128), count):
        if size > index.order.shape[1]:
            index = enlarged_index(index, 2 * index.order.shape[1])
        index_new_nodes(index, 1, nodes, size)
    assert index.indexed.tolist() == [0, count // BLOCK * BLOCK]
    for target in queries(rng, nodes, 150):
        expected = int(((nodes - target) ** 2).sum(axis=1).argmin())
        assert nearest_node(index, 1, nodes, count, target) == expected


def test_of_equal_nodes_the_first_one_is_found():
    nodes = np.tile(walks(np.random.default_rng(1), 3 * LEAF), (100, 1))
    index = nearest_index(len(nodes), 7)
    index_new_nodes(index, 0, nodes, len(nodes))
    for k in (0, 7, 3 * LEAF - 1):
        assert nearest_node(index, 0, nodes, len(nodes), nodes[k]) == k


def test_nodes_moved_away_later_are_never_found():
    """A removed node is moved far away; the index is not told."""
    rng = np.random.default_rng(2)
    nodes, index = walks(rng, 3 * BLOCK), nearest_index(3 * BLOCK, 7)
    index_new_nodes(index, 0, nodes, len(nodes))
    gone = rng.choice(len(nodes), 1000, replace=False)
    nodes[gone, 0] = 1e6
    for target in queries(rng, nodes[:50], 50):
        found = nearest_node(index, 0, nodes, len(nodes), np.clip(target, -5.0, 5.0))
        assert found == int(((nodes - np.clip(target, -5.0, 5.0)) ** 2).sum(axis=1).argmin())
