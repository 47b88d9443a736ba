"""Problems whose constraints are no bounds on a hand's pose."""

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem, check_problem
from cvqmpt_lab.search.result import Budget


@pytest.mark.parametrize("index", [20, 40])
def test_problems_repeat_survive_json_and_have_certified_paths(index):
    problem = SUITES["constraints-more"].solvable(index)
    check_problem(problem)
    again = PlanningProblem.from_dict(problem.to_dict())
    assert again.constraint == problem.constraint
    np.testing.assert_array_equal(SUITES["constraints-more"].solvable(index).goals, problem.goals)
    assert solve(problem, "birrt", Budget(iterations=3000), seed=0).certificate.valid
