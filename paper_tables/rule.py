"""The rule for rows of the paper's experiment inside OMPL; docs/judgement.md states it.

The effect is the paper's own statistic: the ratio of arithmetic means over problems, planner over
baseline; below 1 is what the paper says. The mean of the logarithms of the ratios is the second
statistic. The rule knows no suite and no planner. It was committed before any row that it judges.
"""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.paper_tables import judging
from cvqmpt_lab.paper_tables.judging import Word, sample_size, share_gain
from cvqmpt_lab.results.statistics import Interval, student_interval

FEWEST_PROBLEMS = 30  # for an interval; with 60 of a wide spread it holds the truth in 87 % only
WIDEST_FACTOR = 1.5  # largest ratio of a bound and the estimate of a replicated effect
NO_DIFFERENCE = (0.9, 1.0 / 0.9)  # ratios that count as no difference
LARGEST_WITHOUT_NUMBER = 0.9  # ratio that must not be excluded where the paper prints no number


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


def claim_word(words: Mapping[str, Word]) -> str:
    """Return the word of a claim: that of all baselines, or "mixed (2 of 3)" where they differ.

    words: by baseline. The first number is that of the replicated ones.
    """
    different = set(words.values())
    if len(different) == 1:
        return str(different.pop())
    replicated = sum(word is Word.REPLICATED for word in words.values())
    return f"mixed ({replicated} of {len(words)})"


def share_word(own: Sequence[bool], other: Sequence[bool], level: float, margin: float) -> Word:
    """Return the word of "solves as many": paired difference of solved shares, Agresti and Min.

    Args:
        own: whether the planner solved each problem within the paper's cut-off.
        other: the same of the baseline.
        level: of the interval, two-sided.
        margin: largest loss that is no loss, a share.
    """
    if len(own) < FEWEST_PROBLEMS:
        return Word.OPEN
    gains = [float(a) - float(b) for a, b in zip(own, other, strict=True)]
    return judging.word_of(share_gain(gains, level), margin, 0.0, similar=True)


def pooled(effects: Sequence[Interval], level_of_each: float, level: float) -> Interval:
    """Return the ratio of several kinds together, by a random-effects model.

    Weights are those of DerSimonian and Laird (1986) on logarithms; the standard error of a kind
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

    The standard error of log(mean(own) / mean(other)) is that of the mean of
    (own - ratio other) / mean(own), the delta method.

    Args:
        own: values of the planner, one for each problem.
        other: values of the baseline.
        level: level of the interval, two-sided.
    """
    ours, theirs = np.array(own, dtype=float), np.array(other, dtype=float)
    ratio = float(ours.mean() / theirs.mean())
    if len(ours) < FEWEST_PROBLEMS or ratio == 1.0:
        raise InvalidInputError(
            f"{len(ours)} problems with a ratio of means of {ratio:g}: give {FEWEST_PROBLEMS} or "
            "more whose ratio is not 1"
        )
    spread = float(np.std((ours - ratio * theirs) / ours.mean(), ddof=1))
    return sample_size(spread / abs(math.log(ratio)), level)
