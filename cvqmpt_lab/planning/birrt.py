"""The project's own constrained bidirectional planner (paper, Algorithm 3): any SamplingDistribution.

With uniform samples it is CBiRRT (Berenson et al. 2011). Samples are drawn in batches and handed to
the compiled tree growth; a found path is checked at fine resolution, and a motion that grazes an
obstacle between its states is cut out of its tree, upon which the search goes on.
"""

import time
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.distributions import SamplingDistribution
from cvqmpt_lab.kernels.search import tree_growth as kernels
from cvqmpt_lab.planning.result import Budget, Path, PlanResult, PlanStatus, Tree
from cvqmpt_lab.planning.space import ConstrainedSpace

FIRST_CAPACITY = 4096  # nodes a tree has room for at first
FIRST_BATCH, LARGEST_BATCH = 16, 256  # samples handed over at once: keeps the clock fine


@dataclass(frozen=True)
class BiRRT:
    """Bidirectional tree growth on the manifold.

    Attributes
    ----------
    extend_both: both trees walk to the sample before they are connected, as in Algorithm 3; otherwise
        the second tree walks to where the first one stopped, as in CBiRRT.
    step: between neighbouring nodes [rad]; a found path is then mended to the space's own step.
    reach: longest walk towards a sample [rad]; connecting walks are not limited. Chosen on the tuning
        environments, see docs/performance.md.
    """

    extend_both: bool = True
    step: float = 0.15
    reach: float = 1.0

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
        before = space.counters
        trees = _plant(start, goals)
        status, path = PlanStatus.TIMEOUT, None
        used, batch = 0, FIRST_BATCH
        while path is None:
            if budget.seconds is not None and time.perf_counter() - began >= budget.seconds:
                break
            count = batch if budget.iterations is None else min(batch, budget.iterations - used)
            if count <= 0:
                status = PlanStatus.ITERATION_LIMIT
                break
            samples = distribution.sample(rng, count)
            trees, path = self._use(space, trees, samples)
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

    def _use(self, space: ConstrainedSpace, trees: kernels.Trees, samples: np.ndarray):
        """Grow with one batch of samples; the trees, and a path that passed the fine check or None."""
        arrays = space.arrays._replace(step=self.step)
        first = 0
        while first < len(samples):
            status, first = kernels.grow(arrays, trees, samples, first, self.extend_both, self.reach)
            space.reraise()
            if status == kernels.FULL:
                trees = _enlarged(trees)
            elif status == kernels.CONNECTED:
                path = _checked_path(space, trees)
                space.reraise()
                if path is not None:
                    return trees, path
        return trees, None


def _plant(start: np.ndarray, goals: np.ndarray) -> kernels.Trees:
    """Trees with the start and the goals as roots."""
    capacity = max(FIRST_CAPACITY, 4 * len(goals))
    trees = kernels.Trees(
        nodes=np.empty((2, capacity, len(start))),
        parent=np.full((2, capacity), -1, dtype=np.int64),
        size=np.array([1, len(goals)]),
        meeting=np.zeros(2, dtype=np.int64),
        turn=np.zeros(1, dtype=np.int64),
    )
    trees.nodes[0, 0] = start
    trees.nodes[1, : len(goals)] = goals
    return trees


def _enlarged(trees: kernels.Trees) -> kernels.Trees:
    """The same trees with twice the room."""
    nodes = np.concatenate([trees.nodes, np.empty_like(trees.nodes)], axis=1)
    parent = np.concatenate([trees.parent, np.full_like(trees.parent, -1)], axis=1)
    return trees._replace(nodes=nodes, parent=parent)


def _checked_path(space: ConstrainedSpace, trees: kernels.Trees) -> Path | None:
    """The path through the meeting nodes, or None after cutting its first grazing motion out."""
    capacity = int(trees.size.sum())
    states = np.empty((capacity, trees.nodes.shape[2]))
    origin = np.empty((capacity, 2), dtype=np.int64)
    count = kernels.extract_path(trees, states, origin)
    path, bad = space.checked_path(states[:count])
    if path is None:
        kernels.remove_child_of_segment(trees, origin, bad)
    return path
