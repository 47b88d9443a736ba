"""Values, statistics, ratios, split into easy and hard problems, against hand calculations."""

import math

import pytest
from made_rows import a_failure, a_row

from paper_tables.measures import (
    censored,
    mean_ratio,
    own_time,
    paired,
    paper_cost,
    split_by_work,
    work,
)


def run(planner, problem, checks=None, seed=0, solved=True, **values):
    """Its work is `checks`."""
    make = a_row if solved else a_failure
    values |= {} if checks is None else {"n_projections": 0, "n_state_checks": checks}
    return make(str(problem), planner, seed=seed, **values)


def test_work_at_other_costs_adds_networks_and_leaves_goals_out():
    times = {"t_total_s": 9.0, "t_goals_s": 2.0, "t_encode_s": 0.25, "t_optimize_s": 0.5}
    row = a_row(n_projections=500, n_state_checks=1000, **times)
    assert work(row) == 1500.0 and own_time(row) == 7.0
    assert paper_cost(row) == pytest.approx(1000 * 0.0035 + 500 * 0.00002 + 0.75)
    silent = a_row(t_total_s=1.0)
    assert work(silent) is None and paper_cost(silent) is None and own_time(silent) == 1.0


@pytest.mark.parametrize(
    ("rows", "values"),
    [
        ([run("x", 0, 5), run("x", 1, 7, solved=False), run("x", 2)], [[5.0], [math.inf]]),
        ([run("x", 0), run("x", 1, solved=False)], []),
        ([run("x", 1, solved=False)], [[math.inf]]),
        ([run("x", 0, 5), run("x", 0, 7, seed=1), run("x", 1, 1)], [[5.0, 7.0], [1.0]]),
    ],
)
def test_failures_are_infinite(rows, values):
    assert censored(rows, work) == values


def test_ratios_are_geometric_means_over_problems_that_both_solved():
    works = {0: 2, 1: 8, 2: 1000, 4: None}
    rows = [*(run("x", k, x) for k, x in works.items()), run("x", 3, 5, solved=False)]
    base = [run("b", i, 1) for i in (0, 1, 3, 4)] + [run("b", 2, 1, solved=False)]
    ratio = mean_ratio(paired(rows, base, work))
    assert ratio.estimate == pytest.approx(4.0) and ratio.n == 2  # sqrt(2 * 8)
    assert (ratio.low, ratio.high) == (pytest.approx(2.0), pytest.approx(8.0))
    one = mean_ratio(paired([row for row in rows if row.problem in ("1", "2")], base, work))
    assert (one.estimate, one.n, one.low) == (pytest.approx(8.0), 1, None)
    assert mean_ratio(paired(rows, [], work)).estimate is None
    assert mean_ratio(paired([run("x", 0, 0)], base, work)).estimate is None  # no work: no ratio


def names(keys):
    return {problem for _, problem, _ in keys}


def test_hard_is_the_top_third_and_ties_are_easy():
    split = split_by_work([run("birrt", i, 10 * i) for i in range(9)])
    assert names(split["hard"]) == set("678") and names(split["easy"]) == set("012345")
    assert split["all"] == split["easy"] | split["hard"] and len(split["all"]) == 9
    # the last says no work
    ties = split_by_work([run("birrt", i, 5) for i in range(6)] + [run("birrt", 6)])
    assert ties["hard"] == frozenset() and len(ties["easy"]) == 6
    assert split_by_work([])["all"] == frozenset()


def test_hard_goes_by_medians_over_the_other_seeds_and_failures_are_hardest():
    rows = [run("birrt", 0, w, seed=s) for s, w in enumerate((1, 1000, 2))]
    rows += [run("birrt", 1, w, seed=s) for s, w in enumerate((9, 10, 11))]
    rows += [run("birrt", 2, 3, seed=s) for s in range(3)]
    hard = {(problem, seed) for _, problem, seed in split_by_work(rows)["hard"]}
    # in seed 1 problem 0 took long: by the others it is easy
    assert hard == {("0", 0), ("1", 1), ("0", 2)}
    failing = [run("birrt", 2, 3, seed=s, solved=s == 0) for s in range(3)]
    assert names(split_by_work([*rows[:6], *failing])["hard"]) == {"2"}
