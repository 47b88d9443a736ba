"""Roadmaps over a roadmap in the real kitchen; nodes are random, so no weights are needed."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from cvqmpt_lab.benchmarks.place_task import place_problem, single_goal_problem
from cvqmpt_lab.certificate import certify
from cvqmpt_lab.collision.distance_grid import FARTHEST, NEAREST
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planners import Method
from cvqmpt_lab.search.edge_costs import reading, readings
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.planner_interface import Deadline, GaussianMixture, Uniform
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.roadmap import (
    Roadmap,
    RoadmapPath,
    RoadmapQuery,
    RoadmapSearchSettings,
    scene_costs,
)
from cvqmpt_lab.search.space import ConstrainedSpace

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def problem():
    return with_sampled_goals(place_problem(1003))[0]


@pytest.fixture(scope="module")
def roadmap(problem):
    nodes = problem.robot.random_configurations(np.random.default_rng(5), 1500)
    return Roadmap.of(nodes)


def plan(problem, proposer, seed=0):
    """What birrt finds after a proposal."""
    method = Method.simple("roadmap", predict=proposer)
    return solve(problem, method, ENOUGH, seed, clearance=False).plan


def query_of(problem, roadmap, **settings):
    """A query and a generous deadline in a fresh space."""
    space = ConstrainedSpace(problem)
    asked = RoadmapSearchSettings(**settings)
    query = RoadmapQuery(space, roadmap, problem.start, problem.goals, asked, scene_costs(space))
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


def test_visited_nodes_lie_on_the_manifold_and_are_free(problem, roadmap):
    space, query, deadline = query_of(problem, roadmap)
    query.next_path(deadline)
    nodes = query.graph.nodes[query.free_nodes]
    assert len(nodes) > 0 and space.valid_batch(nodes).all()
    for q in nodes:
        assert np.abs(space.residual_and_jacobian(q)[0]).max() < 1e-4
    untouched = np.setdiff1d(np.arange(len(roadmap.nodes)), query.free_nodes)
    assert (query.graph.nodes[untouched] == roadmap.nodes[untouched]).all(axis=1).sum() > 1000


def test_without_a_roadmap_path_birrt_helps_and_the_row_says_so(problem, roadmap):
    few = RoadmapSearchSettings(searches=1, links=1)
    result = plan(problem, RoadmapPath(roadmap, "roadmap", settings=few, draws=0))
    assert result.path is not None and certify(problem, result.path).valid
    assert result.fallback.startswith("birrt around ")
    assert result.fallback.endswith("free nodes: no roadmap path after 1 searches")


def nll_of(space, costs, a, b, lowest=FARTHEST):
    """-log P(free) by all readings from a to b."""
    lowest = reading(space.arrays, costs, b, a, 0, lowest)
    for k in range(readings.py_func(costs, np.linalg.norm(b - a))):
        lowest = reading(space.arrays, costs, a, b, k, lowest)
    return np.logaddexp(0.0, -costs.slope * max(lowest, NEAREST) - costs.bias)


def test_edges_cost_more_the_less_likely_they_are_free(problem, roadmap):
    space = ConstrainedSpace(replace(problem, constraint=()))
    motions = np.stack([roadmap.nodes[:400], roadmap.nodes[roadmap.neighbours[:400, 0]]], axis=1)
    free = np.array([space.valid(a) and motion_free(space.arrays, a, b) for a, b in motions])
    costs = scene_costs(space)
    nll = np.array([nll_of(space, costs, *motion) for motion in motions])
    assert (nll[free][:, None] < nll[~free]).mean() > 0.95  # the area under the curve
    assert np.exp(-nll).mean() == pytest.approx(free.mean(), abs=0.08)


def test_added_nodes_are_linked_both_ways_and_verdicts_stay(problem, roadmap):
    _, query, deadline = query_of(problem, roadmap)
    query.next_path(deadline)
    before, count = query.graph, len(roadmap.nodes)
    added = problem.robot.random_configurations(np.random.default_rng(1), 40)
    query.add_nodes(added)
    after = query.graph
    np.testing.assert_array_equal(after.nodes[:count], before.nodes[:count])
    np.testing.assert_array_equal(after.nodes[count : count + 40], added)
    np.testing.assert_array_equal(after.node[:count], before.node[:count])
    for kept in ("edge", "clearance", "lowest", "known"):
        np.testing.assert_array_equal(getattr(after, kept)[:count], getattr(before, kept)[:count])
    links = after.neighbours[count : count + 40]
    assert (links >= 0).all() and (links != np.arange(count, count + 40)[:, None]).all()
    assert ((links < count).sum(axis=1) == 20).all()
    known = links[0][links[0] < count]
    assert any(count in after.neighbours[node] for node in known)


def test_more_nodes_free_a_start_that_no_code_is_near(roadmap):
    problem = single_goal_problem(1002)
    far = np.argsort(np.linalg.norm(roadmap.nodes - problem.start, axis=1))[-300:]
    sparse = Roadmap.of(roadmap.nodes[far])
    assert plan(problem, RoadmapPath(sparse, "roadmap", draws=0)).fallback
    helped = plan(problem, RoadmapPath(sparse, "roadmap", draws=3))
    assert not helped.fallback and certify(problem, helped.path).valid
