import math

import numpy as np
import pytest
from made_rows import a_failure, a_row
from refusals import refused

from cvqmpt_lab.benchmarks.results.statistics import (
    UNDEFINED,
    Interval,
    geometric_mean_interval,
    jointly_solved,
    mean_of_solved,
    median_interval,
    student_interval,
    wilson_interval,
)

INF = math.inf
WILSON = {(8, 10): (0.4902, 0.9433), (0, 10): (0.0, 0.2775), (10, 10): (0.7225, 1.0)}
WILSON |= {(5, 10): (0.2366, 0.7634), (1, 1): (0.2065, 1)}
RANKS = {1: (1, 0.0), 5: (1, 0.9375), 6: (1, 0.96875), 10: (2, 0.97852), 20: (6, 0.95861)}
RANKS |= {100: (40, 0.96480)}


def test_intervals_of_shares_and_medians_match_tabulated_values():
    for (successes, n), bounds in WILSON.items():
        interval = wilson_interval(successes, n)
        assert interval.estimate == successes / n and interval.n == n
        assert (interval.low, interval.high) == pytest.approx(bounds, abs=5e-5)
    for n, (rank, coverage) in RANKS.items():
        values = np.random.default_rng(n).permutation(np.arange(1.0, n + 1))
        interval = median_interval(values)
        assert (interval.low, interval.high) == (rank, n + 1 - rank)
        assert interval.estimate == np.median(values)
        assert interval.coverage == pytest.approx(coverage, abs=1e-5)


def test_failures_move_the_median_without_imputation():
    assert median_interval([1, 2, 3, 4, 5, 6, 7, INF]) == Interval(4.5, 1, INF, 8, 1 - 2 / 2**8)
    assert median_interval([1.0, INF, INF, INF]).estimate == INF
    assert median_interval([1.0, INF]).estimate == INF
    assert median_interval([INF, INF]) == Interval(INF, INF, INF, 2, 0.5)


def test_mean_of_solved_leaves_failures_out():
    interval = mean_of_solved([1.0, 3.0, INF])
    assert interval.estimate == 2.0 and interval.n == 2 and interval[1:3] == (1.0, 3.0)
    assert mean_of_solved([4.0, INF]) == Interval(4.0, None, None, 1)
    assert mean_of_solved([INF]) == UNDEFINED


def test_students_interval_by_hand():
    """Mean 2, sd 1, n 3: t(2 df) is 4.303 at 95 % and 9.925 at 99 %."""
    for confidence, t in ((0.95, 4.303), (0.99, 9.925)):
        interval = student_interval([1.0, 2.0, 3.0], confidence)
        assert interval.estimate == 2.0 and interval.n == 3
        half = t / math.sqrt(3.0)
        assert interval[1:3] == pytest.approx((2.0 - half, 2.0 + half), abs=1e-3)
    assert student_interval([1.0]) == UNDEFINED


def row(problem, solved, seed=0):
    return (a_row if solved else a_failure)(problem, seed=seed)


def test_jointly_solved_needs_every_planner_and_the_same_seed():
    rows = {
        "a": [row("p10", True), row("p2", True), row("p3", True), row("p4", True, seed=1)],
        "b": [row("p2", True), row("p10", True), row("p3", False), row("p4", True, seed=2)],
    }
    assert jointly_solved(rows) == (("place", "p2", 0), ("place", "p10", 0))
    assert jointly_solved({**rows, "c": []}) == ()
    assert jointly_solved({}) == ()


def test_wrong_values_are_refused():
    for successes in (3, -1):
        refused("successes must be in 0..n", wilson_interval, successes, 2)
    for statistic, values, message in (
        (median_interval, [1.0, math.nan], "with NaN or not one-dimensional"),
        (median_interval, [[1.0]], "with NaN or not one-dimensional"),
        (mean_of_solved, [math.nan], "with NaN or not one-dimensional"),
        (geometric_mean_interval, [1.0, 0.0], "give finite positive values"),
        (geometric_mean_interval, [1.0, INF], "give finite positive values"),
    ):
        refused(message, statistic, values)
