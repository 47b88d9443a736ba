"""Samplers inside OMPL's RRTConnect: which projection is a draw, what it replaces, and limits."""

from dataclasses import replace

import numpy as np
import pytest
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou
from refusals import refused

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.published import published_problem
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.task_space_region import displacements
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.search import ompl_planners
from cvqmpt_lab.search.ompl_planners import OmplSearch, published_search, simplified_by_ompl
from cvqmpt_lab.search.planner_interface import Query, Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.search.work import PRICES, Prices


class Replayed:
    """A distribution that repeats given draws."""

    name = "replayed"

    def __init__(self, draws):
        self.draws, self.used = draws, 0

    def sample(self, rng, count):
        """Return the next draws, then zeros."""
        drawn = self.draws[self.used : self.used + count]
        self.used += count
        return np.array([*drawn, *np.zeros((count - len(drawn), self.draws.shape[1]))])


def query_of(problem, space=None, budget=None, seed=0):
    """A query for all goals of a problem."""
    space = space or ConstrainedSpace.of(problem)
    budget = budget or Budget(iterations=400)
    return Query.of(space, problem.start, problem.goals, budget, np.random.default_rng(seed))


def recorded(monkeypatch, problem, seed):
    """The result of a search with OMPL's own draws, and these draws."""
    draws = []

    def project(self, x):
        if self._draws.due:
            self._draws.due = False
            draws.append(np.array(x))
        return self._project(x)

    with monkeypatch.context() as patched:
        patched.setattr(ompl_planners._Manifold, "project", project)
        given = Replayed(np.empty((0, problem.robot.dof)))
        found = published_search().search(query_of(problem, seed=seed), given)
    return found, np.array(draws)


@pytest.mark.parametrize("seed", [0, 1, 5, 10])
def test_ompl_finds_the_same_path_with_its_own_draws_given_back(monkeypatch, problem, seed):
    """So the hook sees all draws of RRTConnect, and replaces nothing else."""
    plain = OmplSearch("projected", reach=np.inf).search(query_of(problem, seed=seed), None)
    noted, draws = recorded(monkeypatch, problem, seed)
    given = published_search().search(query_of(problem, seed=seed), Replayed(draws))
    assert plain.path is not None and len(draws) == plain.counters.iterations > 1
    for other in (noted, given):
        np.testing.assert_array_equal(other.path.states, plain.path.states)
        assert other.vertices == plain.vertices
    drawn = given.counters
    assert drawn.draw_projections == drawn.iterations
    # draws are counted only where they are given
    assert replace(drawn, draw_projections=0, draw_newton_iterations=0) == plain.counters


def test_draws_equal_iterations_without_a_constraint(problem):
    free = ConstrainedSpace.of(problem).unconstrained()
    uniform = Uniform(problem.robot.lower, problem.robot.upper)
    search = published_search()
    made = []

    class Counted(Replayed):
        def sample(self, rng, count):
            made.append(uniform.sample(rng, count))
            return made[-1]

    found = search.search(query_of(problem, free), Counted(np.empty((0, problem.robot.dof))))
    assert found.path is not None and found.sampler == "replayed"
    assert 0 < found.counters.iterations <= 64 * len(made)


def test_draws_that_cannot_be_used_become_uniform_and_are_counted(problem):
    draws = np.full((400, problem.robot.dof), np.nan)
    draws[1::2] = 1e6
    query = query_of(problem, budget=Budget(iterations=12))
    found = published_search().search(query, Replayed(draws))
    count = found.counters.iterations
    assert found.fallback == f"uniform in place of {count} of {count} draws, which cannot be used"
    edge = np.array([problem.robot.upper + 0.1] * 400)
    found = published_search().search(query_of(problem), Replayed(edge))
    assert not found.fallback


@pytest.mark.parametrize("name", ["ompl-projected", "ompl-uniform", "birrt", "cells"])
def test_a_priced_budget_ends_where_the_prices_say(problem, name):
    """The last iteration alone passes the limit, or a path is found before."""
    prices = PRICES["published"]
    budget = Budget(cost=0.7)
    problem = problem.changed(goals=problem.goals[-1:])
    found = solve(problem, name, budget, seed=3).plan
    assert found.path is not None or found.status == "cost_limit"
    if found.path is None:
        assert found.counters.cost(prices) >= 0.7
        before = Budget(iterations=found.counters.iterations - 1)
        assert solve(problem, name, before, 3).plan.counters.cost(prices) < 0.7


