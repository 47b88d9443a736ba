"""Shares of problems solved within the same time: a planner, and its difference to a baseline."""

import math
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.benchmarks.results.statistics import Interval

MARGIN = 0.05  # difference of solved shares that counts as none
FEWEST_PROBLEMS = 30  # for an interval; with 60 of a wide spread it holds the truth in 87 % only


class Within(NamedTuple):
    """How the shares of problems that two planners solve within the same time differ."""

    not_fewer: bool  # whether the planner solves at no time many fewer, see `solved_within`
    fewer: bool  # whether it solves fewer at some time
    time: float  # at which the lower bound of the difference is least [s]
    gain: Interval  # difference there, planner less baseline
    needed: int  # number of problems that would probably decide


def solved_within(own: np.ndarray, other: np.ndarray, limit: float, level: float) -> Within | None:
    """Compare the shares solved at all times up to a limit; None below `FEWEST_PROBLEMS`.

    Not fewer: at every time the lower bound of the difference lies above -`MARGIN`. Each time is a
    test of its own, and all of them must reject, so the level of one holds for all together
    (intersection-union test, Berger 1982). Fewer: at some time the upper bound of the simultaneous
    band lies below 0.

    Args:
        own: (n,) time of the planner on each problem [s]; NaN: not solved.
        other: (n,) of the baseline.
        limit: the smaller of both planners' limits [s].
        level: of all bounds, two-sided.
    """
    from scipy.special import stdtrit  # slow to import

    n = len(own)
    if n < FEWEST_PROBLEMS:
        return None
    times, ahead = _ahead(own, other, limit)
    gains = ahead.mean(axis=0)
    # with two pseudo-problems, one for each side, as in `rule.share_gain`
    middle = ahead.sum(axis=0) / (n + 2)
    spread = np.sqrt(((ahead**2).sum(axis=0) + 1.0 - (n + 2) * middle**2) / (n + 1))
    half = float(stdtrit(n + 1, 1.0 - level / 2.0)) * spread / math.sqrt(n + 2)
    low, high = middle - half, middle + half
    # the band is wider than the intervals, and takes long
    fewer = (high < 0.0).any() and (gain_band(own, other, limit, level)[3] < 0.0).any()
    at = int(np.argmin(low))
    least = Interval(float(gains[at]), float(low[at]), float(high[at]), n)
    not_fewer = bool((low > -MARGIN).all())
    needed = _needed(gains, spread, low, n, level)
    return Within(not_fewer, bool(fewer), float(times[at]), least, needed)


def _ahead(own: np.ndarray, other: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (m,) of changes, and the difference (n, m) of solved at each of them."""
    known = np.concatenate([own, other])
    times = np.append(np.unique(known[known < limit]), limit)
    return times, (own[:, None] <= times).astype(float) - (other[:, None] <= times)


def gain_band(
    own: np.ndarray,
    other: np.ndarray,
    limit: float,
    level: float,
    draws: int = 5_000,
    most: int = 100,
) -> tuple[np.ndarray, ...]:
    """Return times (m,), differences of shares and both ends of a band that holds all of them.

    The width is the quantile of the largest deviation in draws with random multipliers.

    Args:
        own: see `solved_within`.
        other: see `solved_within`.
        limit: last time [s].
        level: two-sided.
        draws: number of draws.
        most: number of times for the quantile: neighbours hardly differ.
    """
    times, ahead = _ahead(own, other, limit)
    gains = ahead.mean(axis=0)
    away = ahead - gains
    error = np.sqrt((away**2).sum(axis=0)) / len(own)
    chosen = np.unique(np.linspace(0, len(times) - 1, most).astype(int))
    chosen = chosen[error[chosen] > 0.0]
    if not len(chosen):
        return times, gains, gains, gains
    varied = away[:, chosen] / (len(own) * error[chosen])
    drawn = np.random.default_rng(0).standard_normal((draws, len(own))) @ varied
    width = float(np.quantile(np.abs(drawn).max(axis=1), 1.0 - level)) * error
    return times, gains, gains - width, gains + width


def _needed(gains: np.ndarray, spread: np.ndarray, low: np.ndarray, n: int, level: float) -> int:
    """Return how many problems show that the planner solves not fewer, or fewer, at these gains."""
    late, behind = low <= -MARGIN, gains < 0.0
    ratios = []
    if (gains > -MARGIN).all():
        ratios.append((spread[late] / (gains[late] + MARGIN)).max(initial=0.0))
    if behind.any():
        ratios.append((spread[behind] / -gains[behind]).min())
    return max(n + 1, sample_size(min(ratios), level))


def curve_half_band(n: int, level: float) -> float:
    """Return half the width of a band that holds a whole curve of shares of n problems.

    Dvoretzky, Kiefer and Wolfowitz (1956), with the constant of Massart (1990).
    """
    return math.sqrt(math.log(2.0 / level) / (2.0 * n))


def sample_size(ratio: float, level: float, power: float = 0.8) -> int:
    """Return the number of values whose mean a t test distinguishes from a number.

    Args:
        ratio: standard deviation of the values, divided by the distance of their mean from the
            number.
        level: two-sided level of the test.
        power: probability that the test does so.
    """
    from scipy.special import stdtrit  # slow to import

    fewest = 3
    count, last = fewest, 0
    for _ in range(30):  # fixed-point iteration: the quantiles depend on the count
        quantiles = stdtrit(count - 1, 1.0 - level / 2.0) + stdtrit(count - 1, power)
        last, count = count, max(fewest, math.ceil((float(quantiles) * ratio) ** 2))
        if abs(count - last) <= 1:
            break
    return max(count, last)
