"""The search of planner `roadmap`: trees, a roadmap and cells take turns, by counts of work.

    1. trees of Algorithm 3 grow for a few iterations: easy problems end here;
    2. the roadmap is searched while it promises something (`lazy_roadmap`);
    3. trees grow on, the start's from what the roadmap found free;
    4. trees that walk from rarely chosen cells take turns with them, for narrow passages.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from cvqmpt_lab.jit import entry
from cvqmpt_lab.search.birrt import BiRRT, GrowingTrees, Trees, plant
from cvqmpt_lab.search.cell_trees import CellTrees
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.lazy_roadmap import FREE, RoadmapArrays
from cvqmpt_lab.search.planner_interface import Deadline, GaussianMixture, SamplingDistribution
from cvqmpt_lab.search.result import Budget, PlanResult, PlanStatus
from cvqmpt_lab.search.roadmap import Roadmap, RoadmapQuery, RoadmapSearchSettings, scene_costs
from cvqmpt_lab.search.space import ConstrainedSpace

X = dict(first=4, promise=1500, seed=1, draws=0, mix=0, searches=40, again=0, between=3000, dear=np.inf)
X.update(eval(os.environ.get("PX", "{}")))


@entry
def graft(
    roadmap: RoadmapArrays,
    trees: Trees,
    tree: int,
    root: int,
    row: int,
    rows: Annotated[np.ndarray, "int64 total"],
    place: Annotated[np.ndarray, "int64 total"],
):
    """Add to a tree what free edges lead to from a row of the roadmap.

    Args:
        roadmap: with verdicts.
        trees: to add to, with room for all its rows.
        tree: which.
        root: its node that is the row.
        row: the start or a goal.
        rows: work array.
        place: the node of each row in a tree, or -1; written.
    """
    inner, k = roadmap.neighbours.shape
    nodes, parent, size = trees.nodes[tree], trees.parent[tree], trees.size
    rows[0], place[row] = row, root
    done, found = 0, 1
    while done < found:
        here = rows[done]
        done += 1
        for other in range(inner):
            free = False
            if here < inner:
                for slot in range(k):
                    there = roadmap.neighbours[here, slot]
                    free = free or (there == other and roadmap.edge[here, slot] == FREE)
            else:
                free = roadmap.goal_edge[other, here - inner] == FREE
            if free and place[other] < 0 and roadmap.node[other] == FREE:
                place[other] = size[tree]
                for j in range(nodes.shape[1]):
                    nodes[size[tree], j] = roadmap.nodes[other, j]
                parent[size[tree]] = place[here]
                size[tree] += 1
                rows[found] = other
                found += 1
    return found - 1


@dataclass(frozen=True)
class Portfolio(BiRRT):
    """Trees, a roadmap and cells, one after the other and in turns."""

    roadmap: Roadmap | None = None
    name: str = "roadmap"
    settings: RoadmapSearchSettings = field(default_factory=RoadmapSearchSettings)
    costs: Callable[[ConstrainedSpace], EdgeCosts] = scene_costs
    alone: float = 20_000  # work after which cells take turns

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
        deadline, began = Deadline(budget, space), space.work
        clock = np.inf if budget.seconds is None else time.perf_counter() + budget.seconds
        growth = GrowingTrees(self, space, plant(start, goals, 4096), distribution, rng)
        cells, query, by = None, None, distribution.name

        def grow(trees, work, most=None):
            left = deadline.rest().iterations
            most = left if most is None else min(most, left or most)
            return trees.grow(work, most, clock)

        path = grow(growth, np.inf, X["first"]) if X["first"] else None
        if path is None and deadline.spent() is None and len(self.roadmap.nodes) > 1:
            from dataclasses import replace

            query = RoadmapQuery(
                space,
                self.roadmap.near(start, space.robot),
                start,
                goals,
                replace(self.settings, searches=X["searches"]),
                self.costs(space)._replace(dearest=X["dear"]),
            )
            path = query.next_path(deadline, X["promise"])
            by = self.name if path is not None else by
        if path is None and deadline.spent() is None:
            if X["seed"] and query:
                total = len(query.graph.nodes)
                place, rows = np.full(total, -1), np.empty(total, dtype=np.int64)
                added = graft.unchecked(query.graph, growth.trees, 0, 0, total - 1 - len(goals), rows, place)
                for k in range(len(goals)):
                    added += graft.unchecked(query.graph, growth.trees, 1, k, total - len(goals) + k, rows, place)
            if X["draws"] and query:
                known = query.graph.nodes[query.free_nodes]
                growth._drawn, growth._next = np.array(known), 0
            if X["mix"] and query:
                known = query.graph.nodes[query.free_nodes]
                growth._distribution = GaussianMixture.equal(
                    known, self.roadmap.covariance, distribution, 0.3, self.name
                )
            if X["again"] and query:
                path = grow(growth, X["between"])
                if path is None and deadline.spent() is None:
                    path = query.next_path(deadline, X["again"])
                    by = self.name if path is not None else by
            if path is None and deadline.spent() is None:
                path = grow(growth, began + self.alone - space.work)
        size = self.alone
        while path is None and deadline.spent() is None:
            cells = cells or CellTrees(space, start, goals, rng)
            path = grow(cells, size)
            by = "cells" if path is not None else by
            if path is None and deadline.spent() is None:
                path = grow(growth, size)
        fallback = ""
        if query is not None and by != self.name:
            fallback = f"{by}: no roadmap path after {query.searches} searches"
        return PlanResult(
            status=PlanStatus.SOLVED if path is not None else deadline.spent(),
            path=path,
            seconds=deadline.seconds,
            counters=deadline.counters,
            vertices=int(growth.trees.size.sum()),
            sampler=by,
            detail=growth.complaint,
            trees=growth.shown,
            fallback=fallback,
        )
