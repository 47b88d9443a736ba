"""Problems whose constraints are no bounds on a hand's pose."""

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.more_constraints import more_constraints_problem
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.planning.usable import check_problem
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import Budget


@pytest.mark.parametrize("index", [20, 40])
def test_problems_repeat_survive_json_and_have_certified_paths(index):
    problem = SUITES["constraints-more"].solvable(index)
    check_problem(problem)
    again = PlanningProblem.from_dict(problem.to_dict())
    assert again.constraint == problem.constraint
    np.testing.assert_array_equal(SUITES["constraints-more"].solvable(index).goals, problem.goals)
    assert solve(problem, "birrt", Budget(iterations=3000), seed=0).certificate.valid


def test_more_goals_lie_around_the_first_on_the_manifold():
    problem = more_constraints_problem(2580, each=30, around=0.05)
    hands = np.array([problem.robot.pose(q)[:3, 3] for q in problem.goals])
    # a cube of 0.1 m, turned as the first goal's hand
    assert len(hands) == 20 and np.ptp(hands, axis=0).max() <= 0.1 * 3**0.5
    assert np.linalg.norm(problem.manifold.residual(problem.goals), axis=1).max() < 1e-3
