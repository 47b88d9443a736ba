"""Statistics for success rates, censored planning times and paired comparisons.

Failures are data: a failed run's time is +inf, so medians and quantiles need no imputation. Where
something is undefined (no data) an `Interval` holds None, never 0.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.row import ResultRow, natural_key

CONFIDENCE = 0.95
"""Of every interval in a table."""

ProblemKey = tuple[str, str, int]
"""(suite, problem, seed): what two planners must share for their runs to be a pair."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval.

    ``estimate``, ``low`` and ``high`` are None where undefined and +inf where failures make them so;
    ``n`` is the number of values used. ``coverage`` is the exact coverage of an order-statistic
    interval; None for other kinds.
    """

    estimate: float | None
    low: float | None
    high: float | None
    n: int
    coverage: float | None = None

    def scaled(self, factor: float) -> "Interval":
        """The same interval in another unit."""
        low, high = (None if bound is None else bound * factor for bound in (self.low, self.high))
        estimate = None if self.estimate is None else self.estimate * factor
        return Interval(estimate, low, high, self.n, self.coverage)


UNDEFINED = Interval(None, None, None, 0)


def wilson_interval(successes: float, n: int, confidence: float = CONFIDENCE) -> Interval:
    """Success rate with Wilson's score interval (Wilson 1927), as fractions in [0, 1].

    Where a trial succeeds in part (2 of 5 seeds), successes is the sum of these shares. The interval is then wide
    rather than narrow: a share between 0 and 1 varies no more than a trial of that probability.

    Raises
    ------
    InvalidInputError
        Unless 0 <= successes <= n and 0 < confidence < 1.
    """
    if not 0 <= successes <= n:
        raise InvalidInputError(f"{successes} successes of {n} runs; successes must lie in 0..n")
    _checked_confidence(confidence)
    if n == 0:
        return UNDEFINED
    rate, z = successes / n, NormalDist().inv_cdf((1.0 + confidence) / 2.0)
    middle = rate + z**2 / (2.0 * n)
    half = z * math.sqrt(rate * (1.0 - rate) / n + (z / (2.0 * n)) ** 2)
    low, high = ((middle + side) / (1.0 + z**2 / n) for side in (-half, half))
    return Interval(rate, low if successes > 0 else 0.0, high if successes < n else 1.0, n)


def median_interval(values: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Median with an order-statistic (sign-test) interval; failures are +inf.

    The interval runs from the r-th smallest to the r-th largest value, with the largest r for which
    P(r <= B <= n - r), B ~ Binomial(n, 1/2), is at least `confidence`. That probability is the exact
    coverage for any continuous distribution and a lower bound otherwise; it is returned as
    ``coverage`` (0.957 for n = 30). No such r exists for small n (n < 6 at 95 %): the interval is
    then the whole range, and ``coverage``, below `confidence`, says so.

    Raises
    ------
    InvalidInputError
        For NaN, values that are not one-dimensional, or a confidence outside (0, 1).
    """
    ordered = np.sort(_checked_values(values))
    n, tail = len(ordered), (1.0 - _checked_confidence(confidence)) / 2.0
    if n == 0:
        return UNDEFINED
    from scipy.stats import binom

    rank = max(1, int(binom.ppf(tail, n, 0.5)))
    coverage = max(0.0, float(1.0 - 2.0 * binom.cdf(rank - 1, n, 0.5)))
    median = float(ordered[(n - 1) // 2] / 2 + ordered[n // 2] / 2)
    return Interval(median, float(ordered[rank - 1]), float(ordered[n - rank]), n, coverage)


def mean_of_solved(
    values: ArrayLike, rng: np.random.Generator, n_bootstrap: int = 2000, confidence: float = CONFIDENCE
) -> Interval:
    """Mean of the finite values with a percentile-bootstrap interval; failures (+inf) are left out.

    This is what a table of bare means reports; it flatters planners that fail on hard problems, so
    print it only beside the success rate and `median_interval`. One value has no interval.

    Raises
    ------
    InvalidInputError
        For NaN.
    """
    array = _checked_values(values)
    return _bootstrap_mean(array[np.isfinite(array)], rng, n_bootstrap, confidence)


def geometric_mean_interval(
    values: ArrayLike, rng: np.random.Generator, n_bootstrap: int = 2000, confidence: float = CONFIDENCE
) -> Interval:
    """Geometric mean, of ratios say, with a percentile-bootstrap interval; one value has no interval.

    Raises
    ------
    InvalidInputError
        For values that are not finite and positive.
    """
    array = _checked_values(values)
    if not ((array > 0.0) & np.isfinite(array)).all():
        raise InvalidInputError(
            f"geometric mean of {array.min()} to {array.max()}; give finite positive values"
        )
    logs = _bootstrap_mean(np.log(array), rng, n_bootstrap, confidence)
    estimate, low, high = (None if x is None else math.exp(x) for x in (logs.estimate, logs.low, logs.high))
    return Interval(estimate, low, high, logs.n)


def _bootstrap_mean(
    values: NDArray[np.float64], rng: np.random.Generator, n_bootstrap: int, confidence: float
) -> Interval:
    n = len(values)
    if n == 0:
        return UNDEFINED
    if n == 1:
        return Interval(float(values[0]), None, None, 1)
    tail = (1 - _checked_confidence(confidence)) / 2
    means = values[rng.integers(n, size=(n_bootstrap, n))].mean(axis=1)
    low, high = np.quantile(means, [tail, 1 - tail])
    return Interval(float(values.mean()), float(low), float(high), n)


def jointly_solved(rows_by_planner: Mapping[str, Iterable[ResultRow]]) -> tuple[ProblemKey, ...]:
    """Keys (suite, problem, seed) that every planner solved, in a deterministic order."""
    solved = [{problem_key(row) for row in rows if row.solved} for rows in rows_by_planner.values()]
    common = set.intersection(*solved) if solved else set()
    return tuple(sorted(common, key=lambda key: (key[0], natural_key(key[1]), key[2])))


def problem_key(row: ResultRow) -> ProblemKey:
    """The (suite, problem, seed) of a row."""
    return row.suite, row.problem, row.seed


def _checked_values(values: ArrayLike | Sequence[float]) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or np.isnan(array).any():
        raise InvalidInputError(
            f"values of shape {array.shape} with NaN or not one-dimensional; failures are +inf"
        )
    return array


def _checked_confidence(confidence: float) -> float:
    if not 0 < confidence < 1:
        raise InvalidInputError(f"confidence is {confidence}; it must lie strictly between 0 and 1")
    return confidence
