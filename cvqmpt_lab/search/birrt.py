"""Algorithm 3 of the paper: a bidirectional RRT on the constraint manifold.

    repeat until the trees meet or the budget is spent:
        q_rand <- sample(q)
        q_a <- ConstrainedExtend(T_a, NearestNode(T_a, q_rand), q_rand)
        q_b <- ConstrainedExtend(T_b, NearestNode(T_b, q_rand), q_rand)
        if ConstrainedExtend(T_b, q_b, q_a) reaches q_a:
            return Path(T_a, q_a, T_b, q_b)
        Swap(T_a, T_b)

Samples come from any distribution; with the uniform one this is CBiRRT. A draw is projected
(F(q) = 0, paper, Algorithm 1) before the trees extend towards it, as in the paper ("Generating
samples"); if the projection fails, another draw is made. Every state of an extension is projected
and checked as well. A path between both trees is then checked finely. If a motion of it collides
between its states, the motion is removed from its tree and the search continues; motions that were
proven to be free are not checked again.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.base.jit import entry, kernel, placed
from cvqmpt_lab.search.motion import (
    DRAW_NEWTON_ITERATIONS,
    DRAW_PROJECTIONS,
    EXTENSIONS,
    ITERATIONS,
    MAX_LENGTH_RATIO,
    NEWTON_ITERATIONS,
    PROJECTIONS,
    SAME_STATE_RAD,
    TARGET_REACHED,
    TRAPPED,
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
from cvqmpt_lab.search.planner_interface import Deadline, Query, SamplingDistribution
from cvqmpt_lab.search.result import JointPath, PlanResult, Tree
from cvqmpt_lab.search.space import ConstrainedSpace

GROWING, CONNECTED, FULL = range(3)
RAW_DRAW, PROJECTED_DRAW, FREE_DRAW = range(3)
DRAW_MODES = {"raw": RAW_DRAW, "projected": PROJECTED_DRAW, "free": FREE_DRAW}
"""How a draw becomes a sample. raw: unchanged. projected: projected onto the manifold, as in the
paper. free: projected; a draw in collision is not used."""
REMOVED_NODE_RAD = 1e6  # first coordinate of a removed node, so that it is never the nearest one


class Trees(NamedTuple):
    """Two trees; row 0 grows from the start, row 1 from the goals."""

    nodes: Annotated[np.ndarray, "2 capacity n"]  # configurations [rad or m]
    parent: Annotated[np.ndarray, "int64 2 capacity"]  # -1 for roots
    # whether the motion from the parent was refined and proven to be free
    proven: Annotated[np.ndarray, "bool 2 capacity"]
    size: Annotated[np.ndarray, "int64 2"]  # number of nodes in each tree
    meeting: Annotated[np.ndarray, "int64 2"]  # one node of each tree, equal, when CONNECTED
    turn: Annotated[np.ndarray, "int64 1"]  # row of the tree that extends next
    nearest: NearestIndex  # for searches of nearest nodes


def plant(start: np.ndarray, goals: np.ndarray, capacity: int) -> Trees:
    """Return trees with a start (n,) and goals (k, n) as roots.

    Each has space for `capacity` nodes, but at least for 4 k.
    """
    capacity = max(capacity, 4 * len(goals))
    trees = Trees(
        nodes=np.empty((2, capacity, len(start))),
        parent=np.full((2, capacity), -1, dtype=np.int64),
        proven=np.zeros((2, capacity), dtype=bool),
        size=np.array([1, len(goals)]),
        meeting=np.zeros(2, dtype=np.int64),
        turn=np.zeros(1, dtype=np.int64),
        nearest=nearest_index(capacity, len(start)),
    )
    trees.nodes[0, 0] = start
    trees.nodes[1, : len(goals)] = goals
    return trees


def enlarged_trees(trees: Trees, most_bytes: int = 2**30) -> Trees:
    """Return the same trees with space for twice as many nodes.

    Raises:
        MemoryError: their nodes would take more than `most_bytes`.
    """
    if 2 * trees.nodes.nbytes > most_bytes:
        raise MemoryError(
            f"trees of {int(trees.size.sum())} nodes, which have not met, may not grow beyond "
            f"{most_bytes / 2**30:.2g} GiB; give a smaller cutoff or another planner"
        )
    nodes = np.concatenate([trees.nodes, np.empty_like(trees.nodes)], axis=1)
    parent = np.concatenate([trees.parent, np.full_like(trees.parent, -1)], axis=1)
    proven = np.concatenate([trees.proven, np.zeros_like(trees.proven)], axis=1)
    nearest = enlarged_index(trees.nearest, nodes.shape[1])
    return trees._replace(nodes=nodes, parent=parent, proven=proven, nearest=nearest)


@kernel(inline="source")
def extend(space, nodes, parent, size, which, origin, target, reach):
    """ConstrainedExtend: extend one tree towards a target; every state becomes a node.

    Args:
        space: the planning space.
        nodes: nodes of this tree (capacity, n) [rad or m].
        parent: parents in this tree (capacity,).
        size: number of nodes of both trees.
        which: row of this tree.
        origin: node to extend from.
        target: (n,) [rad or m].
        reach: largest length of the extension [rad].

    Returns:
        The last node, and whether the target was reached.
    """
    start = distance(nodes[origin], target)
    if start < SAME_STATE_RAD:
        return origin, True
    longest = min(MAX_LENGTH_RATIO * start, reach)  # remaining length of the extension
    node = origin
    while True:
        new = size[which]
        outcome = step_towards(space, nodes[node], target, longest, nodes[new])
        if outcome == TRAPPED:
            return node, False
        parent[new] = node
        size[which] = new + 1
        longest -= distance(nodes[node], nodes[new])
        node = new
        if outcome == TARGET_REACHED:
            return node, True
        if new + 2 >= nodes.shape[0]:
            return node, False


@kernel(inline="source")
def make_sample(space, q, draws):
    """Turn a draw q (n,) into a sample, in place.

    Args:
        space: the planning space.
        q: draw [rad or m].
        draws: a value of DRAW_MODES.

    Returns:
        False if the draw cannot be used.
    """
    if draws == RAW_DRAW:
        return True
    counters = space.counters
    projections, steps = counters[PROJECTIONS], counters[NEWTON_ITERATIONS]
    projected = project_state(space, q)
    counters[DRAW_PROJECTIONS] += counters[PROJECTIONS] - projections
    counters[DRAW_NEWTON_ITERATIONS] += counters[NEWTON_ITERATIONS] - steps
    if not projected:
        return False
    return draws == PROJECTED_DRAW or posed_state_valid(space, q)


@entry
def grow(
    space: Space,
    trees: Trees,
    samples: Annotated[np.ndarray, "count n"],
    first: int,
    reach: float,
    draws: int,
):
    """Grow both trees towards samples[first:] until they meet.

    Args:
        space: the planning space; each draw counts as an iteration, also one that cannot be used.
        trees: trees from the start and from the goals.
        samples: draws (count, n) [rad or m]; they become samples in place.
        first: row of the first draw.
        reach: largest length of an extension towards a sample [rad].
        draws: a value of DRAW_MODES.

    Returns:
        GROWING (no draw is left), CONNECTED (trees.meeting holds the nodes) or FULL (no space for
        more nodes); the row of the next draw; and the number of draws that became samples.
    """
    space = placed(space)
    reserve = trees.nodes.shape[1] // 4
    nodes, parent, size = trees.nodes, trees.parent, trees.size
    used = 0
    for i in range(first, samples.shape[0]):
        if max(size[0], size[1]) + reserve >= nodes.shape[1]:
            return FULL, i, used
        space.counters[ITERATIONS] += 1
        if not make_sample(space, samples[i], draws):
            continue
        used += 1
        a = trees.turn[0]
        b = 1 - a
        trees.turn[0] = b  # Swap
        node_a, node_b, met = 0, 0, False
        # tree a to the sample, tree b to the sample, tree b to tree a: a loop, so that `extend` is
        # compiled once
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
    child: Annotated[np.ndarray, "int64 longest 2"],
):
    """Write the path through the meeting nodes.

    Args:
        trees: CONNECTED ones.
        out: states of the path [rad or m], written; as many rows as both trees have nodes.
        child: written for each motion between two states: its tree, and its node that is further
            from the root.

    Returns:
        Number of states of the path.
    """
    depth, node = 0, trees.meeting[0]
    while trees.parent[0, node] >= 0:
        depth, node = depth + 1, trees.parent[0, node]
    node = trees.meeting[0]
    for i in range(depth, -1, -1):
        for j in range(out.shape[1]):
            out[i, j] = trees.nodes[0, node, j]
        if i > 0:
            child[i - 1, 0], child[i - 1, 1] = 0, node
        node = trees.parent[0, node]
    count, node = depth + 1, trees.meeting[1]  # the meeting state is a node of both trees
    while trees.parent[1, node] >= 0:
        child[count - 1, 0], child[count - 1, 1] = 1, node
        node = trees.parent[1, node]
        for j in range(out.shape[1]):
            out[count, j] = trees.nodes[1, node, j]
        count += 1
    return count


@entry
def remove_subtree(trees: Trees, which: int, root: int):
    """Exclude the node `root` of a tree and all its descendants from the search."""
    nodes, parent, nearest = trees.nodes[which], trees.parent[which], trees.nearest
    nearest.copied[which] = nearest.indexed[which]
    nodes[root, 0] = REMOVED_NODE_RAD
    for i in range(root + 1, trees.size[which]):
        if parent[i] >= 0 and nodes[parent[i], 0] == REMOVED_NODE_RAD:
            nodes[i, 0] = REMOVED_NODE_RAD


@dataclass(frozen=True)
class BiRRT:
    """Settings of the bidirectional tree search of Algorithm 3."""

    # largest distance of neighbouring nodes [rad]; a path is refined to the space's step
    step: float = 0.15
    # longest extension towards a sample [rad]. Algorithm 3 has no limit (inf); 1 is best for
    # uniform samples on the tuning environments
    reach: float = 1.0
    draws: str = "projected"  # a key of DRAW_MODES

    def __post_init__(self) -> None:
        if self.draws not in DRAW_MODES:
            raise UnknownChoiceError("draws of a tree search", self.draws, DRAW_MODES)
        if not self.reach > 0.0:
            raise InvalidInputError(
                f"reach {self.reach}: give the longest extension towards a sample [rad], above 0; "
                "inf means no limit, as in the paper"
            )

    def search(self, query: Query, distribution: SamplingDistribution) -> PlanResult:
        """Search a path from the query's start to any of its goals, see `Search`."""
        deadline = query.deadline
        growth = GrowingTrees(self, query, distribution)
        path = growth.grow(deadline)
        trees = result_trees(growth.trees)
        return deadline.result(path, trees, distribution.name, growth.warning)


