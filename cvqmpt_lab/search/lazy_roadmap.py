"""Lazy shortest paths on a roadmap under a constraint.

A lazy probabilistic roadmap (Bohlin and Kavraki 2000): A* assumes that every node and edge that is
not known to be blocked is free. The nodes of the path it returns are projected and checked, then
its edges, coarsely; what fails is blocked and the search repeated. The caller makes the fine check
and blocks what fails it. An edge from a to b that is not yet checked costs

    (f(a) + f(b)) / 2 * |b - a| - w log P(free),    f(q) = 1 + penalty |F(q)|

P(free) follows from clearances along the edge (`edge_costs`). They are read one by one when the
search takes the edge, until another edge is cheaper.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.heap import drop_smallest, push
from cvqmpt_lab.base.jit import entry, kernel
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
    bisect_motion,
    distance,
    project_state,
    state_valid,
)

UNKNOWN, FREE, BLOCKED = range(3)
NO_PATH = 0  # instead of a number of states


class RoadmapArrays(NamedTuple):
    """A roadmap, a query and work arrays; rows of `nodes` are N nodes, the start and G goals."""

    nodes: Annotated[np.ndarray, "rows n"]  # configurations, projected in place [rad or m]
    neighbours: Annotated[np.ndarray, "int32 inner links"]  # nodes that a row leads to, or -1
    edge: Annotated[np.ndarray, "int8 inner links"]  # verdicts on those edges
    # verdicts on the edges from each row to each goal; BLOCKED where there is none
    goal_edge: Annotated[np.ndarray, "int8 inner goals"]
    node: Annotated[np.ndarray, "int8 rows"]  # verdicts
    penalty: float  # edges at a node cost 1 + penalty * |F| times their length
    longest: float  # [rad] paths that cost as much or more are not searched for
    clearance: Annotated[np.ndarray, "rows"]  # [m] of nodes; inf: not yet read
    # smallest clearance [m] read so far along each edge, and along those to each goal
    lowest: Annotated[np.ndarray, "inner exits"]
    # 4 times how many clearances were read along an edge, plus `_state` of its ends at that time
    known: Annotated[np.ndarray, "int32 inner exits"]
    # f(q) >= 1 of each node; 0: not yet computed
    factor: Annotated[np.ndarray, "rows"]
    to_go: Annotated[np.ndarray, "rows"]  # distance to the nearest goal [rad]
    cost: Annotated[np.ndarray, "rows"]  # from the start, in a search
    parent: Annotated[np.ndarray, "int32 rows"]  # row before each one
    slot: Annotated[np.ndarray, "int32 rows"]  # edge by which each row was reached
    closed: Annotated[np.ndarray, "int8 rows"]  # rows that are done
    heap: Annotated[np.ndarray, "queue"]  # costs in the queue
    heap_edge: Annotated[np.ndarray, "int32 queue"]  # their edges: row * exits + slot


@entry
def nearest_nodes(
    nodes: Annotated[np.ndarray, "rows n"],
    count: int,
    target: Annotated[np.ndarray, "n"],
    chosen: Annotated[np.ndarray, "int32 k"],
    squares: Annotated[np.ndarray, "k"],
):
    """Write the k nearest of the first count rows, nearest first, and squares |row - target|^2."""
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
    """Link start and goals to as many nearest nodes as `chosen`, a work array, has entries."""
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
        roadmap.goal_edge[count, g] = UNKNOWN
        nearest_nodes(roadmap.nodes, count, roadmap.nodes[count + 1 + g], chosen, squares)
        for slot in range(chosen.shape[0]):
            roadmap.goal_edge[chosen[slot], g] = UNKNOWN


@kernel(inline="machine")
def _state(roadmap, here, there):
    """One more than the number of an edge's ends that are projected."""
    return 1 + (roadmap.node[here] == FREE) + (roadmap.node[there] == FREE)


@kernel(inline="source")
def _factor(space, roadmap, i):
    """Cost factor f = 1 + penalty |F(q)| of node i, at its place before projection."""
    if roadmap.factor[i] == 0.0:
        scratch = space.scratch
        forward_kinematics(
            space.kinematics, roadmap.nodes[i], scratch.link_rotation, scratch.link_translation
        )
        square = residual(
            space.regions,
            scratch.link_rotation,
            scratch.link_translation,
            scratch.residual,
            scratch.displacement,
        )
        roadmap.factor[i] = 1.0 + roadmap.penalty * np.sqrt(square)
    return roadmap.factor[i]


@kernel
def _read_node(space, roadmap, costs, i):
    """Read the clearance at node i, once before and once after its projection."""
    if roadmap.clearance[i] == np.inf:
        roadmap.clearance[i] = reading(
            space, costs, roadmap.nodes[i], roadmap.nodes[i], 0, CLEARANCE_MAX_M
        )


