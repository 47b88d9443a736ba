"""Roadmaps of random nodes, the planner `roadmap`, shortcuts and informed sampling."""

from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.passages import maze_problem
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.benchmarks.results.store import states_hash
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.constraints.goals import goals_in_any_posture
from cvqmpt_lab.planning.pipeline import solve, with_drawn_goals
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.search import portfolio
from cvqmpt_lab.search.anytime import InformedSamples, improve, informed_roadmap_path
from cvqmpt_lab.search.birrt import GrowingTrees
from cvqmpt_lab.search.cell_trees import CellTrees
from cvqmpt_lab.search.edge_costs import CLEARANCE_MAX_M, CLEARANCE_MIN_M, reading, readings
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.planner_interface import (
    Deadline,
    GaussianMixture,
    Observation,
    Query,
    Uniform,
    search,
    uniform,
)
from cvqmpt_lab.search.portfolio import Portfolio
from cvqmpt_lab.search.result import Budget, JointPath
from cvqmpt_lab.search.roadmap import (
    Roadmap,
    RoadmapQuery,
    RoadmapSearchSettings,
    scene_costs,
)
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def tuning():
    """Return a problem without goals near the start."""
    problem = place_problem(1003)
    return problem.changed(goals=goals_in_any_posture(problem).configurations)


@pytest.fixture(scope="module")
def hard():
    """Return a problem on which the roadmap's first path fails."""
    problem = place_problem(1012)
    return problem.changed(goals=goals_in_any_posture(problem).configurations)


@pytest.fixture(scope="module")
def roadmap(tuning):
    nodes = tuning.robot.random_configurations(np.random.default_rng(5), 1500)
    return Roadmap.of(nodes)


def plan(tuning, roadmap, seed=0, **options):
    """Return the result of the planner `roadmap` with a given roadmap."""
    method = Method.simple("roadmap", search=Portfolio(roadmap=roadmap, name="roadmap", **options))
    return solve(tuning, method, ENOUGH, seed).plan


def query_of(problem, roadmap, longest=np.inf, **settings):
    """Return a query in a new space, and a late deadline."""
    space = ConstrainedSpace.of(problem)
    asked = RoadmapSearchSettings(**settings), scene_costs(space), longest
    query = RoadmapQuery(space, roadmap, problem.start, problem.goals, *asked)
    return space, query, Deadline(ENOUGH, space)


def test_a_roadmap_links_each_node_to_its_nearest_others_and_around_none_draws_are_uniform(roadmap):
    distances = np.linalg.norm(roadmap.nodes - roadmap.nodes[17], axis=1)
    np.testing.assert_array_equal(roadmap.neighbours[17], np.argsort(distances)[1:13])
    refused("roadmap of 3 nodes", Roadmap.of, roadmap.nodes[:3])
    for count, kind, name in ((4, GaussianMixture, "m"), (0, Uniform, "m: uniform")):
        around = roadmap.nodes[:count], roadmap.covariance
        mixture = GaussianMixture.equal(*around, Uniform(-np.ones(7), np.ones(7)), 0.2, "m")
        assert isinstance(mixture, kind) and mixture.name == name
        assert count == 0 or mixture.uniform_share == 0.2


def test_visited_nodes_lie_on_the_manifold_and_are_free(tuning, roadmap):
    space, query, deadline = query_of(tuning, roadmap)
    query.next_path(deadline)
    nodes = query.graph.nodes[query.free_nodes]
    assert len(nodes) > 0 and space.valid_batch(nodes).all()
    for q in nodes:
        assert np.abs(space.residual_and_jacobian(q)[0]).max() < 1e-4
    untouched = np.setdiff1d(np.arange(len(roadmap.nodes)), query.free_nodes)
    assert (query.graph.nodes[untouched] == roadmap.nodes[untouched]).all(axis=1).sum() > 1000


