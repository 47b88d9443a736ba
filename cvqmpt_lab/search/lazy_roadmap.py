"""Lazy shortest paths on a roadmap under a constraint.

A lazy probabilistic roadmap (Bohlin and Kavraki 2000): A* assumes that every node and edge is free
unless it is known to be blocked. The nodes of the path that A* returns are projected and checked,
then its edges, coarsely. Those that fail are blocked, and A* runs again. The caller makes the fine
check, blocks the edges that fail it, and keeps which edges passed. An edge from a to b that is not
yet checked costs

    (f(a) + f(b)) / 2 * |b - a| - w log P(free),    f(q) = 1 + penalty |F(q)|

P(free) is estimated from clearances along the edge (`edge_costs`). They are read one by one when
the edge comes out of the queue, until another edge is cheaper.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.heap import drop_smallest, push
from cvqmpt_lab.base.jit import entry, kernel, placed
from cvqmpt_lab.constraints.regions import residual
from cvqmpt_lab.robot.kinematics import forward_kinematics
from cvqmpt_lab.search.edge_costs import (
    CLEARANCE_MAX_M,
    CLEARANCE_MIN_M,
    EdgeCosts,
    negative_log,
    reading,
    readings,
)
from cvqmpt_lab.search.motion import (
    Space,
    distance,
    motion_between,
    project_state,
    state_valid,
)

# results of checks of nodes and edges; PROVEN_FREE: an edge that passed the fine check
UNCHECKED, BLOCKED, CHECKED_FREE, PROVEN_FREE = range(4)
NO_PATH = 0  # returned in place of a number of states


class RoadmapArrays(NamedTuple):
    """A roadmap, a query and work arrays.

    Rows of `nodes` are N nodes, the start and G goals. The first N + 1 rows have edges: to their
    neighbours (links) and to the goals; both together are the row's exits.
    """

    nodes: Annotated[np.ndarray, "rows n"]  # configurations, projected in place [rad or m]
    neighbours: Annotated[np.ndarray, "int32 inner links"]  # rows that edges lead to, or -1
    edge: Annotated[np.ndarray, "int8 inner links"]  # UNCHECKED, BLOCKED, CHECKED_ or PROVEN_FREE
    # the same for edges from each row to each goal; BLOCKED where there is no edge
    goal_edge: Annotated[np.ndarray, "int8 inner goals"]
    node: Annotated[np.ndarray, "int8 rows"]  # the same for nodes
    penalty: float  # f(q) = 1 + penalty * |F(q)|
    longest: float  # paths that cost as much or more are not searched for [rad]
    clearance: Annotated[np.ndarray, "rows"]  # of nodes [m]; inf: not yet read
    # smallest clearance read so far along each edge [m]
    lowest: Annotated[np.ndarray, "inner exits"]
    clearances_read: Annotated[np.ndarray, "int32 inner exits"]  # number of them
    # `_end_state` of each edge when they were read; 0: none was read
    end_state: Annotated[np.ndarray, "int8 inner exits"]
    factor: Annotated[np.ndarray, "rows"]  # f(q) >= 1 of each node; 0: not yet computed
    to_go: Annotated[np.ndarray, "rows"]  # estimated cost to the nearest goal [rad]
    cost: Annotated[np.ndarray, "rows"]  # from the start, in one search [rad]
    parent: Annotated[np.ndarray, "int32 rows"]  # row before each one on the cheapest path
    slot: Annotated[np.ndarray, "int32 rows"]  # exit of the parent that leads to each row
    closed: Annotated[np.ndarray, "int8 rows"]  # 1 for rows that were expanded
    heap: Annotated[np.ndarray, "queue"]  # keys in the queue [rad]
    heap_edge: Annotated[np.ndarray, "int32 queue"]  # their edges: row * exits + slot


@entry
def nearest_nodes(
    nodes: Annotated[np.ndarray, "rows n"],
    count: int,
    target: Annotated[np.ndarray, "n"],
    chosen: Annotated[np.ndarray, "int32 k"],
    squares: Annotated[np.ndarray, "k"],
):
    """Find the k nearest of the first `count` rows, nearest first.

    Args:
        nodes: configurations [rad or m].
        count: number of rows to search.
        target: (n,) [rad or m].
        chosen: written, rows of the k nearest.
        squares: written, their squared distances [rad^2].
    """
    k, found = chosen.shape[0], 0
    for i in range(count):
        square = 0.0
        for j in range(target.shape[0]):
            square += (nodes[i, j] - target[j]) * (nodes[i, j] - target[j])
        if found == k and square >= squares[k - 1]:
            continue
        place = found if found < k else k - 1
        while place > 0 and squares[place - 1] > square:
            squares[place], chosen[place] = squares[place - 1], chosen[place - 1]
            place -= 1
        squares[place], chosen[place] = square, i
        found = min(found + 1, k)


@entry
def link_query(
    roadmap: RoadmapArrays,
    chosen: Annotated[np.ndarray, "int32 links"],
    squares: Annotated[np.ndarray, "links"],
):
    """Add edges from the start and to the goals, to the nearest nodes.

    Args:
        roadmap: changed in place.
        chosen: work array; its length is the number of nodes to link to.
        squares: work array.
    """
    goals = roadmap.goal_edge.shape[1]
    count = roadmap.nodes.shape[0] - 1 - goals
    for i in range(roadmap.nodes.shape[0]):
        roadmap.to_go[i] = np.inf if i <= count else 0.0
        for g in range(goals if i <= count else 0):
            roadmap.to_go[i] = min(
                roadmap.to_go[i], distance(roadmap.nodes[i], roadmap.nodes[count + 1 + g])
            )
    nearest_nodes(roadmap.nodes, count, roadmap.nodes[count], chosen, squares)
    for slot in range(chosen.shape[0]):
        roadmap.neighbours[count, slot] = chosen[slot]
    for g in range(goals):
        for i in range(count):
            roadmap.goal_edge[i, g] = BLOCKED
        roadmap.goal_edge[count, g] = UNCHECKED
        nearest_nodes(roadmap.nodes, count, roadmap.nodes[count + 1 + g], chosen, squares)
        for slot in range(chosen.shape[0]):
            roadmap.goal_edge[chosen[slot], g] = UNCHECKED


@kernel(inline="machine")
def _end_state(roadmap, here, there):
    """Return 1 + the number of an edge's ends that are projected."""
    return 1 + (roadmap.node[here] == CHECKED_FREE) + (roadmap.node[there] == CHECKED_FREE)


