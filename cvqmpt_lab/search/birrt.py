"""Algorithm 3 of the paper: a bidirectional RRT on the constraint manifold.

    repeat until the trees meet or the budget is spent:
        q_rand <- sample(q)
        q_a <- ConstrainedExtend(T_a, NearestNode(T_a, q_rand), q_rand)
        q_b <- ConstrainedExtend(T_b, NearestNode(T_b, q_rand), q_rand)
        if ConstrainedExtend(T_b, q_b, q_a) reaches q_a:
            return Path(T_a, q_a, T_b, q_b)
        Swap(T_a, T_b)

Samples come from any distribution; with the uniform one this is CBiRRT. A draw is projected
(F(q) = 0, paper, Algorithm 1) before the trees extend towards it, as the paper does ("Generating
samples"). One that cannot be projected is drawn again. Every state of an extension is projected and
checked, too. A path found is checked finely; a motion that hits an obstacle between its states is
cut out of its tree, and the search goes on.
"""

import time
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.search.motion import (
    DEVIATION,
    DRAW_NEWTON_ITERATIONS,
    DRAW_PROJECTIONS,
    EXTENSIONS,
    ITERATIONS,
    NEWTON_ITERATIONS,
    PROJECTIONS,
    REACHED,
    STOPPED,
    Space,
    distance,
    posed_state_valid,
    project_state,
    step_towards,
)
from cvqmpt_lab.search.nearest import (
    NearestIndex,
    enlarged_index,
    index_new_nodes,
    nearest_index,
    nearest_node,
)
from cvqmpt_lab.search.planner_interface import Deadline, SamplingDistribution
from cvqmpt_lab.search.result import Budget, JointPath, PlanResult, Tree
from cvqmpt_lab.search.space import ConstrainedSpace

GROWING, CONNECTED, FULL = range(3)
RAW, PROJECTED, FREE = range(3)
DRAWS = {"raw": RAW, "projected": PROJECTED, "free": FREE}
"""What is done with a draw before the trees extend towards it: nothing; it is projected (paper); it
is projected, and drawn again if it collides."""
REMOVED = 1e6  # [rad] where a removed node is put, so that it is never nearest


class Trees(NamedTuple):
    """Two trees; row 0 grows from the start, row 1 from the goals."""

    nodes: Annotated[np.ndarray, "2 capacity n"]  # configurations [rad or m]
    parent: Annotated[np.ndarray, "int64 2 capacity"]  # -1 for roots
    size: Annotated[np.ndarray, "int64 2"]  # nodes in each
    meeting: Annotated[np.ndarray, "int64 2"]  # the nodes that met when CONNECTED
    turn: Annotated[np.ndarray, "int64 1"]  # which tree extends first
    nearest: NearestIndex  # for nearest nodes


def plant(start: np.ndarray, goals: np.ndarray, capacity: int) -> Trees:
    """Trees with a start (n,) and goals (k, n) as roots, of `capacity` nodes each, at least 4 k."""
    capacity = max(capacity, 4 * len(goals))
    trees = Trees(
        nodes=np.empty((2, capacity, len(start))),
        parent=np.full((2, capacity), -1, dtype=np.int64),
        size=np.array([1, len(goals)]),
        meeting=np.zeros(2, dtype=np.int64),
        turn=np.zeros(1, dtype=np.int64),
        nearest=nearest_index(capacity, len(start)),
    )
    trees.nodes[0, 0] = start
    trees.nodes[1, : len(goals)] = goals
    return trees


def enlarged_trees(trees: Trees) -> Trees:
    """The same trees with room for twice as many nodes."""
    nodes = np.concatenate([trees.nodes, np.empty_like(trees.nodes)], axis=1)
    parent = np.concatenate([trees.parent, np.full_like(trees.parent, -1)], axis=1)
    nearest = enlarged_index(trees.nearest, nodes.shape[1])
    return trees._replace(nodes=nodes, parent=parent, nearest=nearest)


@kernel(inline="source")
def extend(space, nodes, parent, size, which, origin, target, reach):
    """ConstrainedExtend: extend from node `origin` towards target (n,) by at most `reach` [rad].

    Adds every state. Returns the index of the last node, and whether the target was reached.
    """
    start = distance(nodes[origin], target)
    if start < 1e-9:
        return origin, True
    longest = min(DEVIATION * start, reach)  # that is left of the extension
    node = origin
    while True:
        new = size[which]
        outcome = step_towards(space, nodes[node], target, longest, nodes[new])
        if outcome == STOPPED:
            return node, False
        parent[new] = node
        size[which] = new + 1
        longest -= distance(nodes[node], nodes[new])
        node = new
        if outcome == REACHED:
            return node, True
        if new + 2 >= nodes.shape[0]:
            return node, False


