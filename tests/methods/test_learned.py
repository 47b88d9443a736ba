"""Learned planners and controls on the shipped weights."""

import numpy as np
import pytest

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.methods.learned import moved_to_manifold
from cvqmpt_lab.methods.method import CONSTRAINED
from cvqmpt_lab.methods.table import CONTROLS, PLANNERS, planner_named
from cvqmpt_lab.pipeline import solve, with_sampled_goals
from cvqmpt_lab.planning.query import Query
from cvqmpt_lab.planning.result import Budget, PlanStatus
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.weights import read_description, resolve_model
from experiments.rows import path_hash
from experiments.suites.place_task import place_problem

ENOUGH = Budget(iterations=20_000)


@pytest.fixture(scope="module")
def problem():
    return with_sampled_goals(place_problem(1003))[0]


def plan(problem, name, budget=ENOUGH, seed=0):
    """What the search of a method finds."""
    return solve(problem, name, budget, seed, clearance=False).plan


@pytest.fixture(scope="module")
def roadmap(problem):
    return PLANNERS["roadmap-cvq"].stages(problem).predict.roadmap


def query_of(problem, seed=0):
    """A query with a generous budget in a fresh space."""
    return Query.of(ConstrainedSpace(problem), ENOUGH, np.random.default_rng(seed))


@pytest.mark.parametrize("name", CONTROLS)
def test_controls_solve_repeat_and_give_up(problem, name):
    first, second = plan(problem, name), plan(problem, name)
    assert first.status is PlanStatus.SOLVED and certify(problem, first.path).valid
    assert path_hash(first.path) == path_hash(second.path) and first.counters == second.counters
    assert plan(problem, name, Budget(seconds=1e-9)).status is PlanStatus.TIMEOUT


def test_learned_planners_pay_for_their_networks(problem):
    result = plan(problem, "opt-algorithm-2")
    assert result.timings.predict > 0 and result.timings.optimize > 0
    assert result.seconds >= result.timings.total


@pytest.mark.parametrize(
    ("method", "shown_another"), [("roadmap-cvq", "roadmap-wrong-cloud"), ("cvq-route", "route-wrong-cloud")]
)
def test_ways_need_the_cloud_of_their_own_scene(method, shown_another):
    """With another scene's a planner works harder, over a few problems together."""
    ratios = []
    for environment in (1003, 1007, 1017, 1020, 1030):
        problem = with_sampled_goals(place_problem(environment))[0]
        own, wrong = (plan(problem, name).counters for name in (method, shown_another))
        work = [counters.projections + counters.state_checks for counters in (own, wrong)]
        ratios.append(np.log(work[1] / work[0]))
    assert np.exp(np.mean(ratios)) > 1.3


def test_the_update_moves_dictionary_codes_to_the_manifold(problem, roadmap):
    codes = np.arange(0, 1024, 64)
    moved = moved_to_manifold(PLANNERS["roadmap-cvq"].weights)(query_of(problem), codes)
    before = np.linalg.norm(problem.manifold.residual(roadmap.nodes[codes]), axis=1)
    after = np.linalg.norm(problem.manifold.residual(moved.means), axis=1)
    assert moved.covariances.shape == (len(codes), 7, 7) and np.mean(after) < np.mean(before)


def test_constraint_trained_controls_differ_by_their_network_of_sequences_alone():
    free, constrained = (read_description(resolve_model(name)) for name in ("vq_mpt", CONSTRAINED))
    assert {name for name in free.sha256 if free.sha256[name] != constrained.sha256[name]} == {"sequences"}
    assert free.model == constrained.model and free.robot == constrained.robot
    users = {
        name for name, method in CONTROLS.items() if method.weights and method.weights.kind == CONSTRAINED
    }
    assert users == {"cvq-constraint-trained", "route-constraint-trained"}
    assert all(method.weights is None or method.weights.kind != CONSTRAINED for method in PLANNERS.values())


def test_names_are_unique():
    assert not set(PLANNERS) & set(CONTROLS)
    assert all(planner_named(name).name == name for name in (*PLANNERS, *CONTROLS))