@kernel(inline="source")
def _factor(space, roadmap, i):
    """Return the cost factor f = 1 + penalty |F(q)| of node i before its projection."""
    if roadmap.factor[i] == 0.0:
        scratch = space.scratch
        forward_kinematics(
            space.kinematics, roadmap.nodes[i], scratch.link_rotation, scratch.link_translation
        )
        square = residual(
            space.regions,
            roadmap.nodes[i],
            scratch.link_rotation,
            scratch.link_translation,
            scratch.residual,
            scratch.displacement,
        )
        roadmap.factor[i] = 1.0 + roadmap.penalty * np.sqrt(square)
    return roadmap.factor[i]


@kernel
def _read_node(space, roadmap, costs, i):
    """Read the clearance at node i unless it is known; a projection makes it unknown."""
    if roadmap.clearance[i] == np.inf:
        roadmap.clearance[i] = reading(
            space, costs, roadmap.nodes[i], roadmap.nodes[i], 0, CLEARANCE_MAX_M
        )


@kernel(inline="source")
def _read_edge(space, roadmap, costs, row, slot, there):
    """Read the next clearance along an edge.

    Args:
        space: the planning space.
        roadmap: changed in place.
        costs: of edges.
        row: the edge's first node.
        slot: its exit.
        there: the edge's last node.

    Returns:
        The increase of the edge's -log P(free).
    """
    before, k = roadmap.lowest[row, slot], roadmap.clearances_read[row, slot]
    lowest = before
    if k == 0:
        _read_node(space, roadmap, costs, there)
        lowest = min(before, roadmap.clearance[there])
    elif before > CLEARANCE_MIN_M:
        lowest = reading(space, costs, roadmap.nodes[row], roadmap.nodes[there], k, before)
    roadmap.lowest[row, slot] = lowest
    roadmap.clearances_read[row, slot] = k + 1
    return negative_log(costs, lowest) - negative_log(costs, before)


