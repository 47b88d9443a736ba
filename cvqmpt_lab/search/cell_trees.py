"""Two trees that explore what the constraint leaves free by short steps, for narrow passages.

    repeat until the trees meet or the budget is spent:
        choose a grid; of its cells that T_a touches, one that was rarely chosen; a node in it
        walk from there in a random direction until blocked; each state becomes a node of T_a
        where T_b touches the last one's cell in any grid, try the direct motion to its node there
        Swap(T_a, T_b)

A grid divides what the constraint leaves free (unbounded rows of its regions), or the joints where
nothing is free, into cells, as KPIECE (Sucan and Kavraki 2009) and EST (Hsu et al. 1999) do. As
nobody knows the right size of cells, there are grids of several, each used equally often. Motions
between nodes are checked finely when they are made: a path through the trees is a solution.
"""

import time
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.constraints.regions import residual
from cvqmpt_lab.jit import entry, kernel
from cvqmpt_lab.robot.kinematics import forward_kinematics
from cvqmpt_lab.search.birrt import (
    CONNECTED,
    FULL,
    GROWING,
    Trees,
    checked_tree_path,
    enlarged_trees,
    plant,
)
from cvqmpt_lab.search.motion import (
    CLEARANCES,
    DEVIATION,
    EXTENSIONS,
    ITERATIONS,
    PROJECTIONS,
    STATE_CHECKS,
    STOPPED,
    Space,
    bisect_motion,
    distance,
    refine_and_check,
    segment_valid,
    step_towards,
)
from cvqmpt_lab.search.planner_interface import SamplingDistribution
from cvqmpt_lab.search.result import Budget, JointPath, PlanResult, PlanStatus, Tree
from cvqmpt_lab.search.space import ConstrainedSpace

HELD = 8  # nodes of each tree that a cell remembers


class Grids(NamedTuple):
    """Cells of several grids, and which nodes of two trees lie in them."""

    # from free rows and joints to a place in each grid, in cells
    projection: Annotated[np.ndarray, "grids axes coordinates"]
    rows: Annotated[np.ndarray, "int64 free 2"]  # region and axis of free rows
    table: Annotated[np.ndarray, "int32 grids slots"]  # a cell's number + 1 at its hash, or 0
    place: Annotated[np.ndarray, "int32 grids cells axes"]
    known: Annotated[np.ndarray, "int64 grids"]  # cells found in each grid
    count: Annotated[np.ndarray, "int32 2 grids cells"]  # nodes of each tree in a cell
    chosen: Annotated[np.ndarray, "int32 2 grids cells"]  # how often
    held: Annotated[np.ndarray, "int32 2 grids cells held"]  # some of its nodes
    # sums of weights: row i holds that of i & -i cells up to cell i - 1 (Fenwick 1994)
    sums: Annotated[np.ndarray, "2 grids cells_and_one"]
    coordinates: Annotated[np.ndarray, "coordinates"]  # work array: free rows and joints of a state
    cell: Annotated[np.ndarray, "int64 grids"]  # work array: the cells of a state
    motion: Annotated[np.ndarray, "longest n"]  # work array: states of a motion
    refined: Annotated[np.ndarray, "finest n"]  # work array


@kernel
def _find_cells(space, grids, q):
    """Write the cells of a state q (n,) into grids.cell; new ones are made."""
    rotation, translation = space.scratch.link_rotation, space.scratch.link_translation
    displacement, x = space.scratch.displacement, grids.coordinates
    forward_kinematics(space.kinematics, q, rotation, translation)
    residual(space.regions, rotation, translation, space.scratch.residual, displacement)
    free = grids.rows.shape[0]
    for i in range(free):
        x[i] = displacement[grids.rows[i, 0], 3 + grids.rows[i, 1]]
    for j in range(q.shape[0]):
        x[free + j] = q[j]
    axes, last_slot = grids.place.shape[2], grids.table.shape[1] - 1
    for g in range(grids.place.shape[0]):
        place, table, new = grids.place[g], grids.table[g], grids.known[g]
        key = 0
        for a in range(axes):
            along = 0.0
            for c in range(x.shape[0]):
                along += grids.projection[g, a, c] * x[c]
            place[new, a] = int(np.floor(along))
            key = (key ^ place[new, a]) * 0x5BD1E995
            key ^= key >> 15
        slot = key & last_slot
        while True:
            cell = table[slot] - 1
            if cell < 0:
                table[slot] = new + 1
                grids.known[g] = new + 1
                cell = new
                break
            same = True
            for a in range(axes):
                same = same and place[cell, a] == place[new, a]
            if same:
                break
            slot = (slot + 1) & last_slot
        grids.cell[g] = cell