@kernel(inline="source")
def usable(space, q, draws):
    """Make a draw q (n,) a sample, in place, see DRAWS; False: it must be drawn again."""
    if draws == RAW:
        return True
    counters = space.counters
    projections, steps = counters[PROJECTIONS], counters[NEWTON_ITERATIONS]
    projected = project_state(space, q)
    counters[DRAW_PROJECTIONS] += counters[PROJECTIONS] - projections
    counters[DRAW_NEWTON_ITERATIONS] += counters[NEWTON_ITERATIONS] - steps
    if not projected:
        return False
    return draws == PROJECTED or posed_state_valid(space, q, 0.0)


@entry
def grow(
    space: Space,
    trees: Trees,
    samples: Annotated[np.ndarray, "count n"],
    first: int,
    reach: float,
    draws: int,
):
    """Grow both trees towards samples[first:] (m, n) until they meet.

    Args:
        space: the planning space; each draw counts as an iteration, also one that is drawn again.
        trees: from the start and from the goals.
        samples: draws [rad or m]; those used are projected in place.
        first: index of the first to use.
        reach: of extensions towards a sample, at most [rad].
        draws: a value of DRAWS.

    Returns:
        GROWING (samples used up), CONNECTED (trees.meeting holds the nodes) or FULL (capacity used
        up), the index of the next unused sample, and the number of draws that were used as samples.
    """
    reserve = trees.nodes.shape[1] // 4
    nodes, parent, size = trees.nodes, trees.parent, trees.size
    used = 0
    for i in range(first, samples.shape[0]):
        if max(size[0], size[1]) + reserve >= nodes.shape[1]:
            return FULL, i, used
        space.counters[ITERATIONS] += 1
        if not usable(space, samples[i], draws):
            continue
        used += 1
        a = trees.turn[0]
        b = 1 - a
        trees.turn[0] = b  # Swap
        node_a, node_b, met = 0, 0, False
        # tree a to the sample, tree b to the sample, tree b to tree a: one call site
        for stage in range(3):
            tree = a if stage == 0 else b
            target = samples[i] if stage < 2 else nodes[a, node_a]
            if stage == 2:
                near = node_b
            else:
                index_new_nodes(trees.nearest, tree, nodes[tree], size[tree])
                near = nearest_node(trees.nearest, tree, nodes[tree], size[tree], target)
            limit = reach if stage < 2 else np.inf
            nodes_before = size[tree]
            node, met = extend(space, nodes[tree], parent[tree], size, tree, near, target, limit)
            space.counters[EXTENSIONS] += size[tree] > nodes_before
            if stage == 0:
                node_a = node
            else:
                node_b = node
        if met:
            trees.meeting[a] = node_a
            trees.meeting[b] = node_b
            return CONNECTED, i + 1, used
    return GROWING, samples.shape[0], used


