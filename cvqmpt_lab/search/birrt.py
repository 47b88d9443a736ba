"""Algorithm 3 of the paper: a bidirectional RRT on the constraint manifold, with samples of any distribution.

    repeat until the trees meet or the budget is spent:
        q_rand <- sample(q)                                  the predicted mixture, or uniform: then this is CBiRRT
        q_a <- ConstrainedExtend(T_a, NearestNode(T_a, q_rand), q_rand)
        q_b <- ConstrainedExtend(T_b, NearestNode(T_b, q_rand), q_rand)
        if ConstrainedExtend(T_b, q_b, q_a) reaches q_a: return Path(T_a, q_a, T_b, q_b)
        Swap(T_a, T_b)

Every state is projected (F(q) = 0, paper, Algorithm 1) and checked. A path found is then checked at fine resolution; a
motion that grazes an obstacle between its states is cut out of its tree, and the search goes on.
"""

import time
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.kernels.search import tree_growth as kernels
from cvqmpt_lab.search.result import Budget, JointPath, PlanResult, PlanStatus, Tree
from cvqmpt_lab.search.space import ConstrainedSpace

FIRST_CAPACITY = 4096  # nodes a tree has room for at first
FIRST_BATCH, LARGEST_BATCH = 16, 256  # samples drawn at once
BETWEEN_LOOKS = 16  # samples used between looks at the clock, where a budget has seconds


@dataclass(frozen=True)
class BiRRT:
    """Bidirectional tree growth on the manifold."""

    extend_both: bool = True  # Algorithm 3; False: the second tree extends to q_a at once, as in CBiRRT
    step: float = 0.15  # [rad] between neighbouring nodes; a found path is refined to the space's own step
    reach: float = 1.0  # [rad] longest extension towards a sample; chosen on the tuning environments

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
        began = time.perf_counter()
        deadline = np.inf if budget.seconds is None else began + budget.seconds
        before = space.counters
        trees = kernels.plant(start, goals, FIRST_CAPACITY)
        status, path = PlanStatus.TIMEOUT, None
        used, batch = 0, FIRST_BATCH
        while path is None:
            if time.perf_counter() >= deadline:
                break
            count = batch if budget.iterations is None else min(batch, budget.iterations - used)
            if count <= 0:
                status = PlanStatus.ITERATION_LIMIT
                break
            samples = distribution.sample(rng, count)
            trees, path = self._use(space, trees, samples, deadline)
            used, batch = used + count, min(2 * batch, LARGEST_BATCH)
        return PlanResult(
            status=PlanStatus.SOLVED if path is not None else status,
            path=path,
            seconds=time.perf_counter() - began,
            counters=space.counters_since(before),
            vertices=int(trees.size.sum()),
            sampler=distribution.name,
            trees=tuple(
                Tree(trees.nodes[k, :size], trees.parent[k, :size]) for k, size in enumerate(trees.size)
            ),
        )

    def _use(self, space: ConstrainedSpace, trees: kernels.Trees, samples: np.ndarray, deadline: float):
        """Grow with one batch until the deadline; the trees, and a path that passed the fine check or None."""
        arrays = space.arrays._replace(step=self.step)
        most = len(samples) if deadline == np.inf else BETWEEN_LOOKS
        first = 0
        while first < len(samples) and time.perf_counter() < deadline:
            part = samples[: first + most]
            status, first = kernels.grow(arrays, trees, part, first, self.extend_both, self.reach)
            space.reraise()
            if status == kernels.FULL:
                trees = kernels.enlarged(trees)
            elif status == kernels.CONNECTED:
                path = checked_tree_path(space, trees)
                space.reraise()
                if path is not None:
                    return trees, path
        return trees, None


def checked_tree_path(space: ConstrainedSpace, trees: kernels.Trees) -> JointPath | None:
    """The path through the meeting nodes, or None after cutting its first grazing motion out."""
    capacity = int(trees.size.sum())
    states = np.empty((capacity, trees.nodes.shape[2]))
    origin = np.empty((capacity, 2), dtype=np.int64)
    count = kernels.extract_path(trees, states, origin)
    path, bad = space.checked_path(states[:count])
    if path is None:
        kernels.remove_child_of_segment(trees, origin, bad)
    return path
