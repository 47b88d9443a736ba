"""Random numbers belong to a problem: no two problems of a suite share them."""

import numpy as np
import pytest

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.item import Phases
from cvqmpt_lab.benchmarks.place_task import place_problem
from cvqmpt_lab.benchmarks.published import published_problem
from cvqmpt_lab.constraints.task_space_region import upright_box
from cvqmpt_lab.features.tasks.solve import phase_seed
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.pipeline import solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Sphere
from cvqmpt_lab.search.result import Budget

PROBLEMS = 100  # of a suite with --long; otherwise of the suites whose problems are made fast
FAST = (
    *("place-task", "place-task-published", "place-task-single-goal", "two-arms", "passages"),
    *("multi-sequence", "multi-sequence-published", "multi-sequence-planned-door"),
)
DATA = ("motion-bench", "motion-bench-upright")  # problems of an archive that is downloaded


def first_numbers(problem):
    return problem.random_stream(0).bytes(16)


def first_numbers_of(item):
    """First random numbers of a problem, or of the phases of a task; none if it was not made."""
    item = getattr(item, "problem", item)
    if isinstance(item, PlanningProblem):
        return [first_numbers(item)]
    phases = item.problems if isinstance(item, Phases) else ()
    if isinstance(item, Task):
        phases = [phase.name for phase in item.phases]
    return [phase_seed(0, item.name, phase) for phase in phases]


@pytest.mark.parametrize("name", [name for name in SUITES if name not in DATA])
def test_no_two_problems_of_a_suite_have_equal_draws(name, request):
    if name not in FAST and not request.config.getoption("--long"):
        pytest.skip("problems of this suite take long to make: --long")
    items = map(SUITES[name].make, SUITES[name].problems[:PROBLEMS])
    made = [numbers for item in items for numbers in first_numbers_of(item)]
    assert len(set(made)) == len(made) >= 10


def test_numbers_depend_on_what_the_problem_is_and_not_on_its_name_or_goals(problem):
    first, other = first_numbers(problem), place_problem(7)
    for same in (
        problem.changed(name="renamed"),
        problem.changed(goals=problem.goals[:1]),
        PlanningProblem.from_dict(problem.to_dict()),
    ):
        assert first_numbers(same) == first
    start = problem.start.copy()
    start[3] += 1e-6
    for changed in (
        problem.changed(start=start),
        problem.changed(scene=problem.scene.without("range/block")),
        problem.changed(constraint=(upright_box(0.2),)),
        problem.changed(clearance=0.001),
        problem.changed(goal_region=other.constraint[0]),
        problem.changed(attachments=(Attachment("ball", Sphere(0.01), np.eye(4)),)),
    ):
        assert first_numbers(changed) != first_numbers(problem)


def test_problems_from_one_start_have_draws_of_their_own():
    """They shared all draws: iterations repeated from problem to problem."""
    problems = [published_problem(index) for index in range(1000, 1004)]
    start = problems[0].start
    problems = [problem.changed(start=start) for problem in problems]
    assert len({first_numbers(problem) for problem in problems}) == 4


def test_planners_of_one_problem_may_share_draws_and_seeds_do_not(problem):
    assert first_numbers(problem) == problem.random_stream(0).bytes(16)
    assert problem.random_stream(1).bytes(16) != problem.random_stream(0).bytes(16)
    found = [solve(problem, "birrt", Budget(iterations=5000), seed=seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(found[0].path.states, found[1].path.states)
    assert found[0].plan.counters != found[2].plan.counters