def test_without_a_roadmap_path_birrt_helps_and_the_row_says_so(tuning, roadmap):
    few = RoadmapSearchSettings(searches=1, links=1)
    result = plan(tuning, roadmap, settings=few)
    assert result.path is not None and certify(tuning, result.path).valid
    assert result.fallback.startswith("birrt around ")
    assert result.fallback.endswith("free nodes: no roadmap path after 1 searches")


def nll_of(space, costs, a, b, lowest=CLEARANCE_MAX_M):
    """Return -log P(free) by all clearances along the segment from a to b."""
    lowest = reading(space.arrays, costs, b, a, 0, lowest)
    for k in range(readings.py_func(costs, np.linalg.norm(b - a))):
        lowest = reading(space.arrays, costs, a, b, k, lowest)
    return np.logaddexp(0.0, -costs.slope * max(lowest, CLEARANCE_MIN_M) - costs.bias)


def test_edges_cost_more_the_less_likely_they_are_free(tuning, roadmap):
    space = ConstrainedSpace.of(replace(tuning, constraint=()))
    motions = np.stack([roadmap.nodes[:400], roadmap.nodes[roadmap.neighbours[:400, 0]]], axis=1)
    free = np.array([space.valid(a) and motion_free(space.arrays, a, b) for a, b in motions])
    costs = scene_costs(space)
    nll = np.array([nll_of(space, costs, *motion) for motion in motions])
    assert (nll[free][:, None] < nll[~free]).mean() > 0.95  # the area under the curve
    assert np.exp(-nll).mean() == pytest.approx(free.mean(), abs=0.08)


def test_what_an_oracle_knows_is_not_paid_for(tuning, roadmap):
    told, plain = (plan(tuning, roadmap, first=0, oracle=oracle) for oracle in (True, False))
    assert certify(tuning, told.path).valid and told.sampler == plain.sampler == "roadmap"
    assert told.counters.iterations < plain.counters.iterations
    assert told.counters.state_checks < plain.counters.state_checks


LONG = {"attempts": 400, "seconds": 100.0, "patience": 1000}


@pytest.fixture
def space(problem):
    return ConstrainedSpace.of(problem)


def simplified(space, path, seed=0, **bounds):
    return simplify(space, path, np.random.default_rng(seed), **(LONG | bounds))


@pytest.mark.parametrize("seed", range(5))
def test_a_simplified_path_is_shorter_and_certified(problem, solution, space, seed):
    raw, before = solution.plan.path, states_hash(solution.plan.path.states)
    result = simplified(space, raw, seed)
    assert states_hash(raw.states) == before
    assert result.path.length < raw.length
    assert certify(problem, result.path).reasons == ()
    np.testing.assert_array_equal(result.path.states[[0, -1]], raw.states[[0, -1]])


def test_one_seed_gives_one_path_with_either_backend(problem, solution):
    how = ("compiled", 7), ("compiled", 7), ("exact", 7), ("compiled", 8)
    spaces = ((ConstrainedSpace.of(problem, backend), seed) for backend, seed in how)
    one, *same, other = (simplified(space, solution.plan.path, seed).path for space, seed in spaces)
    assert [states_hash(path.states) for path in same] == 2 * [states_hash(one.states)]
    assert states_hash(other.states) != states_hash(one.states)


def test_no_attempts_and_paths_without_room_change_nothing(problem, solution, space):
    still = (problem.start[None], np.array([problem.start, problem.start]))
    cases = [(solution.plan.path.states, {bound: 0}) for bound in ("attempts", "seconds")]
    for states, bounds in (*cases, *((states, {}) for states in still)):
        result = simplified(space, JointPath(states), **bounds)
        np.testing.assert_array_equal(result.path.states, states)
        assert not bounds or result.counters.projections == 0


def test_attempts_seconds_and_patience_bound_the_work(solution, space):
    path = solution.plan.path
    work = [simplified(space, path, attempts=n).counters.projections for n in (1, 20, 200)]
    assert work[0] < work[1] < work[2]
    hurried = simplified(space, path, attempts=10**6, seconds=0.05, patience=10**6)
    assert hurried.seconds < 1.0
    short = simplified(space, path).path
    assert simplified(space, short, attempts=10**6, patience=1, gain=0.5).seconds < 5.0


