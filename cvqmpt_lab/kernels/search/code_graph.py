"""A dictionary as a graph, a question asked of it, and the price of going on from every code.

Codes are nodes, and lead to their neighbours both ways. Prices are what eyes say, see `sight`: nothing is checked.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.entry import entry
from cvqmpt_lab.kernels.manifold.kinematics import Kinematics
from cvqmpt_lab.kernels.search.heap import drop_smallest, push
from cvqmpt_lab.kernels.search.motion import distance
from cvqmpt_lab.kernels.search.sight import Sight, surprise

FEATURES = 6
LONGEST, DOUBT = 10.0, 6.0  # [rad] features are cut off here
SCALE = 0.2  # of the remaining cost as a feature


class CodeGraph(NamedTuple):
    """N codes with M arcs."""

    nodes: Annotated[np.ndarray, "nodes n"]
    """A configuration of each code [rad or m]."""
    first: Annotated[np.ndarray, "int32 inner"]
    """Where each node's arcs begin; one more entry than nodes."""
    neighbour: Annotated[np.ndarray, "int32 arcs"]
    """The node that an arc leads to."""
    edge: Annotated[np.ndarray, "int32 arcs"]
    """The edge that it belongs to; the arc back belongs to the same."""
    length: Annotated[np.ndarray, "edges"]
    """Of each edge [rad]."""
    price: Annotated[np.ndarray, "edges"]
    """-log P(free) of each edge."""


class CodeQuestion(NamedTuple):
    """A start, G goals, and what is known of the ways to and from them."""

    start: Annotated[np.ndarray, "n"]
    """[rad or m]."""
    goals: Annotated[np.ndarray, "goals n"]
    """[rad or m]."""
    entry: Annotated[np.ndarray, "int32 entries"]
    """Nodes that the start leads to ..."""
    entry_price: Annotated[np.ndarray, "entries"]
    """... at this -log P(free)."""
    exit_first: Annotated[np.ndarray, "int32 inner"]
    """Where each node's exits begin."""
    exit_goal: Annotated[np.ndarray, "int32 exits"]
    """Goal that an exit leads to ..."""
    exit_price: Annotated[np.ndarray, "exits"]
    """... at this -log P(free)."""
    factor: Annotated[np.ndarray, "nodes"]
    """>= 1, how much longer motions at a node count; inf: a node not to use."""
    caution: float
    """What -log P(free) costs [rad]."""
    to_go: Annotated[np.ndarray, "nodes"]
    """Cost of the cheapest way on from each node to any goal [rad]."""
    straight: Annotated[np.ndarray, "nodes"]
    """Distance from each node to the nearest goal [rad]."""
    heap: Annotated[np.ndarray, "queue"]
    """Costs in the queue."""
    heap_node: Annotated[np.ndarray, "int32 queue"]
    """Their nodes."""


@kernel(inline="machine")
def _cost(length, price, weight, caution):
    return weight * length + caution * price


@entry
@kernel
def judge_ends(
    kinematics: Kinematics,
    sight: Sight,
    graph: CodeGraph,
    question: CodeQuestion,
    exit_node: Annotated[np.ndarray, "int32 exits"],
):
    """Write the prices of the motions from the start and to the goals."""
    for k in range(question.entry.shape[0]):
        question.entry_price[k] = surprise(kinematics, sight, question.start, graph.nodes[question.entry[k]])
    for k in range(exit_node.shape[0]):
        goal = question.goals[question.exit_goal[k]]
        question.exit_price[k] = surprise(kinematics, sight, graph.nodes[exit_node[k]], goal)


@entry
@kernel
def cost_to_go(graph: CodeGraph, question: CodeQuestion):
    """Write, by Dijkstra's algorithm from all goals at once, what the way on from each node costs."""
    count, size = graph.nodes.shape[0], 0
    heap, heap_node, to_go = question.heap, question.heap_node, question.to_go
    for i in range(count):
        to_go[i], question.straight[i] = np.inf, np.inf
        for g in range(question.goals.shape[0]):
            question.straight[i] = min(question.straight[i], distance(graph.nodes[i], question.goals[g]))
        weight = 0.5 * (question.factor[i] + 1.0)
        for k in range(question.exit_first[i], question.exit_first[i + 1]):
            length = distance(graph.nodes[i], question.goals[question.exit_goal[k]])
            to_go[i] = min(to_go[i], _cost(length, question.exit_price[k], weight, question.caution))
        if to_go[i] < np.inf:
            push(heap, heap_node, size, to_go[i], i)
            size += 1
    while size > 0:
        cost, here = heap[0], np.int64(heap_node[0])
        drop_smallest(heap, heap_node, size)
        size -= 1
        if cost > to_go[here]:
            continue
        for arc in range(graph.first[here], graph.first[here + 1]):
            there = np.int64(graph.neighbour[arc])
            weight = 0.5 * (question.factor[here] + question.factor[there])
            edge = graph.edge[arc]
            more = cost + _cost(graph.length[edge], graph.price[edge], weight, question.caution)
            if more < to_go[there] and size < heap.shape[0]:
                to_go[there] = more
                push(heap, heap_node, size, more, there)
                size += 1


@entry
@kernel
def ways_on(
    graph: CodeGraph,
    question: CodeQuestion,
    row: int,
    target: Annotated[np.ndarray, "int32 room"],
    feature: Annotated[np.ndarray, "room 6"],
):
    """Write where one can go on from a code, and what a network is told of each of these ways.

    Parameters
    ----------
    row: a node, or their number N for the start.
    target: nodes, or N + g for goal g.
    feature: length [rad], -log P(free), cost of going there and on over that of the best way [rad], how much
        nearer it is to a goal than here [rad], whether it is a goal, cost of the way on from there [5 rad].

    Returns
    -------
    How many there are; those from which no way leads on are left out.
    """
    count, found = graph.nodes.shape[0], 0
    at_start = row == count
    here = question.start if at_start else graph.nodes[row]
    own = 1.0 if at_start else question.factor[row]
    best, near = np.inf, np.inf
    for g in range(question.goals.shape[0]):
        near = min(near, distance(here, question.goals[g]))
    arcs = 0 if at_start else graph.first[row]
    ways = question.entry.shape[0] if at_start else graph.first[row + 1] - arcs
    exits = 0 if at_start else question.exit_first[row + 1] - question.exit_first[row]
    for k in range(ways + exits):
        if found == target.shape[0]:
            break
        if k >= ways:
            slot = question.exit_first[row] + k - ways
            goal = np.int64(question.exit_goal[slot])
            there, price, to_go, ahead, other = count + goal, question.exit_price[slot], 0.0, 0.0, 1.0
            length = distance(here, question.goals[goal])
        else:
            if at_start:
                there, price = np.int64(question.entry[k]), question.entry_price[k]
            else:
                there, price = np.int64(graph.neighbour[arcs + k]), graph.price[graph.edge[arcs + k]]
            to_go, ahead, other = question.to_go[there], question.straight[there], question.factor[there]
            length = distance(here, graph.nodes[there])
        cost = _cost(length, price, 0.5 * (own + other), question.caution) + to_go
        if not cost < np.inf:
            continue
        target[found] = there
        feature[found, 0] = length
        feature[found, 1] = min(price, DOUBT)
        feature[found, 2] = cost
        feature[found, 3] = near - ahead
        feature[found, 4] = 1.0 if there >= count else 0.0
        feature[found, 5] = SCALE * min(to_go, 2.0 * LONGEST)
        best = min(best, cost)
        found += 1
    for k in range(found):
        feature[k, 2] = min(feature[k, 2] - best, LONGEST)
    return found
