"""Dijkstra's algorithm on a roadmap whose edges cost their length and what the doubt about them weighs."""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.jit import entry
from cvqmpt_lab.kernels.search.heap import drop_smallest, push
from cvqmpt_lab.kernels.search.motion import distance


class CodeGraph(NamedTuple):
    """N nodes, and arcs along the edges between them both ways."""

    nodes: Annotated[np.ndarray, "nodes n"]
    """[rad or m]."""
    factor: Annotated[np.ndarray, "nodes"]
    """>= 1, how much longer motions at a node count; inf: a node not to use."""
    first: Annotated[np.ndarray, "int32 inner"]
    """Where each node's arcs begin; one more entry than nodes."""
    neighbour: Annotated[np.ndarray, "int32 arcs"]
    """The node that an arc leads to."""
    edge: Annotated[np.ndarray, "int32 arcs"]
    """The edge that it belongs to."""
    doubt: Annotated[np.ndarray, "edges"]
    """-log P(free) of each edge."""
    weight: float
    """What -log P(free) costs [rad]."""
    heap: Annotated[np.ndarray, "queue"]
    """Costs in the queue."""
    heap_node: Annotated[np.ndarray, "int32 queue"]
    """Their nodes."""


@entry
def cheapest_ways(
    graph: CodeGraph, cost: Annotated[np.ndarray, "nodes"], parent: Annotated[np.ndarray, "int32 nodes"]
):
    """Lower the cost of each node to that of the cheapest way to it from any node that has a cost.

    parent: the node before each on that way, -1 where the way begins.
    """
    heap, heap_node, size = graph.heap, graph.heap_node, 0
    for i in range(cost.shape[0]):
        parent[i] = -1
        if cost[i] < np.inf:
            push(heap, heap_node, size, cost[i], i)
            size += 1
    while size > 0:
        known, here = heap[0], np.int64(heap_node[0])
        drop_smallest(heap, heap_node, size)
        size -= 1
        if known > cost[here]:
            continue
        for arc in range(graph.first[here], graph.first[here + 1]):
            there = np.int64(graph.neighbour[arc])
            factor = 0.5 * (graph.factor[here] + graph.factor[there])
            more = known + graph.weight * graph.doubt[graph.edge[arc]]
            more += factor * distance(graph.nodes[here], graph.nodes[there])
            if more < cost[there] and size < heap.shape[0]:
                cost[there], parent[there] = more, here
                push(heap, heap_node, size, more, there)
                size += 1
