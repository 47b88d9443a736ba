"""The rule for rows of the paper's experiment inside OMPL; docs/judgement.md states it.

The effect is the paper's own statistic: the ratio of arithmetic means over problems, planner over
baseline; below 1 is what the paper says. The mean of the logarithms of the ratios is the second
statistic. The rule knows no suite and no planner. It was committed before any row that it judges.
"""

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from statistics import NormalDist, fmean
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.results.statistics import CONFIDENCE, Interval, student_interval

LEVEL = 0.05  # limit of the probability that any sentence is wrongly *replicated*
SHARE_MARGIN = 0.05  # difference of solved shares that counts as none
FEWEST_PROBLEMS = 30  # for an interval; with 60 of a wide spread it holds the truth in 87 % only
WIDEST_FACTOR = 1.5  # largest ratio of a bound and the estimate of a replicated effect
NO_DIFFERENCE = (0.9, 1.0 / 0.9)  # ratios that count as no difference
LARGEST_WITHOUT_NUMBER = 0.9  # ratio that must not be excluded where the paper prints no number


class Word(StrEnum):
    """Result of a sentence's comparison with one baseline."""

    REPLICATED = "replicated"
    SMALLER = "same direction, smaller"
    SAME = "no difference"
    OPPOSITE = "opposite"
    OPEN = "inconclusive"
    STATISTIC = "depends on the statistic"
    HARDWARE = "depends on hardware"
    NO_ROWS = "not run"
    UNTESTABLE = "not testable"


class Effect(NamedTuple):
    """Ratio of a planner to a baseline by both statistics."""

    means: Interval  # ratio of arithmetic means over problems
    geometric: Interval  # geometric mean of the ratios of problems

    @staticmethod
    def of(own: Sequence[float], other: Sequence[float], level: float) -> "Effect":
        """Return the effect of values above 0 of the same problems.

        Args:
            own: of the planner, one for each problem.
            other: of the baseline.
            level: of both intervals, two-sided.
        """
        if len(own) != len(other) or not all(x > 0.0 for x in (*own, *other)):
            raise InvalidInputError(
                f"{len(own)} and {len(other)} values: give as many values of both, all above 0"
            )
        logs = [math.log(a / b) for a, b in zip(own, other, strict=True)]
        if len(logs) < FEWEST_PROBLEMS:
            nothing = Interval(None, None, None, len(logs))
            return Effect(nothing, nothing)
        geometric = student_interval(logs, 1.0 - level).mapped(math.exp)
        return Effect(ratio_of_means(own, other, level), geometric)


