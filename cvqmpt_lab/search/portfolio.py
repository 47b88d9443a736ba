"""The search of the roadmap planners: it alternates between trees, a roadmap and cells.

    0. the direct motions to the nearest goals, which are not shortened: the easiest problems end
       here;
    1. trees of Algorithm 3 grow for a few iterations: easy problems end here;
    2. the roadmap is searched (`lazy_roadmap`), with a small limit of work;
    3. the trees grow further, first towards the nodes that the roadmap search found free, then
       towards draws around them;
    4. the roadmap is searched again, with a larger limit of work;
    5. the trees grow further, with uniform draws and without a limit of an extension, in turns with
       trees that walk from rarely chosen cells (`cell_trees`). Elsewhere than in mazes they seldom
       help: the trees come first, and cells get a quarter of the work.

Cells find paths through mazes in a plane. Where the constraint leaves the hand at most two
directions and one rotation, step 3 is shorter, step 4 is left out, and cells come first in step 5
and get five sixths of the work.

Each turn ends by its work, not by the clock, so the same seed leads to the same path. Numbers were
chosen on tuning problems, see docs/performance.md.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeAlias

import numpy as np

from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.anytime import informed_roadmap_path
from cvqmpt_lab.search.birrt import BiRRT, GrowingTrees, result_trees
from cvqmpt_lab.search.cell_grids import free_rows
from cvqmpt_lab.search.cell_trees import CellTrees
from cvqmpt_lab.search.edge_costs import EdgeCosts
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.planner_interface import (
    Deadline,
    GaussianMixture,
    Query,
    SamplingDistribution,
    Stages,
)
from cvqmpt_lab.search.result import JointPath, PlanResult, PlanStatus
from cvqmpt_lab.search.roadmap import (
    Roadmap,
    RoadmapQuery,
    RoadmapSearchSettings,
    scene_costs,
    spread_roadmap,
)
from cvqmpt_lab.search.space import ConstrainedSpace, direct_motion

DIRECT = "direct"  # name of the sampler where the direct motion to a goal is the path
Turn: TypeAlias = tuple[str, JointPath | None]  # name of the search, and the path it found


@dataclass(frozen=True, kw_only=True)
class Portfolio(BiRRT):
    """Settings of the search by trees, a roadmap and cells in turns.

    Work is in units of `ConstrainedSpace.work`.
    """

    roadmap: Roadmap | None  # None for a closed chain, see `PlanningProblem.closed_chain`
    name: str  # name of the sampler in result rows if the roadmap's search finds the path
    # makes the edge costs in a space
    costs: Callable[[ConstrainedSpace], EdgeCosts] = scene_costs
    # whether blocked nodes and edges are known at no cost: an upper bound for all roadmaps
    oracle: bool = False
    settings: RoadmapSearchSettings = field(default_factory=RoadmapSearchSettings)
    straight: int = 3  # number of goals to which the direct motion is tried first
    first: int = 2  # iterations of the trees before the roadmap is searched
    turns: tuple[float, float] = (1_500, 4_000)  # work of the roadmap's two turns
    # total work before the trees draw uniformly again, and work of each turn of the cells
    alone: float = 20_000
    # two numbers: where the constraint leaves the hand at most two directions and one rotation, and
    # elsewhere
    between: tuple[float, float] = (
        2_500,
        6_000,
    )  # work of the trees after the roadmap's first turn
    # work of the trees' later turns over work of the cells' turns
    ratios: tuple[float, float] = (0.2, 3.0)
    late_reach: float = np.inf  # longest extension of the trees after `alone` [rad]

    def search(self, query: Query, distribution: SamplingDistribution) -> PlanResult:
        """Search a path from the query's start to any of its goals, see `Search`."""
        run = _Run(self, query, distribution)
        turns, path, status = run.turns(), None, None
        while path is None and status is None:
            by, path = next(turns)
            status = query.deadline.spent()
        return PlanResult(
            status=PlanStatus.SOLVED if path is not None else status or PlanStatus.NO_PATH,
            path=path,
            seconds=query.deadline.seconds,
            counters=query.deadline.counters,
            vertices=run.vertices,
            sampler=by,
            trees=result_trees(run.trees.trees),
            roots=1 + len(query.goals),
            detail=run.trees.warning,
            fallback="" if by == self.name else run.fallback,
            direct=by == DIRECT,
        )


