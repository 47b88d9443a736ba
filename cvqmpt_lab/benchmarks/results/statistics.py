"""Statistics for success rates, censored planning times and paired comparisons.

Failures are data: a failed run's time is +inf, so medians and quantiles need no imputation.
Undefined values (without data) are None, never 0.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import accumulate
from operator import attrgetter
from statistics import NormalDist, fmean, stdev
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.results.row import ResultRow, natural_key

CONFIDENCE = 0.95  # confidence level of every interval
ProblemKey = tuple[str, str, int]  # (suite, problem, seed), the same for both runs of a pair
problem_key: Callable[[ResultRow], ProblemKey] = attrgetter("suite", "problem", "seed")


class Interval(NamedTuple):
    """An estimate with its confidence interval; None: undefined; +inf: because of failures."""

    estimate: float | None
    low: float | None
    high: float | None
    n: int  # number of values
    coverage: float | None = None  # exact coverage of an order-statistic interval

    def mapped(self, scale: Callable[[float], float]) -> "Interval":
        """Return the interval on another scale; `scale` is an increasing function."""
        middle, low, high = (None if x is None else scale(x) for x in self[:3])
        return Interval(middle, low, high, self.n, self.coverage)


UNDEFINED = Interval(None, None, None, 0)


def wilson_interval(successes: float, n: int) -> Interval:
    """Return the success rate with Wilson's score interval (Wilson 1927), as fractions in [0, 1].

    Each bound p satisfies (rate - p)^2 = z^2 p (1 - p) / n. If trials succeed in part (2 of 5
    seeds), `successes` is the sum of these shares; the interval is then conservative, because a
    share between 0 and 1 varies no more than a trial of that probability.
    InvalidInputError unless 0 <= successes <= n.
    """
    if not 0 <= successes <= n:
        raise InvalidInputError(f"{successes} successes of {n} runs; successes must be in 0..n")
    if n == 0:
        return UNDEFINED
    rate, z = successes / n, NormalDist().inv_cdf((1.0 + CONFIDENCE) / 2.0)
    middle = rate + z**2 / (2.0 * n)
    half = z * math.sqrt(rate * (1.0 - rate) / n + (z / (2.0 * n)) ** 2)
    low, high = ((middle + side) / (1.0 + z**2 / n) for side in (-half, half))
    return Interval(rate, low if successes > 0 else 0.0, high if successes < n else 1.0, n)


def median_interval(values: ArrayLike) -> Interval:
    """Return the median with an order-statistic (sign-test) interval; failures are +inf.

    The interval is from the r-th smallest to the r-th largest value, with the largest r for which
    P(r <= B <= n - r), B ~ Binomial(n, 1/2), is at least CONFIDENCE. This probability is the exact
    coverage for any continuous distribution and a lower bound otherwise (0.957 for n = 30). For
    n < 6 there is no such r: the interval is the whole range, and `coverage` is below CONFIDENCE.
    InvalidInputError for NaN.
    """
    ordered = np.sort(_checked(values))
    n = len(ordered)
    if n == 0:
        return UNDEFINED
    rank, coverage = _median_rank(n)
    median = float(ordered[(n - 1) // 2] / 2 + ordered[n // 2] / 2)
    return Interval(median, float(ordered[rank - 1]), float(ordered[n - rank]), n, coverage)


@lru_cache(maxsize=1024)
def _median_rank(n: int) -> tuple[int, float]:
    """Return r of `median_interval` for n values, and P(r <= B <= n - r)."""
    below = list(accumulate(Fraction(math.comb(n, k), 2**n) for k in range(n + 1)))  # P(B <= k)
    rank = max(1, bisect_left(below, Fraction((1.0 - CONFIDENCE) / 2.0)))
    return rank, max(0.0, float(1 - 2 * below[rank - 1]))


def mean_of_solved(values: ArrayLike, samples: int = 2000) -> Interval:
    """Return the mean of the finite values with a percentile-bootstrap interval.

    Failures (+inf) are left out, which favours planners that fail on hard problems: print it only
    together with the success rate and `median_interval`. One value has no interval. The random
    seed is fixed. InvalidInputError for NaN.
    """
    array = _checked(values)
    array = array[np.isfinite(array)]
    n = len(array)
    if n < 2:
        return Interval(float(array[0]), None, None, 1) if n else UNDEFINED
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(array[_drawn(n, samples)].mean(axis=1), [tail, 1 - tail])
    return Interval(float(array.mean()), float(low), float(high), n)


@lru_cache(maxsize=4)  # most intervals of a table have the same number of problems
def _drawn(n: int, samples: int) -> np.ndarray:
    """Return the indices (samples, n) of values drawn with replacement."""
    return np.random.default_rng(0).integers(n, size=(samples, n))


def geometric_mean_interval(values: ArrayLike) -> Interval:
    """Return the geometric mean exp(mean(log x_i)) with a percentile-bootstrap interval.

    InvalidInputError for values that are not finite and positive.
    """
    array = _checked(values)
    if not ((array > 0.0) & np.isfinite(array)).all():
        raise InvalidInputError(
            f"geometric mean of {array.min()} to {array.max()}; give finite positive values"
        )
    return mean_of_solved(np.log(array)).mapped(math.exp)


def student_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> Interval:
    """Return the mean with Student's t interval (Student 1908); UNDEFINED below two values.

    Args:
        values: (n,) independent numbers.
        confidence: probability that such an interval contains the true mean.
    """
    n = len(values)
    if n < 2:
        return UNDEFINED
    from scipy.special import stdtrit  # slow to import

    middle = fmean(values)
    half = float(stdtrit(n - 1, (1.0 + confidence) / 2.0)) * stdev(values) / math.sqrt(n)
    return Interval(middle, middle - half, middle + half, n)


def jointly_solved(rows_by_planner: Mapping[str, Iterable[ResultRow]]) -> tuple[ProblemKey, ...]:
    """Return the keys (suite, problem, seed) that every planner solved, in natural order."""
    solved = [{problem_key(row) for row in rows if row.solved} for rows in rows_by_planner.values()]
    common = set.intersection(*solved) if solved else set()
    return tuple(sorted(common, key=lambda key: (key[0], natural_key(key[1]), key[2])))


def _checked(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or np.isnan(array).any():
        raise InvalidInputError(
            f"values of shape {array.shape} with NaN or not one-dimensional; failures are +inf"
        )
    return array
