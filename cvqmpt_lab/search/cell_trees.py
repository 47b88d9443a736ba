"""Two trees that explore the free rows of the constraint by random walks, for narrow passages.

    repeat until the trees meet or the budget is spent:
        choose a grid; one of its cells with nodes of T_a, rarely chosen ones first; a node in it
        walk from there in a random direction until blocked; each state becomes a node of T_a
        if T_b has nodes in the cells of the last state, try a direct motion to the nearest of them
        Swap(T_a, T_b)

Cells are defined in `cell_grids`. Motions between nodes are checked finely when they are made, so a
path through both trees is a solution.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel, placed
from cvqmpt_lab.search.birrt import (
    CONNECTED,
    FULL,
    GROWING,
    Trees,
    checked_tree_path,
    enlarged_trees,
    plant,
    result_trees,
)
from cvqmpt_lab.search.cell_grids import (
    NODES_PER_CELL,
    Grids,
    choose,
    empty_grids,
    enlarged_grids,
    place_node,
)
from cvqmpt_lab.search.motion import (
    CLEARANCES,
    EXTENSIONS,
    ITERATIONS,
    MAX_LENGTH_RATIO,
    PROJECTIONS,
    SAME_STATE_RAD,
    STATE_CHECKS,
    TRAPPED,
    Space,
    distance,
    motion_between,
    segment_valid,
    step_towards,
)
from cvqmpt_lab.search.nearest import index_new_nodes, nearest_node
from cvqmpt_lab.search.planner_interface import Deadline, Query, SamplingDistribution
from cvqmpt_lab.search.result import JointPath, PlanResult
from cvqmpt_lab.search.space import refine_and_check
from cvqmpt_lab.search.work import search_work

_work = kernel(search_work)


@kernel(inline="source")
def _join(space, grids, trees, a, node, farthest):
    """Connect a node of one tree to a near node of the other tree by a direct motion.

    Args:
        space: the planning space.
        grids: grids.cell holds the cells of the node.
        trees: the motion's states become nodes of tree a.
        a: row of the node's tree.
        node: number of the node.
        farthest: nodes further apart are not connected [rad].

    Returns:
        Whether the trees are connected; trees.meeting then holds the nodes.
    """
    b = 1 - a
    q, other, least = trees.nodes[a, node], -1, farthest
    for g in range(grids.cell.shape[0]):
        cell = grids.cell[g]
        for k in range(min(grids.members[b, g, cell], NODES_PER_CELL)):
            gap = distance(q, trees.nodes[b, grids.held[b, g, cell, k]])
            if gap < least:
                other, least = grids.held[b, g, cell, k], gap
    index_new_nodes(trees.nearest, b, trees.nodes[b], trees.size[b])
    near = nearest_node(trees.nearest, b, trees.nodes[b], trees.size[b], q)
    gap = distance(q, trees.nodes[b, near])
    if gap < least:
        other, least = near, gap
    if other < 0:
        return False
    target = trees.nodes[b, other]
    longest = max(MAX_LENGTH_RATIO * least, space.step)
    states = motion_between(space, q, target, longest, grids.motion)
    if states == 0 or not segment_valid(space, q, grids.motion[0]):
        return False
    motion = grids.motion[:states]
    if refine_and_check(space, motion, grids.refined, grids.segment, True)[1] >= 0:
        return False
    for k in range(states):
        new = trees.size[a]
        for j in range(q.shape[0]):
            trees.nodes[a, new, j] = grids.motion[k, j]
        trees.parent[a, new] = node
        trees.proven[a, new] = True
        trees.size[a] = new + 1
        node = new
    trees.meeting[a], trees.meeting[b] = node, other
    return True


@entry
def plant_cells(space: Space, trees: Trees, grids: Grids):
    """Add the roots of both trees to their cells."""
    for tree in range(2):
        for node in range(trees.size[tree]):
            place_node(space, grids, tree, trees.nodes[tree], node)


@entry
def grow_cells(
    space: Space,
    trees: Trees,
    grids: Grids,
    shifts: Annotated[np.ndarray, "count n"],
    chances: Annotated[np.ndarray, "count 3"],
    first: int,
    most_work: float,
    farthest: float,
):
    """Make one walk for each row of shifts, from row `first` on, until the trees meet.

    Args:
        space: the planning space; each walk counts as an iteration.
        trees: trees from the start and from the goals.
        grids: their cells.
        shifts: vector (count, n) from a walk's first node to its target [rad or m].
        chances: (count, 3), uniform in [0, 1): choose grid, cell and node.
        first: row of the first walk.
        most_work: limit of the work in this space so far, in units of `Counters.work`.
        farthest: nodes of both trees further apart are not connected [rad].

    Returns:
        GROWING (no walk or work is left), CONNECTED (trees.meeting holds the nodes) or FULL (no
        space for more nodes or cells), and the row of the next walk.
    """
    space = placed(space)
    counters, limit = space.counters, trees.nodes.shape[1]
    longest = grids.motion.shape[0]
    for i in range(first, shifts.shape[0]):
        a = trees.turn[0]
        nodes, parent = trees.nodes[a], trees.parent[a]
        crowded = max(trees.size[0], trees.size[1]) + 2 * longest >= limit
        for g in range(grids.known.shape[0]):
            crowded = crowded or grids.known[g] + 2 * longest >= grids.place.shape[1]
        if crowded:
            return FULL, i
        work = _work(counters[PROJECTIONS], counters[STATE_CHECKS], counters[CLEARANCES])
        if work >= most_work:
            return GROWING, i
        counters[ITERATIONS] += 1
        trees.turn[0] = 1 - a  # Swap
        g = int(chances[i, 0] * grids.known.shape[0])
        node = choose(grids, a, g, chances[i, 1], chances[i, 2])
        target = shifts[i]
        for j in range(target.shape[0]):
            place = nodes[node, j] + target[j]
            target[j] = min(max(place, space.kinematics.lower[j]), space.kinematics.upper[j])
        left = MAX_LENGTH_RATIO * distance(nodes[node], target)
        walked = 0
        while walked < longest and distance(nodes[node], target) > SAME_STATE_RAD:
            new = trees.size[a]
            step = step_towards(space, nodes[node], target, left, nodes[new])
            if step == TRAPPED or not segment_valid(space, nodes[node], nodes[new]):
                break
            left -= distance(nodes[node], nodes[new])
            parent[new] = node
            trees.proven[a, new] = True
            trees.size[a] = new + 1
            place_node(space, grids, a, nodes, new)
            node = new
            walked += 1
        if walked > 0:
            counters[EXTENSIONS] += 1
            if _join(space, grids, trees, a, node, farthest):
                return CONNECTED, i + 1
    return GROWING, shifts.shape[0]


class CellTrees:
    """Two trees and their cells, which grow in several calls of `grow`.

    Args:
        space: the planning space.
        start: (n,) [rad or m].
        goals: (k, n) [rad or m].
        rng: random number generator.
    """

    def __init__(self, query: Query) -> None:
        space = self._space = query.space
        self._rng = query.rng
        self.trees = plant(query.start, query.goals, capacity=4096)
        self._grids = empty_grids(space, query.rng)
        while len(query.goals) + 256 > self._grids.place.shape[1]:
            self._grids = enlarged_grids(self._grids)
        plant_cells.unchecked(space.arrays, self.trees, self._grids)
        self._scale = np.minimum((space.robot.upper - space.robot.lower) / np.pi, 1.0)
        self._shifts, self._chances = np.empty((0, len(query.start))), np.empty((0, 3))
        self._next = 0

    def grow(
        self, deadline: Deadline, work: float = np.inf, iterations: float = np.inf
    ) -> JointPath | None:
        """Grow until the budget or another limit is reached or the trees connect.

        Args:
            deadline: the budget.
            work: limit of the work of this call, in units of `ConstrainedSpace.work`.
            iterations: limit of the walks of this call.

        Returns:
            A path that passed the fine check, or None.
        """
        most = self._space.work + work
        left = min(iterations, deadline.iterations_left)
        part = 64 if deadline.budget.cost is None else 1
        while self._space.work < most and left > 0 and not deadline.late:
            if self._next == len(self._shifts):
                self._draw(256)
            last = min(self._next + int(min(left, part)), len(self._shifts))
            before = self._space.arrays.counters[ITERATIONS]
            status, self._next = grow_cells.unchecked(
                self._space.arrays,
                self.trees,
                self._grids,
                self._shifts[:last],
                self._chances[:last],
                self._next,
                most,
                4.0,  # farthest [rad]
            )
            left -= int(self._space.arrays.counters[ITERATIONS] - before)
            self._space.reraise()
            if status == FULL:
                longest = len(self._grids.motion)
                if self.trees.size.max() + 2 * longest >= self.trees.nodes.shape[1]:
                    self.trees = enlarged_trees(self.trees)
                if self._grids.known.max() + 2 * longest >= self._grids.place.shape[1]:
                    self._grids = enlarged_grids(self._grids)
            elif status == CONNECTED:
                path = checked_tree_path(self._space, self.trees)
                self._space.reraise()
                if path is not None:
                    return path
        return None

    def _draw(self, count: int) -> None:
        """Draw random numbers for `count` walks, of lengths from 0.1 to 2 rad per joint."""
        n = len(self._scale)
        length = 0.1 * 20.0 ** self._rng.random((count, 1))
        self._shifts = length * self._scale * self._rng.standard_normal((count, n))
        self._chances = self._rng.random((count, 3))
        self._next = 0


@dataclass(frozen=True)
class CellSearch:
    """Settings of a search by trees with cells; there are none."""

    def search(self, query: Query, distribution: SamplingDistribution) -> PlanResult:
        """Search a path from the query's start to any of its goals, see `Search`.

        The distribution is not used: walks start at nodes.
        """
        deadline, growth = query.deadline, CellTrees(query)
        path = growth.grow(deadline)
        return deadline.result(path, result_trees(growth.trees), "cells")
