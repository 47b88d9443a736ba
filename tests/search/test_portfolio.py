"""Planner `roadmap`: who finds the path, and that turns are ended by counts alone."""

from dataclasses import replace

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.search.planner_interface import Observation, Query, search, uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.roadmap import Roadmap
from cvqmpt_lab.search.space import ConstrainedSpace


@pytest.fixture(scope="module")
def tuning():
    return with_sampled_goals(place_problem(1003))[0]


def plan(problem, budget=None, seed=0, **changes):
    """The result of `roadmap` with changes to its turns."""
    method = replace(planner_named("roadmap").stages(problem).search, **changes)
    query = Query.of(
        ConstrainedSpace(problem),
        budget or Budget(iterations=20_000),
        np.random.default_rng(seed),
    )
    return search(method, query, uniform(query, Observation()))


def test_a_path_comes_from_whoever_finds_one_first(tuning):
    early = plan(tuning, first=10_000)
    assert (early.sampler, early.fallback, early.counters.clearances) == ("uniform", "", 0)
    roadmap = plan(tuning, first=1)
    assert (roadmap.sampler, roadmap.fallback) == ("roadmap", "")
    assert roadmap.counters.clearances > 0 and roadmap.vertices > roadmap.trees[0].nodes.shape[0]
    late = plan(tuning, first=1, turns=(1.0, 1.0))
    assert late.sampler in ("uniform", "cells") and "no roadmap path after" in late.fallback


def test_cells_take_turns_after_some_work(tuning):
    cells = plan(tuning, first=1, turns=(1.0, 1.0), between=1.0, alone=1.0)
    assert cells.path is not None and cells.sampler in ("uniform", "cells")
    only_trees = plan(tuning, first=1, turns=(1.0, 1.0), between=1.0, alone=1e9)
    assert only_trees.sampler == "uniform" and only_trees.counters != cells.counters


@pytest.mark.parametrize("changes", [{}, {"turns": (50.0, 50.0), "between": 50.0, "alone": 100.0}])
def test_the_same_seed_leads_to_the_same_path_whatever_the_clock_says(tuning, changes):
    budgets = (Budget(iterations=20_000), Budget(seconds=1e4, iterations=20_000), Budget(1e4))
    first, *others = (plan(tuning, budget, seed=3, **changes) for budget in budgets)
    for other in others:
        assert np.array_equal(first.path.states, other.path.states)
        assert first.counters == other.counters


def test_without_a_roadmap_trees_and_cells_search(tuning):
    none = Roadmap(np.empty((0, 7)), np.empty((0, 1), dtype=np.int32))
    found = plan(tuning, roadmap=none, first=1)
    assert found.path is not None and found.fallback == "birrt: 0 nodes are no roadmap"
    assert found.counters.clearances == 0