@kernel
def _count(grids, tree, g, cell, nodes, choices):
    """Change how many nodes of a tree are in a cell, and how often it was chosen."""
    count, chosen = grids.count[tree, g], grids.chosen[tree, g]
    before = 0.0
    if count[cell] > 0:
        before = 1.0 / ((1.0 + chosen[cell]) * (1.0 + 0.2 * count[cell]))
    count[cell] += nodes
    chosen[cell] += choices
    change = 1.0 / ((1.0 + chosen[cell]) * (1.0 + 0.2 * count[cell])) - before
    i = cell + 1
    while i < grids.sums.shape[2]:
        grids.sums[tree, g, i] += change
        i += i & -i


@kernel
def _place_node(space, grids, tree, nodes, node):
    """Put a node of a tree into its cells, which grids.cell then holds."""
    _find_cells(space, grids, nodes[node])
    for g in range(grids.cell.shape[0]):
        cell = grids.cell[g]
        known = grids.count[tree, g, cell]
        held = known if known < HELD else (node * 0x5BD1E995 >> 13) % HELD
        grids.held[tree, g, cell, held] = node
        _count(grids, tree, g, cell, 1, 0)


@kernel
def _choose(grids, tree, g, share, which):
    """A node of a tree in a cell of grid g, drawn by weight; share, which: uniform in [0, 1)."""
    sums = grids.sums[tree, g]
    stride = sums.shape[0] - 1  # a power of two
    left, cell = share * sums[stride], 0
    while stride > 1:
        stride //= 2
        if sums[cell + stride] <= left and cell + stride < grids.known[g]:
            cell += stride
            left -= sums[cell]
    # rounding may lead to a neighbour that the tree does not touch
    while grids.count[tree, g, cell] == 0:
        cell = cell - 1 if cell > 0 else grids.known[g] - 1
    _count(grids, tree, g, cell, 0, 1)
    return grids.held[tree, g, cell, int(which * min(grids.count[tree, g, cell], HELD))]


@kernel
def _join(space, grids, trees, a, node, farthest):
    """Join a node of tree a, whose cells grids.cell holds, to a near one of the other tree."""
    b = 1 - a
    q, other, least = trees.nodes[a, node], -1, farthest
    for g in range(grids.cell.shape[0]):
        cell = grids.cell[g]
        for k in range(min(grids.count[b, g, cell], HELD)):
            gap = distance(q, trees.nodes[b, grids.held[b, g, cell, k]])
            if gap < least:
                other, least = grids.held[b, g, cell, k], gap
    if other < 0:
        return False
    target = trees.nodes[b, other]
    states = bisect_motion(space, q, target, max(DEVIATION * least, space.step), grids.motion)
    if states == 0 or not segment_valid(space, q, grids.motion[0]):
        return False
    if refine_and_check(space, grids.motion[:states], grids.refined)[1] >= 0:
        return False
    for k in range(states):
        new = trees.size[a]
        for j in range(q.shape[0]):
            trees.nodes[a, new, j] = grids.motion[k, j]
        trees.parent[a, new] = node
        trees.size[a] = new + 1
        node = new
    trees.meeting[a], trees.meeting[b] = node, other
    return True


@entry
def plant_cells(space: Space, trees: Trees, grids: Grids):
    """Put the roots of both trees into their cells."""
    for tree in range(2):
        for node in range(trees.size[tree]):
            _place_node(space, grids, tree, trees.nodes[tree], node)