@kernel
def _astar(space, roadmap, costs):
    """Find the cheapest path; roadmap.parent and roadmap.slot hold it.

    Lazy weighted A* (Cohen, Phillips and Likhachev 2014): an edge enters the queue with the cost of
    its length and of the clearances read so far. When it comes out, more clearances are read until
    all are known or another edge is cheaper.

    Returns:
        Row of the goal at its end; -1: there is no path.
    """
    goals, k = roadmap.goal_edge.shape[1], roadmap.neighbours.shape[1]
    start, exits, size = roadmap.nodes.shape[0] - 1 - goals, k + goals, 0
    for i in range(roadmap.nodes.shape[0]):
        roadmap.cost[i], roadmap.parent[i], roadmap.closed[i] = np.inf, -1, 0
    here, roadmap.cost[start], roadmap.closed[start] = start, 0.0, 1
    while 0 <= here <= start:
        if costs.weight > 0.0:
            _read_node(space, roadmap, costs, here)
        for slot in range(exits):
            there = np.int64(roadmap.neighbours[here, slot]) if slot < k else start + 1 + slot - k
            verdict = roadmap.edge[here, slot] if slot < k else roadmap.goal_edge[here, slot - k]
            if (
                there < 0
                or verdict == BLOCKED
                or roadmap.node[there] == BLOCKED
                or roadmap.closed[there]
            ):
                continue
            length = distance(roadmap.nodes[here], roadmap.nodes[there])
            if roadmap.cost[here] + length >= roadmap.cost[there]:
                continue
            weight = 0.5 * (_factor(space, roadmap, here) + _factor(space, roadmap, there))
            cost = roadmap.cost[here] + weight * length
            final = verdict >= CHECKED_FREE or costs.weight == 0.0
            if not final:
                state = _end_state(roadmap, here, there)
                # an end was projected since the clearances were read
                if roadmap.end_state[here, slot] != state:
                    roadmap.end_state[here, slot] = state
                    roadmap.clearances_read[here, slot] = 0
                    roadmap.lowest[here, slot] = roadmap.clearance[here]
                lowest = min(roadmap.lowest[here, slot], roadmap.clearance[there])
                roadmap.lowest[here, slot] = lowest
                cost += costs.weight * negative_log(costs, lowest)
                final = roadmap.clearances_read[here, slot] >= readings(costs, length)
            hopeful = cost < roadmap.cost[there] and cost + roadmap.to_go[there] < roadmap.longest
            if hopeful and size < roadmap.heap.shape[0]:
                if final:
                    roadmap.cost[there] = cost
                push(
                    roadmap.heap,
                    roadmap.heap_edge,
                    size,
                    cost + roadmap.to_go[there],
                    here * exits + slot,
                )
                size += 1
        here = -1
        while size > 0 and here < 0:
            key, edge = roadmap.heap[0], np.int64(roadmap.heap_edge[0])
            drop_smallest(roadmap.heap, roadmap.heap_edge, size)
            size -= 1
            row, slot = edge // exits, edge % exits
            there = np.int64(roadmap.neighbours[row, slot]) if slot < k else start + 1 + slot - k
            if roadmap.closed[there]:
                continue
            verdict = roadmap.edge[row, slot] if slot < k else roadmap.goal_edge[row, slot - k]
            cost, left, cheapest = key - roadmap.to_go[there], 0, True
            if verdict < CHECKED_FREE and costs.weight > 0.0:
                left = readings(costs, distance(roadmap.nodes[row], roadmap.nodes[there]))
                left -= roadmap.clearances_read[row, slot]
            while cheapest and left > 0:
                left -= 1
                cost += costs.weight * _read_edge(space, roadmap, costs, row, slot, there)
                if cost >= roadmap.cost[there] or cost + roadmap.to_go[there] >= roadmap.longest:
                    cheapest = False
                    continue
                if left == 0:
                    roadmap.cost[there] = cost
                if size > 0 and roadmap.heap[0] < cost + roadmap.to_go[there]:
                    push(roadmap.heap, roadmap.heap_edge, size, cost + roadmap.to_go[there], edge)
                    size, cheapest = size + 1, False
            if cheapest:
                here, roadmap.cost[there], roadmap.closed[there] = there, cost, 1
                roadmap.parent[there], roadmap.slot[there] = row, slot
    return here


@kernel(inline="source")
def _node_free(space, roadmap, i, drift):
    """Whether node i is free after its projection by at most `drift` [rad]; checked only once."""
    if roadmap.node[i] == UNCHECKED:
        for j in range(roadmap.nodes.shape[1]):
            space.state[j] = roadmap.nodes[i, j]
        free = (
            project_state(space, roadmap.nodes[i])
            and distance(space.state, roadmap.nodes[i]) <= drift
        )
        roadmap.clearance[i] = np.inf
        free = free and state_valid(space, roadmap.nodes[i])
        roadmap.node[i] = CHECKED_FREE if free else BLOCKED
    return roadmap.node[i] == CHECKED_FREE


@kernel(inline="source")
def _verdict(roadmap, a, b):
    """Return the verdict on the edge from row a to row b that the last search used."""
    slot, k = np.int64(roadmap.slot[b]), roadmap.neighbours.shape[1]
    return roadmap.goal_edge[a, slot - k] if slot >= k else roadmap.edge[a, slot]