@kernel(inline="source")
def _read_edge(space, roadmap, costs, row, slot, there):
    """Read the next clearance along an edge; return the increase of its -log P(free)."""
    before, k = roadmap.lowest[row, slot], roadmap.known[row, slot] // 4
    lowest = before
    if k == 0:
        _read_node(space, roadmap, costs, there)
        lowest = min(before, roadmap.clearance[there])
    elif before > CLEARANCE_MIN_M:
        lowest = reading(space, costs, roadmap.nodes[row], roadmap.nodes[there], k, before)
    roadmap.lowest[row, slot] = lowest
    roadmap.known[row, slot] += 4
    return negative_log(costs, lowest) - negative_log(costs, before)


@kernel
def _astar(space, roadmap, costs):
    """Row of the goal that the cheapest path leads to, or -1; parent and slot hold the path.

    Lazy weighted A* (Cohen, Phillips and Likhachev 2014): an edge enters the queue at its length
    and what is known of its clearance. When it comes out, clearances along it are read until
    another edge is cheaper.
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
            cost, judged = (
                roadmap.cost[here] + weight * length,
                verdict == FREE or costs.weight == 0.0,
            )
            if not judged:
                state = _state(roadmap, here, there)
                if roadmap.known[here, slot] % 4 != state:
                    roadmap.known[here, slot], roadmap.lowest[here, slot] = (
                        state,
                        roadmap.clearance[here],
                    )
                lowest = min(roadmap.lowest[here, slot], roadmap.clearance[there])
                roadmap.lowest[here, slot] = lowest
                cost += costs.weight * negative_log(costs, lowest)
                judged = roadmap.known[here, slot] // 4 >= readings(costs, length)
            hopeful = cost < roadmap.cost[there] and cost + roadmap.to_go[there] < roadmap.longest
            if hopeful and size < roadmap.heap.shape[0]:
                if judged:
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
            if verdict != FREE and costs.weight > 0.0:
                left = readings(costs, distance(roadmap.nodes[row], roadmap.nodes[there]))
                left -= roadmap.known[row, slot] // 4
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
    """Project node i by at most drift [rad] and check it; the verdict is kept."""
    if roadmap.node[i] == UNKNOWN:
        for j in range(roadmap.nodes.shape[1]):
            space.state[j] = roadmap.nodes[i, j]
        free = (
            project_state(space, roadmap.nodes[i])
            and distance(space.state, roadmap.nodes[i]) <= drift
        )
        roadmap.clearance[i] = np.inf
        roadmap.node[i] = FREE if free and state_valid(space, roadmap.nodes[i]) else BLOCKED
    return roadmap.node[i] == FREE


@kernel(inline="source")
def _settle_edge(roadmap, a, b, verdict):
    """Keep a verdict on the edge by which the last search came from row a to row b."""
    slot, k = np.int64(roadmap.slot[b]), roadmap.neighbours.shape[1]
    if slot >= k:
        roadmap.goal_edge[a, slot - k] = verdict
        return
    roadmap.edge[a, slot] = verdict
    for other in range(k):
        if roadmap.neighbours[b, other] == a:
            roadmap.edge[b, other] = verdict


@kernel(inline="source")
def _join_nodes(space, roadmap, path, length, ends, states):
    """Write the states along a path's nodes; their number, or NO_PATH with an edge blocked."""
    n, size = roadmap.nodes.shape[1], 1
    for j in range(n):
        states[0, j] = roadmap.nodes[path[length - 1], j]
    for i in range(length - 2, -1, -1):
        a, b = path[i + 1], path[i]
        # of any length: the distance of neighbours is limited anyway
        added = bisect_motion(space, roadmap.nodes[a], roadmap.nodes[b], np.inf, states[size:])
        if added == 0:
            _settle_edge(roadmap, a, b, BLOCKED)
            return NO_PATH
        _settle_edge(roadmap, a, b, FREE)
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
):
    """Find the shortest path that passes the coarse checks; its motions are not checked yet.

    Args:
        space: the planning space.
        roadmap: roadmap and query.
        costs: of edges that are not checked yet.
        most_searches: at most so many A* searches.
        drift: nodes that projection moves further than this are left out [rad].
        path: written, rows of the path's nodes from goal to start.
        ends: written, where the states of each edge end.
        states: written.

    Returns:
        Number of states, or NO_PATH when there is no path, none within most_searches, or no room;
        number of nodes on the last candidate path; number of searches.
    """
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
            # check all nodes: cheaper than another search
            if not _node_free(space, roadmap, path[i], drift):
                good = False
        if not good:
            continue
        size = _join_nodes(space, roadmap, path, length, ends, states)
        if size == NO_PATH:
            continue
        return size, length, searched + 1
    return NO_PATH, length, most_searches


@entry
def block_state(
    roadmap: RoadmapArrays,
    path: Annotated[np.ndarray, "int64 longest"],
    ends: Annotated[np.ndarray, "int64 longest"],
    length: int,
    state: int,
):
    """Block the edge of the last path found that holds the motion behind one of its states.

    path, ends, length: as `search` wrote and returned them.
    """
    for i in range(length - 2, -1, -1):
        if state + 1 < ends[i]:
            _settle_edge(roadmap, path[i + 1], path[i], BLOCKED)
            return