def test_a_detour_is_cut(problem, space):
    """A detour of 0.3 rad and back from a motion on the manifold is removed completely."""
    manifold, q = problem.manifold, problem.start
    out = [manifold.project(q + np.array([s, 0, 0, 0, 0, 0, 0])) for s in np.linspace(0.0, 0.3, 11)]
    states = np.array([*out, *out[-2:0:-1], out[1]])
    assert space.checked_path(states)[1] == -1
    assert simplified(space, JointPath(states)).path.length < 0.1


def informed(start, goals, lengths, count):
    limits = np.full(7, -9.0), np.full(7, 9.0)
    samples = InformedSamples(start, goals, np.array(lengths), *limits)
    return samples.sample(np.random.default_rng(0), count)


@pytest.mark.parametrize("lengths", [(1.5,), (1.1, 3.3)])
def test_informed_samples_keep_detours_to_one_of_the_goals_short(lengths):
    """If start and goal are equal, samples lie in a ball."""
    start, goals = np.zeros(7), np.array([np.eye(7)[0], 3.0 * np.eye(7)[1]])[: len(lengths)]
    samples = informed(start, goals, lengths, 2000)
    to_goals = np.linalg.norm(samples[:, None] - goals, axis=2)
    detours = np.linalg.norm(samples - start, axis=1)[:, None] + to_goals
    within = detours <= np.add(lengths, 1e-9)
    assert samples.shape == (2000, 7) and within.any(axis=1).all()
    assert (within.sum(axis=0) > 800).all()
    assert (np.where(within, detours, 0.0).max(axis=0) > np.multiply(0.98, lengths)).all()
    middles = [samples[within[:, k]].mean(axis=0) for k in range(len(goals))]
    assert np.abs(middles[0] - 0.5 * goals[0]).max() < 0.3
    here = np.ones(7)
    around = informed(here, here[None], [0.5], 100)
    assert np.linalg.norm(around - here, axis=1).max() <= 0.25 + 1e-9


@pytest.fixture(scope="module")
def first(problem):
    """Return a shortened path of `birrt`."""
    return solve(problem, "birrt", ENOUGH, 0).path


def test_paths_that_cost_more_than_asked_are_not_looked_for(problem, roadmap):
    def length_within(longest):
        _, query, deadline = query_of(problem, roadmap, longest, greed=1.0, searches=2000)
        found = query.next_path(deadline)
        return None if found is None else found.length

    straight = np.linalg.norm(problem.goals - problem.start, axis=1).min()
    assert length_within(0.99 * straight) is None
    assert length_within(100.0) == length_within(np.inf) is not None


def test_informed_roadmaps_find_shorter_paths_that_repeat(problem, first):
    def better(path):
        search, rng = partial(informed_roadmap_path, scene_costs), np.random.default_rng(0)
        space, budget = ConstrainedSpace.of(problem), Budget(iterations=400)
        query = Query.of(space, problem.start, problem.goals, budget, rng)
        return improve(query, search, path)

    (path, made), (again, _) = better(first), better(first)
    np.testing.assert_array_equal(path.states, again.states)
    assert path.length < first.length and made.searches > 3 and made.iterations >= 400
    space = ConstrainedSpace.of(problem)
    assert space.checked_path(path.states)[0] is not None
    assert max(np.abs(space.residual_and_jacobian(q)[0]).max() for q in path.states) < 1e-3
    nearest = problem.goals[np.linalg.norm(problem.goals - problem.start, axis=1).argmin()]
    assert better(JointPath(np.stack([problem.start, nearest])))[1].searches == 0


def turns(problem, budget=None, seed=0, **changes):
    """The result of `roadmap` with changes to its turns."""
    method = replace(planner_named("roadmap").stages(problem).search, **changes)
    rng = np.random.default_rng(seed)
    space = ConstrainedSpace.of(problem)
    query = Query.of(space, problem.start, problem.goals, budget or ENOUGH, rng)
    return search(method, query, uniform(query, Observation()))


