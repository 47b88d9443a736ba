"""Simplification: never longer, ends kept, still certified, repeatable, bounded."""

import numpy as np
import pytest

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.results.store import states_hash
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.shortcut import simplify
from cvqmpt_lab.search.space import ConstrainedSpace

LONG = {"attempts": 400, "seconds": 100.0, "patience": 1000}


@pytest.fixture
def space(problem):
    return ConstrainedSpace(problem)


def simplified(space, path, seed=0, **bounds):
    return simplify(space, path, np.random.default_rng(seed), **(LONG | bounds))


@pytest.mark.parametrize("seed", range(5))
def test_shorter_certified_and_between_the_same_ends_of_a_path_that_stays_as_it_was(
    problem, solution, space, seed
):
    raw, before = solution.plan.path, states_hash(solution.plan.path.states)
    result = simplified(space, raw, seed)
    assert states_hash(raw.states) == before
    assert result.path.length < raw.length
    assert certify(problem, result.path).reasons == ()
    np.testing.assert_array_equal(result.path.states[[0, -1]], raw.states[[0, -1]])


def test_every_round_is_at_most_as_long(solution, space):
    path = solution.plan.path
    for seed in range(30):
        shorter = simplified(space, path, seed, attempts=16, patience=4).path
        assert shorter.length <= path.length
        path = shorter


def test_one_seed_gives_one_path_with_either_backend(problem, solution):
    how = ("compiled", 7), ("compiled", 7), ("exact", 7), ("compiled", 8)
    spaces = ((ConstrainedSpace(problem, backend), seed) for backend, seed in how)
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
