"""Ratios of two planners' means with bootstrap intervals over problems.

Each planner's mean is over the problems that it solved, as in the paper's tables.
"""

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.benchmarks.results.statistics import Interval

DRAWS = 200_000
PARTS = 10  # independent parts of the draws, which show how far the bounds depend on chance
FEWEST_SOLVED = 10  # problems that a planner must have solved; a draw with none has no mean


class Bounded(NamedTuple):
    """A ratio with its interval."""

    interval: Interval  # by all draws
    parts: tuple[Interval, ...] = ()  # by each part of the draws alone


def ratios_of_means(
    own: np.ndarray, other: np.ndarray, level: float, draws: int = DRAWS
) -> list[Bounded]:
    """Return ratios of means with BCa bootstrap intervals (Efron 1987), one for each row.

    Problems are drawn with replacement, all values of a problem together. The draws are the same
    in every call. Without `FEWEST_SOLVED` values of both there is no interval.

    Args:
        own: (k, n) values of the planner on n problems by k prices; NaN: not solved, left out.
        other: (k, n) values of the baseline.
        level: of the intervals, two-sided.
        draws: number of draws.
    """
    # the same values are judged, printed and drawn
    values = np.concatenate([own, other]).astype(float)
    return list(_ratios(values.tobytes(), values.shape, level, draws))


@lru_cache(maxsize=256)
def _ratios(
    content: bytes, shape: tuple[int, int], level: float, draws: int
) -> tuple[Bounded, ...]:
    """Return `ratios_of_means`; content: rows of the planner, then of the baseline."""
    values = np.frombuffer(content).reshape(shape).copy()
    k, n = shape[0] // 2, shape[1]
    solved = np.isfinite(values)
    if n == 0:
        return (Bounded(Interval(None, None, None, 0)),) * k
    values[~solved] = 0.0
    columns, places = np.unique(np.concatenate([values, solved]), axis=0, return_inverse=True)

    def ratio(sums: np.ndarray) -> np.ndarray:
        """Return the ratios (k, m) of sums (4 k, m) of values, and of problems that they are of."""
        ours, theirs, our_count, their_count = sums.reshape(4, k, -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            made: np.ndarray = ours / our_count / (theirs / their_count)
        return made

    total = columns.sum(axis=1, keepdims=True)
    estimates = ratio(total[places])[:, 0]
    left_out = ratio((total - columns)[places])
    few = solved.sum(axis=1).reshape(2, k).min(axis=0) < FEWEST_SOLVED
    drawn = [ratio(part[places]) for part in _resampled(columns, draws)] if not few.all() else []
    made = []
    for j, estimate in enumerate(estimates.tolist()):
        if few[j]:
            shown = estimate if np.isfinite(estimate) else None
            made.append(Bounded(Interval(shown, None, None, n)))
            continue
        parts = [part[j] for part in drawn]
        every, *alone = (
            _bca(x, estimate, left_out[j], level) for x in (np.concatenate(parts), *parts)
        )
        made.append(Bounded(every, tuple(alone)))
    return tuple(made)


def ratio_of_means(
    own: Sequence[float], other: Sequence[float], level: float, draws: int = DRAWS
) -> Interval:
    """Return the interval of `ratios_of_means` for one price.

    Args:
        own: of the planner, one for each problem; NaN: not solved, left out.
        other: of the baseline.
        level: of the interval, two-sided.
        draws: number of draws.
    """
    return ratios_of_means(np.array([own]), np.array([other]), level, draws)[0].interval


def _resampled(columns: np.ndarray, draws: int) -> Iterator[np.ndarray]:
    """Yield sums (k, m) of columns (k, n) over n drawn problems, for each part of the draws."""
    from scipy.sparse import csr_array  # slow to import

    n, kept = columns.shape[1], np.ascontiguousarray(columns.T)
    size = draws // PARTS
    chunk = math.gcd(size, 2_000)  # so few draws stay in the processor's cache
    ends, ones = np.arange(0, chunk * n + 1, n, dtype=np.int32), np.ones(chunk * n)
    for part in range(PARTS):
        rng = np.random.Generator(np.random.SFC64(part))
        sums = []
        for _ in range(size // chunk):
            drawn = rng.integers(n, size=chunk * n, dtype=np.int32)
            # a problem that is drawn twice stands twice in its line
            sums.append(csr_array((ones, drawn, ends), shape=(chunk, n)) @ kept)
        yield np.concatenate(sums).T


def _bca(draws: np.ndarray, estimate: float, left_out: np.ndarray, level: float) -> Interval:
    """Return the bias-corrected and accelerated interval of an estimate.

    Args:
        draws: the estimate on each draw.
        estimate: on all problems.
        left_out: (n,) the estimate without each problem.
        level: two-sided.
    """
    n = len(left_out)
    draws = draws[np.isfinite(draws)]
    if np.ptp(draws) < 1e-12 * estimate:
        return Interval(estimate, estimate, estimate, n)  # all draws have this ratio
    normal = NormalDist()
    below = (np.mean(draws < estimate) + np.mean(draws <= estimate)) / 2.0
    bias = normal.inv_cdf(float(np.clip(below, 1e-6, 1.0 - 1e-6)))
    away = np.mean(left_out) - left_out
    speed = float((away**3).sum() / (6.0 * (away**2).sum() ** 1.5))
    ends = (bias + normal.inv_cdf(tail) for tail in (level / 2.0, 1.0 - level / 2.0))
    shares = [normal.cdf(bias + end / (1.0 - speed * end)) for end in ends]
    low, high = np.quantile(draws, shares).tolist()
    return Interval(estimate, low, high, n)