@kernel(inline="source")
def _store_verdict(roadmap, a, b, verdict):
    """Store the verdict on the edge from row a to row b that the last search used.

    Args:
        roadmap: changed in place; also the edge from b to a.
        a: row of the edge's first node.
        b: row of its last node.
        verdict: BLOCKED, CHECKED_FREE or PROVEN_FREE.
    """
    slot, k = np.int64(roadmap.slot[b]), roadmap.neighbours.shape[1]
    if slot >= k:
        roadmap.goal_edge[a, slot - k] = verdict
        return
    roadmap.edge[a, slot] = verdict
    for other in range(k):
        if roadmap.neighbours[b, other] == a:
            roadmap.edge[b, other] = verdict


@kernel(inline="source")
def _join_nodes(space, roadmap, path, length, ends, states, proven):
    """Check the edges of a path coarsely and write the states along them.

    Args:
        space: the planning space.
        roadmap: verdicts on the edges are stored.
        path: rows of the path's nodes from goal to start.
        length: number of these nodes.
        ends: written, number of states up to the end of each edge.
        states: written.
        proven: written, whether the motion after each state passed the fine check before.

    Returns:
        Number of states, or NO_PATH if an edge is blocked.
    """
    n, size = roadmap.nodes.shape[1], 1
    for j in range(n):
        states[0, j] = roadmap.nodes[path[length - 1], j]
    for i in range(length - 2, -1, -1):
        a, b = path[i + 1], path[i]
        # without a limit of the length: neighbours are near each other
        added = motion_between(space, roadmap.nodes[a], roadmap.nodes[b], np.inf, states[size:])
        if added == 0:
            _store_verdict(roadmap, a, b, BLOCKED)
            return NO_PATH
        was_proven = _verdict(roadmap, a, b) == PROVEN_FREE
        if not was_proven:
            _store_verdict(roadmap, a, b, CHECKED_FREE)
        for k in range(size - 1, size - 1 + added):
            proven[k] = was_proven
        size += added
        ends[i] = size
    return size


@entry
def search(
    space: Space,
    roadmap: RoadmapArrays,
    costs: EdgeCosts,
    most_searches: int,
    drift: float,
    path: Annotated[np.ndarray, "int64 longest"],
    ends: Annotated[np.ndarray, "int64 longest"],
    states: Annotated[np.ndarray, "room n"],
    proven: Annotated[np.ndarray, "bool room"],
):
    """Find the shortest path that passes the coarse checks; its motions are not checked finely.

    Args:
        space: the planning space.
        roadmap: roadmap and query.
        costs: of edges that are not checked yet.
        most_searches: upper bound of A* searches.
        drift: nodes that projection moves further than this are blocked [rad].
        path: written, rows of the path's nodes from goal to start.
        ends: written, number of states up to the end of each edge.
        states: written, states of the path [rad or m].
        proven: written, whether the motion after each state passed the fine check before.

    Returns:
        Number of states, or NO_PATH when there is no path, none within most_searches, or one with
        too many nodes; number of nodes on the last candidate path; number of searches.
    """
    space = placed(space)
    length = 0
    for searched in range(most_searches):
        row, length = _astar(space, roadmap, costs), 0
        while row >= 0 and length < path.shape[0]:
            path[length] = row
            length += 1
            row = np.int64(roadmap.parent[row])
        if length == 0 or row >= 0:
            return NO_PATH, 0, searched + 1
        good = True
        for i in range(length - 2, 0, -1):
            # check all nodes, also after one that is blocked: cheaper than another search
            if not _node_free(space, roadmap, path[i], drift):
                good = False
        if not good:
            continue
        size = _join_nodes(space, roadmap, path, length, ends, states, proven)
        if size == NO_PATH:
            continue
        return size, length, searched + 1
    return NO_PATH, length, most_searches


@entry
def store_check(
    roadmap: RoadmapArrays,
    path: Annotated[np.ndarray, "int64 longest"],
    ends: Annotated[np.ndarray, "int64 longest"],
    length: int,
    proven: Annotated[np.ndarray, "bool room"],
    bad: int,
):
    """Store the fine check of the last path found.

    Args:
        roadmap: changed in place: edges whose motions are all proven become PROVEN_FREE, the edge
            with the motion that failed becomes BLOCKED.
        path: as `search` wrote it.
        ends: as `search` wrote it.
        length: number of the path's nodes.
        proven: whether the motion after each state passed the check.
        bad: number of the motion that failed; -1: none.
    """
    first = 0
    for i in range(length - 2, -1, -1):
        last, all_proven = ends[i] - 1, True
        for k in range(first, last):
            all_proven = all_proven and proven[k]
        if first <= bad < last:
            _store_verdict(roadmap, path[i + 1], path[i], BLOCKED)
        elif all_proven:
            _store_verdict(roadmap, path[i + 1], path[i], PROVEN_FREE)
        first = last
