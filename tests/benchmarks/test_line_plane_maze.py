"""Problems by the recipe of McVAMP: repeatable, valid, solved, and their table."""

import numpy as np
import pytest
from made_rows import a_row

from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.paper_tables.statements import read_published
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.search.result import Budget

SUITES = ("line", "plane", "maze")


@pytest.mark.parametrize("name", SUITES)
def test_problems_are_functions_of_their_index_with_a_valid_start_and_goal(name):
    suite = suite_named(name)
    problem = suite.item(12)
    assert suite.item(12).to_dict() == problem.to_dict() != suite.item(22).to_dict()
    assert len(problem.goals) == 1
    checker = problem.collision_checker()
    for state in (problem.start, *problem.goals):
        assert np.linalg.norm(problem.manifold.residual(state)) <= PROJECTION_TOLERANCE
        assert not checker.in_collision(state)


def test_a_problem_is_solved_and_certified():
    problem = suite_named("plane").item(1)
    assert solve(problem, "roadmap", Budget(iterations=20_000), 0).solved


@pytest.mark.parametrize("name", SUITES)
def test_a_table_has_the_published_numbers_in_a_section_of_their_own(name):
    suite = suite_named(name)
    rows = [a_row(problem, suite=name) for problem in ("1/2-20 cubes", "2/3-40 cubes")]
    table = suite.table(rows, read_published(*suite.paper))
    _, solved, time = table.sections["Published numbers, not comparable"]
    assert (solved[2], time[2]) == ("solved", "planning time")