@entry
def grow_cells(
    space: Space,
    trees: Trees,
    grids: Grids,
    shifts: Annotated[np.ndarray, "count n"],
    chances: Annotated[np.ndarray, "count 3"],
    first: int,
    most_work: int,
    farthest: float,
):
    """Walk once for each row of shifts from the first, until the trees meet.

    Args:
        space: the planning space; each walk counts as an iteration.
        trees: from the start and from the goals.
        grids: their cells.
        shifts: from a node to where a walk goes [rad or m].
        chances: uniform in [0, 1): which grid, cell and node.
        first: row of the first walk.
        most_work: projections, state checks and clearances, counted in all so far, at which to end.
        farthest: states that are joined [rad].

    Returns:
        GROWING, CONNECTED (trees.meeting holds the nodes) or FULL (nodes or cells used up), and the
        index of the next walk.
    """
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
        work = counters[PROJECTIONS] + counters[STATE_CHECKS] + counters[CLEARANCES]
        if work >= most_work:
            return GROWING, i
        counters[ITERATIONS] += 1
        trees.turn[0] = 1 - a  # Swap
        g = int(chances[i, 0] * grids.known.shape[0])
        node = _choose(grids, a, g, chances[i, 1], chances[i, 2])
        target, far = shifts[i], 0.0
        for j in range(target.shape[0]):
            place = nodes[node, j] + target[j]
            target[j] = min(max(place, space.kinematics.lower[j]), space.kinematics.upper[j])
        far = DEVIATION * distance(nodes[node], target)
        walked = 0
        while walked < longest and distance(nodes[node], target) > 1e-9:
            new = trees.size[a]
            step = step_towards(space, nodes[node], target, far, nodes[new])
            if step == STOPPED or not segment_valid(space, nodes[node], nodes[new]):
                break
            far -= distance(nodes[node], nodes[new])
            parent[new] = node
            trees.size[a] = new + 1
            _place_node(space, grids, a, nodes, new)
            node = new
            walked += 1
        if walked > 0:
            counters[EXTENSIONS] += 1
            if _join(space, grids, trees, a, node, farthest):
                return CONNECTED, i + 1
    return GROWING, shifts.shape[0]


def _grids(space: ConstrainedSpace, rng: np.random.Generator, cells: int = 2048) -> Grids:
    """Empty grids for a space, with room for so many cells (a power of two) each."""
    robot, n = space.robot, space.robot.dof
    regions = space.problem.constraint
    rows = [
        (k, axis)
        for k, region in enumerate(regions)
        for axis in range(6)
        if np.ptp(region.bounds[axis]) > 1.0
    ]
    unit = np.array([robot.reach if axis < 3 else np.pi for _, axis in rows])
    spans = np.concatenate([unit, 0.5 * (robot.upper - robot.lower)])
    views: list[np.ndarray] = []
    places = [i for i, (_, axis) in enumerate(rows) if axis < 3]
    free = list(range(len(rows)))
    for chosen, sizes in ((places, (16, 32, 64)), (free, (8, 16, 32))):
        if chosen and (chosen is places or len(free) > len(places)):
            for size in sizes:
                view = np.zeros((len(chosen), len(spans)))
                view[range(len(chosen)), chosen] = size / spans[chosen]
                views.append(view)
    if not rows:
        for size in (4, 8, 16):
            turn = np.linalg.qr(rng.standard_normal((n, n)))[0][: min(3, n)]
            views.append(size * turn / spans)
    axes = max(map(len, views))
    projection = np.zeros((len(views), axes, len(spans)))
    for k, view in enumerate(views):
        projection[k, : len(view)] = view
    g = len(views)
    return Grids(
        projection=projection,
        rows=np.array(rows, dtype=np.int64).reshape(-1, 2),
        table=np.zeros((g, 4 * cells), dtype=np.int32),
        place=np.zeros((g, cells, axes), dtype=np.int32),
        known=np.zeros(g, dtype=np.int64),
        count=np.zeros((2, g, cells), dtype=np.int32),
        chosen=np.zeros((2, g, cells), dtype=np.int32),
        held=np.zeros((2, g, cells, HELD), dtype=np.int32),
        sums=np.zeros((2, g, cells + 1)),
        coordinates=np.zeros(len(spans)),
        cell=np.zeros(g, dtype=np.int64),
        motion=np.zeros((64, n)),
        refined=np.zeros((1024, n)),
    )


def _enlarged(grids: Grids) -> Grids:
    """The same grids with room for twice as many cells each."""
    g, cells, axes = grids.place.shape

    def twice(array: np.ndarray, axis: int) -> np.ndarray:
        return np.concatenate([array, np.zeros_like(array)], axis=axis)

    larger = grids._replace(
        table=np.zeros((g, 8 * cells), dtype=np.int32),
        place=twice(grids.place, 1),
        count=twice(grids.count, 2),
        chosen=twice(grids.chosen, 2),
        held=twice(grids.held, 2),
        sums=np.concatenate([grids.sums, np.zeros_like(grids.sums[:, :, 1:])], axis=2),
    )
    larger.sums[:, :, -1] = grids.sums[:, :, -1]
    fill_table.unchecked(larger)
    return larger


