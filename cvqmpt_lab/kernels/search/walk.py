"""Walking a predicted sequence of codes on the manifold: what holds is added to the tree of the start."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.entry import entry
from cvqmpt_lab.kernels.search.code_graph import CodeGraph, CodeQuestion
from cvqmpt_lab.kernels.search.motion import bisect_motion, distance
from cvqmpt_lab.kernels.search.space_arrays import Space, project_state, state_valid
from cvqmpt_lab.kernels.search.tree_growth import CONNECTED, FULL, GROWING, Trees

UNKNOWN, MOVED, FREE, BLOCKED = range(
    4
)  # of a code: as it is, put on the manifold, and found free, or not to use


@entry
@kernel
def move_code(
    space: Space,
    graph: CodeGraph,
    question: CodeQuestion,
    state: Annotated[np.ndarray, "int8 nodes"],
    i: int,
    drift: float,
):
    """Put code i on the manifold, unless it was; one that drifts further than drift [rad] is not used again."""
    if state[i] != UNKNOWN:
        return
    for j in range(graph.nodes.shape[1]):
        space.state[j] = graph.nodes[i, j]
    if project_state(space, graph.nodes[i]) and distance(space.state, graph.nodes[i]) <= drift:
        state[i], question.factor[i] = MOVED, 1.0
        for arc in range(graph.first[i], graph.first[i + 1]):
            graph.length[graph.edge[arc]] = distance(graph.nodes[i], graph.nodes[graph.neighbour[arc]])
    else:
        state[i], question.factor[i] = BLOCKED, np.inf


@entry
@kernel
def walk(
    space: Space,
    graph: CodeGraph,
    question: CodeQuestion,
    trees: Trees,
    state: Annotated[np.ndarray, "int8 nodes"],
    standing: Annotated[np.ndarray, "int64 nodes"],
    codes: Annotated[np.ndarray, "int32 steps"],
    goal: int,
    drift: float,
    room: Annotated[np.ndarray, "room n"],
):
    """Walk from the start along codes to a goal, as far as the way is free.

    Parameters
    ----------
    state: of each code. standing: where each code stands in the start's tree, or -1.
    room: work array for the states of one motion.

    Returns
    -------
    status: CONNECTED when the goal was reached, GROWING when the way is blocked, FULL when a tree has no room for the
    motion.
    blocked: which motion blocks the way, counted from the start; -1 where a code does, which is marked, or none.
    """
    here, first = np.int64(0), 0
    for k in range(codes.shape[0]):
        move_code(space, graph, question, state, codes[k], drift)
        if state[codes[k]] == MOVED:
            free = state_valid(space, graph.nodes[codes[k]])
            state[codes[k]] = FREE if free else BLOCKED
            if not free:
                question.factor[codes[k]] = np.inf
        if state[codes[k]] == BLOCKED:
            return GROWING, -1
        if standing[codes[k]] >= 0:
            here, first = standing[codes[k]], k + 1
    for k in range(first, codes.shape[0] + 1):
        target = question.goals[goal] if k == codes.shape[0] else graph.nodes[codes[k]]
        written = bisect_motion(space, trees.nodes[0, here], target, np.inf, room)
        if written == 0:
            return GROWING, k
        if trees.size[0] + written + 1 >= trees.nodes.shape[1]:
            return FULL, -1
        for i in range(written):
            new = trees.size[0]
            for j in range(room.shape[1]):
                trees.nodes[0, new, j] = room[i, j]
            trees.parent[0, new] = here
            trees.size[0] = new + 1
            here = new
        if k < codes.shape[0]:
            standing[codes[k]] = here
    trees.meeting[0], trees.meeting[1] = here, goal
    return CONNECTED, -1
