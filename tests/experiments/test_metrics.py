"""From solutions to rows: what is charged to a planner, and under which name."""

import time

import pytest

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.methods.method import Method
from cvqmpt_lab.pipeline import solve
from cvqmpt_lab.planning.proposal import Proposal
from cvqmpt_lab.planning.result import Budget, Timings
from cvqmpt_lab.results.store import read_rows
from experiments.rows import result_row
from paper_tables.committed import committed_directories

PARTS = ("t_goals_s", "t_encode_s", "t_predict_s", "t_optimize_s", "t_plan_s", "t_simplify_s")


def row_of(problem, timings, budget=20_000):
    """The row of birrt after a proposer that takes its time."""

    def think(query, observation):
        time.sleep(timings.total)
        return Proposal(query.uniform, timings)

    thinking = Method.simple("thinking", predict=think)
    solution = solve(problem, thinking, Budget(iterations=budget), seed=0, clearance=False)
    return result_row("suite", "thinking", 0, "compiled", solution, goal_seconds=0.25), solution


def test_every_part_is_in_its_column_and_the_total_is_their_sum(problem):
    row, solution = row_of(problem, Timings(encode=0.07, predict=0.11, optimize=0.13))
    assert (row.t_encode_s, row.t_predict_s, row.t_optimize_s) == (0.07, 0.11, 0.13)
    assert row.t_plan_s == solution.plan.search_seconds < solution.plan.seconds - 0.309
    assert row.t_total_s == pytest.approx(sum(getattr(row, part) for part in PARTS))
    assert row.t_total_s == pytest.approx(0.25 + solution.plan.seconds + solution.simplified.seconds)
    assert row.t_observe_s is None


def test_parts_that_a_planner_does_not_have_stay_empty(problem):
    row, _ = row_of(problem, Timings(predict=0.02))
    assert (row.t_encode_s, row.t_predict_s, row.t_optimize_s) == (None, 0.02, None)
    failed, solution = row_of(problem, Timings(encode=0.03), budget=1)
    assert not failed.solved and failed.t_simplify_s is None
    assert failed.t_total_s == pytest.approx(0.25 + solution.plan.seconds) and failed.t_total_s > 0.28


def test_search_is_all_of_a_run_without_networks(solution):
    assert solution.plan.timings == Timings() and solution.plan.search_seconds == solution.plan.seconds


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_timings_are_seconds(value):
    with pytest.raises(InvalidInputError, match="timing 'predict'"):
        Timings(predict=value)


def test_committed_rows_load_and_add_up():
    for directory in committed_directories():
        rows = read_rows(directory / "runs.csv")
        assert rows
        for row in rows:
            assert row.t_total_s == pytest.approx(sum(getattr(row, part) or 0.0 for part in PARTS))