def test_a_path_comes_from_whoever_finds_one_first(hard):
    early = turns(hard, first=10_000)
    assert (early.sampler, early.fallback, early.counters.clearances) == ("uniform", "", 0)
    roadmap = turns(hard, first=1)
    assert (roadmap.sampler, roadmap.fallback) == ("roadmap", "")
    assert roadmap.counters.clearances > 0 and roadmap.vertices > roadmap.trees[0].nodes.shape[0]
    late = turns(hard, first=1, turns=(1.0, 1.0))
    assert late.sampler in ("uniform", "cells") and "no roadmap path after" in late.fallback


def test_cells_take_turns_after_some_work(hard):
    cells = turns(hard, first=1, turns=(1.0, 1.0), between=(1.0, 1.0), alone=1.0)
    assert cells.path is not None and cells.sampler in ("uniform", "cells")
    only_trees = turns(hard, first=1, turns=(1.0, 1.0), between=(1.0, 1.0), alone=1e9)
    assert only_trees.sampler == "uniform" and only_trees.counters != cells.counters


def test_in_a_maze_cells_come_early(tuning, monkeypatch):
    """They get five sixths of the later work there, elsewhere a quarter."""
    work = []
    for growth in (GrowingTrees, CellTrees):
        monkeypatch.setattr(growth, "grow", lambda _, deadline, most=0.0, **more: work.append(most))
    monkeypatch.setattr(RoadmapQuery, "next_path", lambda *_: None)

    def names(problem, count):
        work.clear()
        rng = np.random.default_rng(0)
        query = Query.of(ConstrainedSpace.of(problem), problem.start, problem.goals, ENOUGH, rng)
        method = planner_named("roadmap").stages(problem).search
        found = portfolio._Run(method, query, query.uniform).turns()
        return [name for name, _ in islice(found, count)]

    searches = ["direct", "uniform", "roadmap", "uniform"]
    assert names(with_drawn_goals(maze_problem(0.06, 3)), 6) == [*searches, "cells", "uniform"]
    assert work == [0.0, 2_500, 20_000, 4_000]
    assert names(tuning, 9) == [*searches, "roadmap", *["uniform"] * 2, "cells", "uniform"]
    assert work[1] == 6_000 and work[3:] == [60_000, 20_000, 60_000]


def test_after_the_roadmap_trees_draw_from_the_whole_space_without_a_limit(hard, monkeypatch):
    """Draws around free nodes of a roadmap without a path kept the trees out of cages."""
    drawn = []
    grow = GrowingTrees.grow

    def recorded(trees, *limits, **more):
        drawn.append((trees._method.reach, trees._distribution.name, type(trees._distribution)))
        return grow(trees, *limits, **more) if trees._method.reach == np.inf else None

    monkeypatch.setattr(GrowingTrees, "grow", recorded)
    found = turns(hard, first=1, between=(1.0, 1.0), turns=(100.0, 1.0), alone=1.0)
    assert found.sampler in ("uniform", "cells")
    assert (1.0, "uniform", GaussianMixture) in drawn
    assert drawn[-1] == (np.inf, "uniform", Uniform)


@pytest.mark.parametrize(
    "changes", [{}, {"turns": (50.0, 50.0), "between": (50.0, 50.0), "alone": 100.0}]
)
def test_the_same_seed_leads_to_the_same_path_whatever_the_clock_says(tuning, changes):
    budgets = (Budget(iterations=20_000), Budget(seconds=1e4, iterations=20_000), Budget(1e4))
    first, *others = (turns(tuning, budget, seed=3, **changes) for budget in budgets)
    for other in others:
        assert np.array_equal(first.path.states, other.path.states)
        assert first.counters == other.counters


def test_without_a_roadmap_trees_and_cells_search(tuning):
    none = Roadmap(np.empty((0, 7)), np.empty((0, 1), dtype=np.int32))
    found = turns(tuning, roadmap=none, first=1)
    assert found.path is not None and found.fallback == "birrt: 0 nodes are no roadmap"
    assert found.counters.clearances == 0