@entry
def extract_path(
    trees: Trees,
    out: Annotated[np.ndarray, "longest n"],
    origin: Annotated[np.ndarray, "int64 longest 2"],
):
    """Write the path's k states into out (k, n), their (tree, node) into origin; return k.

    out and origin have as many rows as both trees have nodes.
    """
    count, node = 0, trees.meeting[0]
    while node >= 0:
        origin[count, 0], origin[count, 1] = 0, node
        count += 1
        node = trees.parent[0, node]
    for i in range(count // 2):
        swap = origin[i, 1]
        origin[i, 1] = origin[count - 1 - i, 1]
        origin[count - 1 - i, 1] = swap
    node = trees.parent[1, trees.meeting[1]]  # the meeting state itself stands in both trees
    while node >= 0:
        origin[count, 0], origin[count, 1] = 1, node
        count += 1
        node = trees.parent[1, node]
    for i in range(count):
        for j in range(out.shape[1]):
            out[i, j] = trees.nodes[origin[i, 0], origin[i, 1], j]
    return count


@kernel
def remove_subtree(trees, which, root):
    """Take node root of one tree and all its descendants out of the search."""
    nodes, parent = trees.nodes[which], trees.parent[which]
    nodes[root, 0] = REMOVED
    for i in range(root + 1, trees.size[which]):
        if parent[i] >= 0 and nodes[parent[i], 0] == REMOVED:
            nodes[i, 0] = REMOVED


@entry
def remove_child_of_segment(
    trees: Trees, origin: Annotated[np.ndarray, "int64 longest 2"], segment: int
):
    """Cut the motion from path state segment to the next; origin is from `extract_path`."""
    later_in_start_tree = origin[segment + 1, 0] == 0
    if later_in_start_tree:
        remove_subtree(trees, 0, origin[segment + 1, 1])
    elif origin[segment, 0] == 1:
        remove_subtree(trees, 1, origin[segment, 1])
    else:
        remove_subtree(trees, 1, trees.meeting[1])


@dataclass(frozen=True)
class BiRRT:
    """The bidirectional tree of Algorithm 3."""

    # [rad] between neighbouring nodes; a found path is refined to the space's own step
    step: float = 0.15
    # [rad] longest extension towards a sample. Algorithm 3 has no limit (inf); 1 is best for
    # uniform samples on the tuning environments
    reach: float = 1.0
    draws: str = "projected"  # a key of DRAWS

    def __post_init__(self) -> None:
        if self.draws not in DRAWS:
            raise UnknownChoiceError("draws of a tree search", self.draws, DRAWS)
        if not self.reach > 0.0:
            raise InvalidInputError(
                f"reach {self.reach}: give the longest extension towards a sample [rad], above 0; "
                "inf is no limit, as the paper prints it"
            )

    def search(
        self,
        space: ConstrainedSpace,
        start: np.ndarray,
        goals: np.ndarray,
        distribution: SamplingDistribution,
        budget: Budget,
        rng: np.random.Generator,
    ) -> PlanResult:
        """Search a path from start (n,) to any row of goals (k, n); see `Search`."""
        deadline = Deadline(budget, space)
        growth = GrowingTrees(self, space, plant(start, goals, capacity=4096), distribution, rng)
        path = growth.grow(np.inf, budget.iterations, deadline.clock)
        return deadline.result(path, shown(growth.trees), distribution.name, growth.complaint)


class GrowingTrees:
    """Two trees that grow in slices of work.

    Args:
        method: says how they are grown.
        space: the planning space.
        trees: to grow.
        distribution: that samples are drawn from.
        rng: of all draws.
    """

    def __init__(
        self,
        method: BiRRT,
        space: ConstrainedSpace,
        trees: Trees,
        distribution: SamplingDistribution,
        rng: np.random.Generator,
    ) -> None:
        self.trees = trees
        self._method, self._space, self._distribution, self._rng = method, space, distribution, rng
        self._drawn, self._next, self._batch = np.empty((0, trees.nodes.shape[2])), 0, 16
        self._draws = self._used = 0

    @property
    def complaint(self) -> str:
        """That no draw could be used, or ""."""
        unused = self._draws and not self._used
        return f"none of {self._draws} draws reached the constraint" if unused else ""

    def draw_from(self, distribution: SamplingDistribution, first: np.ndarray) -> None:
        """From now on, draw from another distribution, after some draws (k, n) that are given."""
        self._distribution, self._drawn, self._next = distribution, first.copy(), 0

    def grow(
        self, work: float, iterations: int | None = None, deadline: float = np.inf
    ) -> JointPath | None:
        """Grow for so much more work, so many iterations, or until a clock time, or to a path.

        Args:
            work: as `ConstrainedSpace.work` counts it.
            iterations: draws.
            deadline: of time.perf_counter() [s].

        Returns:
            A path that passed the fine check, or None.
        """
        arrays = self._space.arrays._replace(step=self._method.step)
        most, left = self._space.work + work, np.inf if iterations is None else iterations
        # draws used before work and clock are read
        part = 4 if work < np.inf else 16
        while left > 0 and self._space.work < most and time.perf_counter() < deadline:
            if self._next == len(self._drawn):
                # a copy: draws are projected in place
                count = int(min(self._batch, left))
                self._drawn = np.array(self._distribution.sample(self._rng, count), order="C")
                self._next, self._batch = 0, min(2 * self._batch, 256)
            first = self._next
            status, self._next, used = grow.unchecked(
                arrays,
                self.trees,
                self._drawn[: first + int(min(part, left))],
                first,
                self._method.reach,
                DRAWS[self._method.draws],
            )
            left -= self._next - first
            self._draws += self._next - first
            self._used += used
            self._space.reraise()
            if status == FULL:
                self.trees = enlarged_trees(self.trees)
            elif status == CONNECTED:
                path = checked_tree_path(self._space, self.trees)
                self._space.reraise()
                if path is not None:
                    return path
        return None


def shown(trees: Trees) -> tuple[Tree, Tree]:
    """Both trees without their work arrays."""
    (own, other), (a, b), parent = trees.nodes, trees.size, trees.parent
    return Tree(own[:a], parent[0, :a]), Tree(other[:b], parent[1, :b])


def checked_tree_path(space: ConstrainedSpace, trees: Trees) -> JointPath | None:
    """The path through the meeting nodes; None if its fine check fails: that motion is cut out."""
    capacity = int(trees.size.sum())
    states = np.empty((capacity, trees.nodes.shape[2]))
    origin = np.empty((capacity, 2), dtype=np.int64)
    count = extract_path.unchecked(trees, states, origin)
    path, bad = space.checked_path(states[:count])
    if path is None:
        remove_child_of_segment.unchecked(trees, origin, bad)
    return path
