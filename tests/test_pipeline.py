"""Many problems at once, and time left for a better path."""

import numpy as np
import pytest

from cvqmpt_lab.certificate import certify
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import solve, solve_many, with_sampled_goals
from cvqmpt_lab.search.result import Budget
from experiments.suites.place_task import place_problem

ENOUGH = Budget(iterations=20_000)


def test_many_problems_are_solved_as_each_alone_in_the_order_given(problem):
    other = place_problem(1)
    problems = [problem, other, problem.with_goals(problem.goals[:3])]
    found = solve_many(problems, "birrt", ENOUGH, seed=1, clearance=False)
    assert [solution.problem.name for solution in found] == [given.name for given in problems]
    for given, solution in zip(problems, found, strict=True):
        alone = solve(given, "birrt", ENOUGH, seed=1, clearance=False)
        assert solution.solved and solution.plan.counters == alone.plan.counters
        np.testing.assert_array_equal(solution.simplified.path.states, alone.simplified.path.states)
    assert solve_many([], "birrt", ENOUGH) == []


@pytest.mark.parametrize("planner", ["birrt", "roadmap-cvq"])
def test_iterations_left_make_the_path_shorter_and_repeat(problem, planner):
    plain = solve(problem, planner, ENOUGH, seed=3, clearance=False)
    better, again = (
        solve(problem, planner, ENOUGH, seed=3, clearance=False, optimize=Budget(iterations=60))
        for _ in range(2)
    )
    np.testing.assert_array_equal(better.simplified.path.states, again.simplified.path.states)
    made = better.improvement
    lengths = [length for _, length in made.lengths]
    assert lengths[0] == plain.simplified.path.length and lengths[-1] == better.simplified.path.length
    assert lengths[-1] < lengths[0] and lengths == sorted(lengths, reverse=True)
    assert made.gained == pytest.approx(1.0 - lengths[-1] / lengths[0]) and made.iterations >= 60
    assert better.plan.counters == plain.plan.counters
    assert better.solved and certify(problem, better.simplified.path).valid


def test_seconds_left_are_used_and_hardly_more(problem):
    made = solve(
        problem, "birrt", Budget(seconds=60.0), seed=3, clearance=False, optimize=Budget(seconds=0.2)
    ).improvement
    assert 0.2 <= made.seconds < 1.0


def test_a_run_without_a_clock_takes_no_seconds(problem):
    with pytest.raises(InvalidInputError, match=r"optimize: 0\.05 s in a run of 20000 iterations"):
        solve(problem, "birrt", ENOUGH, seed=0, optimize=Budget(seconds=0.05))


@pytest.mark.parametrize(
    ("number", "planner", "backend"), [(0, "birrt", "exact"), (1, "ompl-projected", "compiled")]
)
def test_four_threads_find_the_paths_and_verdicts_of_one(four_threads, number, planner, backend):
    problem, _ = with_sampled_goals(place_problem(number))

    def planned(seed):
        return solve(problem, planner, ENOUGH, seed, backend=backend, clearance=False).simplified.path

    alone = [planned(seed) for seed in range(3)]
    together = four_threads(planned, 2 * [0, 1, 2])
    for path, same in zip(together, 2 * alone, strict=True):
        np.testing.assert_array_equal(path.states, same.states)
    assert all(four_threads(lambda path: certify(problem, path).valid, together))