@entry
def fill_table(grids: Grids):
    """Put all known cells into the empty table."""
    last_slot = grids.table.shape[1] - 1
    for g in range(grids.place.shape[0]):
        for cell in range(grids.known[g]):
            key = 0
            for a in range(grids.place.shape[2]):
                key = (key ^ grids.place[g, cell, a]) * 0x5BD1E995
                key ^= key >> 15
            slot = key & last_slot
            while grids.table[g, slot] != 0:
                slot = (slot + 1) & last_slot
            grids.table[g, slot] = cell + 1


class CellTrees:
    """Two trees and their cells, which grow in slices of work.

    Args:
        space: the planning space.
        start: (n,) [rad or m].
        goals: (k, n) [rad or m].
        rng: of all random numbers.
    """

    def __init__(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        rng: np.random.Generator,
    ) -> None:
        self.space, self._rng = space, rng
        self.trees = plant(start, goals, capacity=4096)
        self._grids = _grids(space, rng)
        while len(goals) + 256 > self._grids.place.shape[1]:
            self._grids = _enlarged(self._grids)
        plant_cells.unchecked(space.arrays, self.trees, self._grids)
        self._scale = np.minimum((space.robot.upper - space.robot.lower) / np.pi, 1.0)
        self._shifts, self._chances = np.empty((0, len(start))), np.empty((0, 3))
        self._next = 0

    @property
    def work(self) -> int:
        """Projections, state checks and clearances counted in the space so far."""
        done = self.space.counters
        return done.projections + done.state_checks + done.clearances

    def grow(
        self, work: float, iterations: int | None = None, deadline: float = np.inf
    ) -> JointPath | None:
        """Grow for so much more work, so many iterations, or until a clock time, or to a path.

        Args:
            work: projections, state checks and clearances.
            iterations: walks.
            deadline: of time.perf_counter() [s].

        Returns:
            A path that passed the fine check, or None.
        """
        most = min(self.work + work, 2.0**62)
        left = 2**62 if iterations is None else iterations
        while self.work < most and left > 0 and time.perf_counter() < deadline:
            if self._next == len(self._shifts):
                self._draw(256)
            last = min(self._next + min(left, 64), len(self._shifts))
            before = self.space.arrays.counters[ITERATIONS]
            status, self._next = grow_cells.unchecked(
                self.space.arrays,
                self.trees,
                self._grids,
                self._shifts[:last],
                self._chances[:last],
                self._next,
                int(most),
                2.5,
            )
            left -= int(self.space.arrays.counters[ITERATIONS] - before)
            self.space.reraise()
            if status == FULL:
                longest = len(self._grids.motion)
                if self.trees.size.max() + 2 * longest >= self.trees.nodes.shape[1]:
                    self.trees = enlarged_trees(self.trees)
                if self._grids.known.max() + 2 * longest >= self._grids.place.shape[1]:
                    self._grids = _enlarged(self._grids)
            elif status == CONNECTED:
                path = checked_tree_path(self.space, self.trees)
                self.space.reraise()
                if path is not None:
                    return path
        return None

    def _draw(self, count: int) -> None:
        """Draw what the next walks do: lengths from 0.03 to 0.3 rad a joint."""
        n = len(self._scale)
        length = 0.03 * 10.0 ** self._rng.random((count, 1))
        self._shifts = length * self._scale * self._rng.standard_normal((count, n))
        self._chances = self._rng.random((count, 3))
        self._next = 0


@dataclass(frozen=True)
class CellSearch:
    """Trees of cells as a planner's search."""

    def search(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        distribution: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n); see `Search`.

        The distribution is not used: walks start from nodes.
        """
        began = time.perf_counter()
        deadline = np.inf if budget.seconds is None else began + budget.seconds
        before = space.counters
        growth = CellTrees(space, start, goals, rng)
        path = growth.grow(np.inf, budget.iterations, deadline)
        late = time.perf_counter() >= deadline
        failed = PlanStatus.TIMEOUT if late else PlanStatus.ITERATION_LIMIT
        trees = growth.trees
        return PlanResult(
            status=PlanStatus.SOLVED if path is not None else failed,
            path=path,
            seconds=time.perf_counter() - began,
            counters=space.counters_since(before),
            vertices=int(trees.size.sum()),
            sampler="cells",
            trees=tuple(
                Tree(trees.nodes[k, :size], trees.parent[k, :size])
                for k, size in enumerate(trees.size)
            ),
        )
