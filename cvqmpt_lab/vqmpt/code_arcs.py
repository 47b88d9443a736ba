"""The dictionary's roadmap as arcs, and the cheapest ways on it."""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.jit import entry
from cvqmpt_lab.search.lazy_roadmap import drop_smallest, push

QUEUE = 40  # entries of the queue a node
UNREACHED = 30.0  # [rad] cost to go where there is no way, as in `scene_transformer`


class Arcs(NamedTuple):
    """The roadmap's edges both ways."""

    first: np.ndarray  # (N + 1,) int32, where each node's arcs begin
    neighbour: np.ndarray  # (2 E,) int32, where they lead
    edge: np.ndarray  # (2 E,) int32
    table: np.ndarray  # (N, w) int32, neighbours of each node, padded with the node itself
    padding: np.ndarray  # (N, w) bool
    slot: np.ndarray  # (2 E,) int64, of each arc in the flattened table


def arcs_of(count: int, edges: np.ndarray) -> Arcs:
    """Arcs of edges (E, 2) between so many nodes."""
    both = np.concatenate([edges, edges[:, ::-1]])
    order = np.lexsort((both[:, 1], both[:, 0]))
    row, there = both[order].T
    first = np.searchsorted(row, np.arange(count + 1))
    column, width = np.arange(len(row)) - first[row], np.diff(first).max()
    table = np.repeat(np.arange(count, dtype=np.int32)[:, None], width, axis=1)
    padding = np.ones(table.shape, dtype=bool)
    table[row, column], padding[row, column] = there, False
    return Arcs(
        first.astype(np.int32),
        there.astype(np.int32),
        (order % len(edges)).astype(np.int32),
        table,
        padding,
        row * width + column,
    )


@entry
def cheapest_ways(
    first: Annotated[np.ndarray, "int32 inner"],
    neighbour: Annotated[np.ndarray, "int32 arcs"],
    arc_cost: Annotated[np.ndarray, "arcs"],
    cost: Annotated[np.ndarray, "ends nodes"],
    parent: Annotated[np.ndarray, "int32 ends nodes"],
    heap: Annotated[np.ndarray, "queue"],
    heap_node: Annotated[np.ndarray, "int32 queue"],
):
    """Lower the cost of each node to that of the cheapest way between it and each end, by
    Dijkstra's algorithm.

    cost: of nodes linked to an end that of the link, of others inf. parent: the node before each on
        that way, -1 where the way begins.
    """
    for end in range(cost.shape[0]):
        known, before, size = cost[end], parent[end], 0
        for i in range(cost.shape[1]):
            before[i] = -1
            if known[i] < np.inf:
                push(heap, heap_node, size, known[i], i)
                size += 1
        while size > 0:
            least, here = heap[0], np.int64(heap_node[0])
            drop_smallest(heap, heap_node, size)
            size -= 1
            if least > known[here]:
                continue
            for arc in range(first[here], first[here + 1]):
                there = np.int64(neighbour[arc])
                more = least + arc_cost[arc]
                if more < known[there] and size < heap.shape[0]:
                    known[there], before[there] = more, here
                    push(heap, heap_node, size, more, there)
                    size += 1