def test_goals_are_tried_one_after_the_other_each_with_its_limit(problem):
    search = replace(published_search(), reach=0.3)
    assert search.reach == 0.3
    found = solve(problem, "ompl-uniform", Budget(cost=8.0), seed=1).plan
    again = solve(problem, "ompl-uniform", Budget(cost=8.0), seed=1).plan
    assert found.counters == again.counters and found.goals_tried == again.goals_tried
    # two roots for each search
    assert found.roots == 2 * found.goals_tried
    assert found.vertices == found.counters.extensions + found.roots


def test_projections_of_the_published_task_end_near_the_centre():
    """F jumps at the bounds; ours end at the bounds."""
    first = published_problem(1000)
    space = ConstrainedSpace.of(first, ends=first.start[None])
    manifold = ompl_planners._Manifold(space)
    bounds = RegionConstraint(first.robot, first.constraint)
    rng, ours, published = np.random.default_rng(0), [], []
    for q in first.robot.random_configurations(rng, 200):
        on_bounds, centred = np.array(q), np.array(q)
        if space.project(on_bounds) and manifold.project(centred):
            assert not bounds.residual(centred).any()
            for x, found in ((on_bounds, ours), (centred, published)):
                found.append(np.abs(displacements(first.robot, first.constraint[0], x[None])))
    rows = first.constraint[0].bounded_rows
    assert len(ours) > 150
    assert np.median(np.max(published, axis=1)[:, rows]) < 0.05
    assert np.median(np.max(ours, axis=1)[:, rows].max(axis=1)) > 0.09
    found = solve(first, "ompl-cvq", Budget(cost=100.0), seed=0)
    assert found.solved and found.plan.counters.newton_iterations > 0


def test_prices_and_samplers_that_make_no_sense_are_refused():
    refused("price projection is 0.0: give seconds above 0", Prices, 1e-3, 0.0, 1e-3)
    refused("price state_check is -1", Prices, -1, 1e-3, 1e-3)
    refused("budget cost 0: give a number above 0", Budget, cost=0)
    refused("only RRTConnect on the projected space", OmplSearch, "atlas", sampled=True)
    with pytest.raises(InvalidInputError, match="a budget needs"):
        Budget()


def test_simplification_is_that_of_ompl(problem):
    """The same seed gives the path that OMPL makes of its own solution."""
    found = OmplSearch("projected").search(query_of(problem), None)
    space = ConstrainedSpace.of(problem)
    ou.RNG.setSeed(5)
    ours = simplified_by_ompl(space, found.waypoints)
    ou.RNG.setSeed(5)
    states, information = ompl_planners._state_spaces(space, "projected")
    path = og.PathGeometric(information)
    for q in found.waypoints:
        state = states.allocState()
        state.copy([float(x) for x in q])
        path.append(state)
    definition = ob.ProblemDefinition(information)
    simplifier = og.PathSimplifier(information, definition.getGoal())
    simplifier.simplifyMax(path)
    path.interpolate()
    assert ours.length == pytest.approx(path.length(), abs=1e-9)
    assert ours.length <= found.path.length * 1.001
    np.testing.assert_allclose(ours.states[[0, -1]], found.waypoints[[0, -1]])


def test_motions_without_a_constraint_are_checked_in_the_order_of_ompl(problem):
    """From the start on, as in constrained spaces, to refuse a motion takes more checks."""
    free = ConstrainedSpace.of(problem).unconstrained()
    states, information = ompl_planners._state_spaces(free, "projected")
    ours = ompl_planners._StraightMotions(information, free)
    given, blocked = [states.allocState() for _ in range(2)], 0
    drawn = problem.robot.random_configurations(np.random.default_rng(0), 200)
    for ends in drawn.reshape(100, 2, -1):
        for state, q in zip(given, ends, strict=True):
            ompl_planners._write(q, state)
        found = []
        for check in (information.checkMotion, ours.checkMotion):
            before = free.counters.state_checks
            found.append((check(*given), free.counters.state_checks - before))
        assert found[0] == found[1]
        blocked += not found[0][0]
    assert 10 < blocked < 100