def ratio_of_means(own: Sequence[float], other: Sequence[float], level: float) -> Interval:
    """Return the ratio of arithmetic means with its BCa bootstrap interval (Efron 1987).

    Problems are drawn with replacement, both values of a problem together.

    Args:
        own: of the planner, one for each problem.
        other: of the baseline.
        level: of the interval, two-sided.
    """
    from scipy.stats import bootstrap  # slow to import

    def ratio(a: np.ndarray, b: np.ndarray, axis: int = -1) -> np.ndarray:
        return a.mean(axis=axis) / b.mean(axis=axis)

    ours, theirs = np.array(own, dtype=float), np.array(other, dtype=float)
    estimate = float(ratio(ours, theirs))
    if np.ptp(ours / theirs) < 1e-12:
        return Interval(estimate, estimate, estimate, len(own))  # all draws have this ratio
    found = bootstrap(
        (ours, theirs),
        ratio,
        paired=True,
        vectorized=True,
        n_resamples=9_999,
        confidence_level=1.0 - level,
        method="BCa",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(estimate, float(found.low), float(found.high), len(own))


def few_ratio(own: Sequence[float], other: Sequence[float]) -> Interval:
    """Return the ratio of arithmetic means of few problems with Student's 95 % interval.

    It judges nothing: words need FEWEST_PROBLEMS. The standard error is that of `problems_needed`,
    by the delta method on the logarithm, so one problem has no interval.

    Args:
        own: of the planner, one for each problem, all above 0.
        other: of the baseline.
    """
    ours, theirs = np.array(own, dtype=float), np.array(other, dtype=float)
    ratio = float(ours.mean() / theirs.mean())
    # their mean is 0, up to rounding
    away = (ours - ratio * theirs) / ours.mean()
    around = student_interval((math.log(ratio) + away).tolist(), CONFIDENCE).mapped(math.exp)
    return around._replace(estimate=ratio, n=len(own))


def word_of(effect: Effect, paper: float | None) -> Word:
    """Return the word of a claim against one baseline.

    Args:
        effect: measured.
        paper: the paper's ratio; None: it prints none, or one that contradicts its sentence.
    """
    estimate, low, high = effect.means[:3]
    if estimate is None or low is None or high is None:
        return Word.OPEN
    paper = LARGEST_WITHOUT_NUMBER if paper is None else paper
    narrow = max(high / estimate, estimate / low) <= WIDEST_FACTOR
    if high < 1.0:
        if low > paper:
            word = Word.SMALLER
        else:
            # a wide interval holds the paper's number without showing it
            word = Word.REPLICATED if narrow else Word.OPEN
    elif low > 1.0:
        word = Word.OPPOSITE
    elif low >= NO_DIFFERENCE[0] and high <= NO_DIFFERENCE[1]:
        word = Word.SAME
    else:
        word = Word.OPEN
    return Word.STATISTIC if _contradicted(effect) else word


def _contradicted(effect: Effect) -> bool:
    """Return whether both intervals exclude 1, on different sides."""
    sides = []
    for interval in effect:
        if interval.low is None or interval.high is None:
            return False
        sides.append((interval.high < 1.0) - (interval.low > 1.0))
    return sides[0] * sides[1] < 0


def word_on_all_hardware(words: Mapping[str, Word]) -> Word:
    """Return the word that all network times give, else `HARDWARE`.

    words: by the network's time, such as "0 s, as published", "a GPU" and "this machine".
    """
    different = set(words.values())
    return different.pop() if len(different) == 1 else Word.HARDWARE


def claim_word(words: Sequence[Word]) -> str:
    """Return the word of a claim: the common word, or "mixed (2 of 3)" where words differ.

    words: of the comparisons. The first number counts the replicated ones.
    """
    different = set(words)
    if len(different) == 1:
        return str(different.pop())
    return f"mixed ({words.count(Word.REPLICATED)} of {len(words)})"


def share_gain(own: Sequence[bool], other: Sequence[bool], level: float) -> Interval:
    """Return the paired difference of solved shares with Student's interval.

    Two pseudo-problems are added, one for each side (Agresti and Min 2005). Without them, ten of
    ten solved by both planners would be certain to be equal.

    Args:
        own: whether the planner solved each problem within the paper's cut-off.
        other: the same of the baseline.
        level: of the interval, two-sided.
    """
    gains = [float(a) - float(b) for a, b in zip(own, other, strict=True)]
    if len(gains) < FEWEST_PROBLEMS:
        return Interval(fmean(gains) if gains else None, None, None, len(gains))
    return _paired_gain(gains, level)


def few_gain(own: Sequence[bool], other: Sequence[bool]) -> Interval:
    """Return the difference of solved shares of few problems with Student's 95 % interval.

    It judges nothing: words need FEWEST_PROBLEMS.

    Args:
        own: whether the planner solved each problem within the paper's cut-off.
        other: the same of the baseline.
    """
    gains = [float(a) - float(b) for a, b in zip(own, other, strict=True)]
    return _paired_gain(gains, 1.0 - CONFIDENCE)


def _paired_gain(gains: Sequence[float], level: float) -> Interval:
    """Return the mean of differences with Student's interval and two pseudo-problems."""
    found = student_interval([*gains, math.sqrt(0.5), -math.sqrt(0.5)], 1.0 - level)
    return found._replace(estimate=fmean(gains), n=len(gains))


def share_word(gain: Interval, paper: float | None, similar: bool) -> Word:
    """Return the word of a difference of solved shares.

    Args:
        gain: of `share_gain`.
        paper: the paper's difference.
        similar: whether the claim is that not many fewer are solved, see SHARE_MARGIN.
    """
    low, high = gain.low, gain.high
    if low is None or high is None:
        return Word.OPEN
    if similar:
        if low > -SHARE_MARGIN:
            return Word.REPLICATED
        return Word.OPPOSITE if high < -SHARE_MARGIN else Word.OPEN
    if low > 0.0:
        return Word.REPLICATED if high >= (paper or 0.0) else Word.SMALLER
    if high < 0.0:
        return Word.OPPOSITE
    return Word.SAME if low >= -SHARE_MARGIN and high <= SHARE_MARGIN else Word.OPEN


def pooled(effects: Sequence[Interval], level_of_each: float, level: float) -> Interval:
    """Return the ratio of several kinds together, by a random-effects model.

    Weights are by DerSimonian and Laird (1986) on logarithms; the standard error of a kind
    is the width of its interval.

    Args:
        effects: ratios of the kinds with intervals.
        level_of_each: of these intervals, two-sided.
        level: of the result, two-sided.
    """
    usable = [(x.estimate, x.low, x.high) for x in effects if x.estimate and x.low and x.high]
    if len(usable) < 2:
        raise InvalidInputError(f"{len(usable)} kinds with an interval: pooling needs 2 or more")
    z = NormalDist().inv_cdf(1.0 - level_of_each / 2.0)
    y, low, high = np.log(np.array(usable)).T
    variance = ((high - low) / (2.0 * z)) ** 2
    fixed = 1.0 / variance
    common = (fixed * y).sum() / fixed.sum()
    spread = (fixed * (y - common) ** 2).sum() - (len(y) - 1)  # Q less its expectation
    between = max(0.0, spread / (fixed.sum() - (fixed**2).sum() / fixed.sum()))
    weights = 1.0 / (variance + between)
    mean = float((weights * y).sum() / weights.sum())
    half = NormalDist().inv_cdf(1.0 - level / 2.0) / math.sqrt(weights.sum())
    return Interval(math.exp(mean), math.exp(mean - half), math.exp(mean + half), len(y))


def problems_needed(own: Sequence[float], other: Sequence[float], level: float) -> int:
    """Return the number of problems whose ratio of means excludes 1, at the effect of these rows.

    Args:
        own: values of the planner, one for each problem.
        other: values of the baseline.
        level: level of the interval, two-sided.
    """
    ratio, spread = _ratio_and_spread(own, other)
    return sample_size(spread / abs(math.log(ratio)), level)


def problems_for_width(own: Sequence[float], other: Sequence[float], level: float) -> int:
    """Return how many problems give bounds that differ from the estimate by WIDEST_FACTOR.

    Args: see `problems_needed`.
    """
    _, spread = _ratio_and_spread(own, other)
    return sample_size(spread / math.log(WIDEST_FACTOR), level, power=0.5)


def _ratio_and_spread(own: Sequence[float], other: Sequence[float]) -> tuple[float, float]:
    """Return the ratio of means, and the standard deviation of its logarithm for one problem.

    By the delta method, log(mean(own) / mean(other)) has the standard error of the mean of
    (own - ratio other) / mean(own).
    """
    ours, theirs = np.array(own, dtype=float), np.array(other, dtype=float)
    ratio = float(ours.mean() / theirs.mean())
    if len(ours) < FEWEST_PROBLEMS or ratio == 1.0:
        raise InvalidInputError(
            f"{len(ours)} problems with a ratio of means of {ratio:g}: give {FEWEST_PROBLEMS} or "
            "more whose ratio is not 1"
        )
    return ratio, float(np.std((ours - ratio * theirs) / ours.mean(), ddof=1))


def shares_needed(own: Sequence[bool], other: Sequence[bool], level: float) -> int:
    """Return the number of problems whose difference of shares lies above -SHARE_MARGIN.

    Args:
        own: whether the planner solved each problem.
        other: the same of the baseline.
        level: level of the interval, two-sided.
    """
    gains = np.subtract(own, other, dtype=float)
    away = max(abs(float(gains.mean()) + SHARE_MARGIN), 1e-3)
    return sample_size(float(np.std([*gains, 0.5**0.5, -(0.5**0.5)])) / away, level)


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
