"""Many problems at once."""

import numpy as np

from cvqmpt_lab.pipeline import solve, solve_many
from cvqmpt_lab.planning.result import Budget
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