class GrowingTrees:
    """Two trees that grow in several calls of `grow`.

    Args:
        method: settings of the search.
        query: its start and goals are the roots.
        distribution: sampling distribution.
    """

    def __init__(self, method: BiRRT, query: Query, distribution: SamplingDistribution) -> None:
        self.trees = plant(query.start, query.goals, capacity=4096)
        self._method, self._space, self._rng = method, query.space, query.rng
        self._distribution = distribution
        self._drawn = np.empty((0, len(query.start)))  # draws; `grow` makes samples of them
        self._next = 0  # row of the next draw
        self._batch = 16  # number of draws that are made next
        self._draws = self._used = 0  # number of draws, and of draws that became samples

    @property
    def warning(self) -> str:
        """Message if no draw could be projected onto the constraint, else ""."""
        unused = self._draws and not self._used
        return f"none of {self._draws} draws reached the constraint" if unused else ""

    def draw_from(self, distribution: SamplingDistribution, first: np.ndarray) -> None:
        """Set the sampling distribution; the draws `first` (k, n) [rad or m] are used before it."""
        self._distribution, self._drawn, self._next = distribution, first.copy(), 0

    def grow(
        self, deadline: Deadline, work: float = np.inf, iterations: float = np.inf
    ) -> JointPath | None:
        """Grow until the budget or another limit is reached or the trees connect.

        Args:
            deadline: the budget.
            work: limit of the work of this call, in units of `ConstrainedSpace.work`.
            iterations: limit of the draws of this call.

        Returns:
            A path that passed the fine check, or None.
        """
        arrays = self._space.arrays._replace(step=self._method.step)
        most = self._space.work + work
        left = min(iterations, deadline.iterations_left)
        part = 4 if work < np.inf else 16  # number of draws before work and clock are read
        if deadline.budget.cost is not None:
            part = 1
        while left > 0 and self._space.work < most and not deadline.late:
            if self._next == len(self._drawn):
                # a copy, because draws are projected in place
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
                DRAW_MODES[self._method.draws],
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


def result_trees(trees: Trees) -> tuple[Tree, Tree]:
    """Return both trees as a `PlanResult` holds them, without work arrays."""
    first, second = trees.size
    return (
        Tree(trees.nodes[0, :first], trees.parent[0, :first]),
        Tree(trees.nodes[1, :second], trees.parent[1, :second]),
    )


def checked_tree_path(space: ConstrainedSpace, trees: Trees) -> JointPath | None:
    """Return the path through the meeting nodes if it passes the fine check.

    Otherwise remove the motion that fails from its tree and return None. What is proven is kept in
    the trees and not proven again.
    """
    capacity = int(trees.size.sum())
    states = np.empty((capacity, trees.nodes.shape[2]))
    child = np.empty((capacity, 2), dtype=np.int64)
    count = extract_path.unchecked(trees, states, child)
    tree, node = child[: count - 1].T
    proven = trees.proven[tree, node]
    # from the roots on: motions behind one that fails would be proven in vain
    path, bad = space.checked_path(states[:count], proven, middle=int((tree == 0).sum()))
    trees.proven[tree, node] = proven
    if path is None:
        remove_subtree.unchecked(trees, int(tree[bad]), int(node[bad]))
    return path
