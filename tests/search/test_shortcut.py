"""Simplification: never longer, ends kept, still certified, repeatable, bounded."""

import numpy as np
import pytest

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.store import states_hash
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.shortcut import SimplifySettings, simplify
from cvqmpt_lab.search.space import ConstrainedSpace

LONG = SimplifySettings(attempts=400, seconds=100.0, patience=1000)


@pytest.fixture
def space(problem):
    return ConstrainedSpace(problem)


def simplified(space, path, settings, seed=0):
    return simplify(space, path, np.random.default_rng(seed), settings)


@pytest.mark.parametrize("seed", range(5))
def test_shorter_certified_and_between_the_same_ends(problem, solution, space, seed):
    raw = solution.plan.path
    result = simplified(space, raw, LONG, seed)
    assert result.path.length < raw.length
    assert certify(problem, result.path).reasons == ()
    np.testing.assert_array_equal(result.path.states[[0, -1]], raw.states[[0, -1]])


def test_every_round_is_at_most_as_long(solution, space):
    path = solution.plan.path
    for seed in range(30):
        shorter = simplified(space, path, SimplifySettings(attempts=16, seconds=100.0), seed).path
        assert shorter.length <= path.length
        path = shorter


def test_the_path_and_the_input_are_not_shared(solution, space):
    before = states_hash(solution.plan.path.states)
    simplified(space, solution.plan.path, LONG)
    assert states_hash(solution.plan.path.states) == before


def test_one_seed_gives_one_path(problem, solution):
    paths = [simplified(ConstrainedSpace(problem), solution.plan.path, LONG, s).path for s in (7, 7, 8)]
    assert states_hash(paths[0].states) == states_hash(paths[1].states) != states_hash(paths[2].states)


def test_backends_agree(problem, solution):
    paths = [
        simplified(
            ConstrainedSpace(problem, backend), solution.plan.path, SimplifySettings(seconds=100.0)
        ).path
        for backend in ("compiled", "exact")
    ]
    assert states_hash(paths[0].states) == states_hash(paths[1].states)


@pytest.mark.parametrize("settings", [SimplifySettings(attempts=0), SimplifySettings(seconds=1e-9)])
def test_no_attempts_change_nothing(solution, space, settings):
    result = simplified(space, solution.plan.path, settings)
    assert states_hash(result.path.states) == states_hash(solution.plan.path.states)
    assert result.counters.projections == 0


def test_attempts_bound_the_work(solution, space):
    work = [
        simplified(
            space, solution.plan.path, SimplifySettings(attempts=n, seconds=100.0, patience=1000)
        ).counters
        for n in (1, 20, 200)
    ]
    assert work[0].projections < work[1].projections < work[2].projections


def test_seconds_bound_the_time(solution, space):
    settings = SimplifySettings(attempts=10**6, seconds=0.05, patience=10**6)
    assert simplified(space, solution.plan.path, settings).seconds < 1.0


def test_patience_ends_what_no_longer_gains(solution, space):
    short = simplified(space, solution.plan.path, LONG).path
    hasty = SimplifySettings(attempts=10**6, seconds=100.0, patience=1, gain=0.5)
    assert simplified(space, short, hasty).seconds < 5.0


def test_tiny_paths_pass_through(problem, space):
    for states in (problem.start[None], np.array([problem.start, problem.start])):
        np.testing.assert_array_equal(simplified(space, JointPath(states), LONG).path.states, states)


def test_a_detour_is_cut(problem, space):
    """Out and back by 0.3 rad of a motion on the manifold: nothing of it is needed."""
    manifold, q = problem.manifold, problem.start
    out = [manifold.project(q + np.array([s, 0, 0, 0, 0, 0, 0])) for s in np.linspace(0.0, 0.3, 11)]
    states = np.array([*out, *out[-2:0:-1], out[1]])
    assert space.checked_path(states)[1] == -1
    assert simplified(space, JointPath(states), LONG).path.length < 0.1


@pytest.mark.parametrize("bad", [{"attempts": -1}, {"seconds": 0.0}, {"patience": 0}])
def test_unusable_bounds_are_refused(bad):
    with pytest.raises(InvalidInputError, match=f"positive.*{next(iter(bad))}={next(iter(bad.values()))}"):
        SimplifySettings(**bad)


def test_nan_seconds_are_refused():
    with pytest.raises(InvalidInputError, match="positive"):
        SimplifySettings(seconds=np.nan)