class _Run:
    """One search of a portfolio; arguments as of `Portfolio.search`."""

    def __init__(self, method: Portfolio, query: Query, distribution: SamplingDistribution) -> None:
        self._method, self._query, self._space = method, query, query.space
        self._uniform = distribution
        self.trees = GrowingTrees(method, query, distribution)
        self.fallback = ""  # why the roadmap found no path
        self._others = 0  # number of nodes of roadmap and cells
        axes = free_rows(self._space)[:, 1]
        directions, rotations = np.count_nonzero(axes < 3), np.count_nonzero(axes >= 3)
        self._flat = 1 <= directions <= 2 and rotations <= 1  # as a pen in a maze

    @property
    def vertices(self) -> int:
        """Number of nodes of the trees and cells, and of free nodes of the roadmap."""
        return int(self.trees.trees.size.sum()) + self._others

    def turns(self) -> Iterator[Turn]:
        """Yield one turn after another; the caller stops at a path or when the budget is spent."""
        method, began, trees = self._method, self._space.work, self._uniform.name
        yield DIRECT, self._direct_motion()
        yield trees, self.trees.grow(self._query.deadline, iterations=method.first)
        if method.roadmap is None:
            self.fallback = "birrt: no roadmap is made of closed chains"
        elif len(method.roadmap.nodes) < 2:
            self.fallback = f"birrt: {len(method.roadmap.nodes)} nodes are no roadmap"
        else:
            yield from self._roadmap_turns(method.roadmap)
        if not self._flat:
            left = began + method.alone - self._space.work
            yield trees, self.trees.grow(self._query.deadline, left)
        # draws around the free nodes of a roadmap without a path keep the trees near these nodes
        grown, late = self.trees.trees, replace(method, reach=method.late_reach)
        self.trees = GrowingTrees(late, self._query, self._uniform)
        self.trees.trees = grown
        ratio = method.ratios[0 if self._flat else 1]
        if ratio > 1.0:  # trees find most of the paths
            yield trees, self.trees.grow(self._query.deadline, ratio * method.alone)
        cells, others = CellTrees(self._query), self._others
        while True:
            found = cells.grow(self._query.deadline, method.alone)
            self._others = others + int(cells.trees.size.sum())
            yield "cells", found
            yield trees, self.trees.grow(self._query.deadline, ratio * method.alone)

    def _direct_motion(self) -> JointPath | None:
        """Return the direct motion to one of the nearest goals, or None; each counts as a draw."""
        for goal in self._query.nearest_goals(self._method.straight):
            if self._query.deadline.spent() is None:
                self._query.deadline.count()
                path = direct_motion(self._space, self._query.start, goal)
                if path is not None:
                    return path
        return None

    def _roadmap_turns(self, roadmap: Roadmap) -> Iterator[Turn]:
        """Yield the roadmap's turns, and the trees' turn after the first one."""
        method, space, trees = self._method, self._space, self._uniform.name
        start, goals, deadline = self._query.start, self._query.goals, self._query.deadline
        near = roadmap.near(start, space.robot)
        query = RoadmapQuery(space, near, start, goals, method.settings, method.costs(space))
        if method.oracle:
            uncounted = space.again()
            costs = method.costs(uncounted)
            known = RoadmapQuery(uncounted, near, start, goals, method.settings, costs)
            known.next_path(Deadline(deadline.budget, uncounted))
            query.avoid(known)
        for work in method.turns[:1] if self._flat else method.turns:
            path = query.next_path(deadline, work)
            free = query.free_nodes
            self._others = len(free)
            nodes = query.graph.nodes[free]
            lost = f"free nodes: no roadmap path after {query.searches} searches"
            self.fallback = f"birrt around {len(free)} {lost}"
            yield method.name, path
            if work == method.turns[0]:
                around = GaussianMixture.equal(
                    nodes, near.covariance, self._query.uniform, 0.3, trees
                )
                self.trees.draw_from(around, nodes)
                between = method.between[0 if self._flat else 1]
                yield trees, self.trees.grow(self._query.deadline, between)


def spread_nodes(problem: PlanningProblem, model: str, draw: int | None = None) -> Roadmap:
    """Return the roadmap of a problem's robot by `spread_roadmap`, which needs no model."""
    return spread_roadmap(problem.robot, problem.carried, draw)


def roadmap_planner(
    name: str,
    roadmap: Callable[[PlanningProblem, str], Roadmap],
    weights: str | None = None,
    misfit: Callable[[PlanningProblem, str], str] | None = None,
    costs: Callable[[ConstrainedSpace], EdgeCosts] = scene_costs,
    oracle: bool = False,
) -> Method:
    """Return a planner with trees, a roadmap and cells in turns.

    Args:
        name: name of the planner.
        roadmap: makes the roadmap from (problem, name or folder of a model).
        weights: kind of weights that the roadmap needs, or None.
        misfit: see `Method.misfit`.
        costs: makes the edge costs in a space.
        oracle: whether blocked nodes and edges are known at no cost.
    """

    def build(problem: PlanningProblem, model: str) -> Stages:
        # nearly all nodes are far from the manifold of a closed chain
        nodes = None if problem.closed_chain else roadmap(problem, model)
        return Stages(
            search=Portfolio(roadmap=nodes, name=name, costs=costs, oracle=oracle),
            path_source=partial(informed_roadmap_path, costs),
        )

    return Method(name, build, weights, misfit)
