"""The rule for rows of the paper's experiment inside OMPL; docs/judgement.md states it.

The effect is the statistic of the paper's tables: the ratio of arithmetic means, planner over
baseline, each over the problems that it solved; below 1 is what the paper says. Such means favour
a planner that fails where it is slow. So a word in the paper's favour also needs that the planner
solves no fewer problems within the same time, see `within`. The rule knows no suite and no planner.
"""

import math
from collections.abc import Iterable, Sequence
from enum import StrEnum
from statistics import NormalDist, fmean
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.results.statistics import CONFIDENCE, Interval, student_interval
from cvqmpt_lab.paper_tables.bootstrap import ratios_of_means
from cvqmpt_lab.paper_tables.within import FEWEST_PROBLEMS, MARGIN, Within, sample_size

LEVEL = 0.05  # limit of the probability that any sentence is wrongly *replicated*
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


# from the least favourable one; the word of a sentence about two planners is the first of theirs
LEAST_FIRST = (
    *(Word.OPPOSITE, Word.SAME, Word.STATISTIC, Word.HARDWARE, Word.OPEN),
    *(Word.SMALLER, Word.REPLICATED),
)


class Effect(NamedTuple):
    """Ratio of a planner to a baseline by both statistics."""

    means: Interval  # ratio of arithmetic means, each over its own solved problems
    geometric: Interval  # geometric mean of the ratios of problems that both solved
    parts: tuple[Interval, ...] = ()  # `means` by each part of the bootstrap's draws alone

    @staticmethod
    def of(own: Sequence[float], other: Sequence[float], level: float) -> "Effect":
        """Return the effect of values above 0 of the same problems.

        Args:
            own: of the planner, one for each problem; NaN: not solved.
            other: of the baseline.
            level: of both intervals, two-sided.
        """
        if len(own) != len(other):
            raise InvalidInputError(f"{len(own)} and {len(other)} values: give as many of both")
        return Effect.of_prices(np.array([own], float), np.array([other], float), level)[0]

    @staticmethod
    def of_prices(own: np.ndarray, other: np.ndarray, level: float) -> list["Effect"]:
        """Return the effects at k prices.

        Args:
            own: (k, n) values above 0 of the planner on n problems; NaN: not solved.
            other: (k, n) values of the baseline.
            level: of both intervals, two-sided.
        """
        if (own <= 0.0).any() or (other <= 0.0).any():
            raise InvalidInputError("a value is 0 or less: give values above 0, NaN for a failure")
        n = own.shape[1]
        if n < FEWEST_PROBLEMS:
            nothing = Interval(None, None, None, n)
            return [Effect(nothing, nothing)] * len(own)
        logs = np.log(own / other)
        return [
            Effect(
                made.interval,
                student_interval(line[np.isfinite(line)].tolist(), 1.0 - level).mapped(math.exp),
                made.parts,
            )
            for made, line in zip(ratios_of_means(own, other, level), logs, strict=True)
        ]


def few_ratio(own: Sequence[float], other: Sequence[float]) -> Interval:
    """Return the ratio of arithmetic means of few problems with Student's 95 % interval.

    It judges nothing: words need FEWEST_PROBLEMS. The standard error is that of `problems_needed`,
    by the delta method on the logarithm, so one problem has no interval.

    Args:
        own: of the planner, one for each problem, all above 0; NaN: not solved.
        other: of the baseline.
    """
    ratio, away = _ratio_and_away(own, other)
    if not math.isfinite(ratio):
        return Interval(None, None, None, len(own))
    around = student_interval((math.log(ratio) + away).tolist(), CONFIDENCE).mapped(math.exp)
    return around._replace(estimate=ratio, n=len(own))


def word_of(effect: Effect, paper: float | None, within: Within | None = None) -> Word:
    """Return the word of a claim against one baseline.

    Args:
        effect: measured.
        paper: the paper's ratio; None: it prints none, or one that contradicts its sentence.
        within: for times: the shares solved within the same time.
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
        if within is not None and within.fewer:
            word = Word.STATISTIC  # faster over what it solves, but it solves fewer
        elif within is not None and not within.not_fewer:
            word = Word.OPEN
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
    for interval in effect[:2]:
        if interval.low is None or interval.high is None:
            return False
        sides.append((interval.high < 1.0) - (interval.low > 1.0))
    return sides[0] * sides[1] < 0


def word_on_all_hardware(words: Iterable[Word]) -> Word:
    """Return the word that all network times give, else `HARDWARE`."""
    different = set(words)
    return different.pop() if len(different) == 1 else Word.HARDWARE


def word_of_prices(
    effects: Sequence[Effect], paper: float | None, within: Sequence[Within | None]
) -> tuple[Word, tuple[Word, ...]]:
    """Return the word that all network times give, and other words within the bootstrap's error.

    A part of the draws alone, a tenth, may give another word: then a bound is so near a border
    that the word depends on the draws.

    Args:
        effects: one for each time of the network.
        paper: see `word_of`.
        within: one for each effect.
    """

    def word(made: Iterable[Effect]) -> Word:
        pairs = zip(made, within, strict=True)
        return word_on_all_hardware(word_of(effect, paper, shares) for effect, shares in pairs)

    first = word(effects)
    parts = zip(*(effect.parts for effect in effects), strict=True)
    others = (word(e._replace(means=x) for e, x in zip(effects, of, strict=True)) for of in parts)
    return first, tuple(dict.fromkeys(other for other in others if other is not first))


def weakest(words: Iterable[Word]) -> Word:
    """Return the least favourable word, see `LEAST_FIRST`."""
    return min(words, key=LEAST_FIRST.index)


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
        similar: whether the claim is that not many fewer are solved, see MARGIN.
    """
    low, high = gain.low, gain.high
    if low is None or high is None:
        return Word.OPEN
    if similar:
        if low > -MARGIN:
            return Word.REPLICATED
        return Word.OPPOSITE if high < -MARGIN else Word.OPEN
    if low > 0.0:
        return Word.REPLICATED if high >= (paper or 0.0) else Word.SMALLER
    if high < 0.0:
        return Word.OPPOSITE
    return Word.SAME if low >= -MARGIN and high <= MARGIN else Word.OPEN


def pooled(effects: Sequence[Effect], level: float) -> Effect:
    """Return the effect of several kinds together, by a random-effects model.

    Weights are by DerSimonian and Laird (1986) on logarithms; the standard error of a kind
    is the width of its interval.

    Args:
        effects: of the kinds, at the same level.
        level: of these intervals and of the result, two-sided.
    """
    parts = zip(*(effect.parts for effect in effects), strict=True)
    return Effect(
        _pooled([effect.means for effect in effects], level),
        _pooled([effect.geometric for effect in effects], level),
        tuple(_pooled(part, level) for part in parts),
    )


def _pooled(effects: Sequence[Interval], level: float) -> Interval:
    usable = [(x.estimate, x.low, x.high) for x in effects if x.estimate and x.low and x.high]
    if len(usable) < 2:
        raise InvalidInputError(f"{len(usable)} kinds with an interval: pooling needs 2 or more")
    z = NormalDist().inv_cdf(1.0 - level / 2.0)
    y, low, high = np.log(np.array(usable)).T
    variance = ((high - low) / (2.0 * z)) ** 2
    fixed = 1.0 / variance
    common = (fixed * y).sum() / fixed.sum()
    spread = (fixed * (y - common) ** 2).sum() - (len(y) - 1)  # Q less its expectation
    between = max(0.0, spread / (fixed.sum() - (fixed**2).sum() / fixed.sum()))
    weights = 1.0 / (variance + between)
    mean = float((weights * y).sum() / weights.sum())
    half = z / math.sqrt(weights.sum())
    return Interval(math.exp(mean), math.exp(mean - half), math.exp(mean + half), len(y))


def problems_needed(own: Sequence[float], other: Sequence[float], level: float) -> int:
    """Return how many problems exclude 1 and give bounds within WIDEST_FACTOR of the estimate.

    The effect and its spread are those of these rows.

    Args:
        own: values of the planner, one for each problem; NaN: not solved.
        other: values of the baseline.
        level: level of the interval, two-sided.
    """
    ratio, away = _ratio_and_away(own, other)
    if len(own) < FEWEST_PROBLEMS or not math.isfinite(ratio) or ratio == 1.0:
        raise InvalidInputError(
            f"{len(own)} problems with a ratio of means of {ratio:g}: give {FEWEST_PROBLEMS} or "
            "more whose ratio is not 1"
        )
    spread = float(np.std(away, ddof=1))
    wide = sample_size(spread / math.log(WIDEST_FACTOR), level, power=0.5)
    return max(sample_size(spread / abs(math.log(ratio)), level), wide)


def pooled_needed(effect: Interval, count: int, level: float) -> int:
    """Return how many problems exclude 1 where kinds are pooled, if all kinds grow alike.

    Args:
        effect: pooled, with an interval.
        count: problems of it.
        level: of the interval, two-sided.
    """
    assert effect.estimate and effect.high and effect.low
    half, away = 0.5 * math.log(effect.high / effect.low), abs(math.log(effect.estimate))
    normal = NormalDist()
    more = 1.0 + normal.inv_cdf(0.8) / normal.inv_cdf(1.0 - level / 2.0)
    return max(count + 1, math.ceil(count * (more * half / max(away, 1e-3)) ** 2))


def _ratio_and_away(own: Sequence[float], other: Sequence[float]) -> tuple[float, np.ndarray]:
    """Return the ratio of means, and by how much each problem changes its logarithm.

    By the delta method, log(mean(own) / mean(other)) has the standard error of the mean of the
    second; each mean is over the problems that its planner solved.
    """
    means, parts = [], []
    for values in (np.array(own, dtype=float), np.array(other, dtype=float)):
        solved = np.isfinite(values)
        means.append(float(values[solved].mean()) if solved.any() else math.nan)
        share = max(float(solved.mean()), 1e-9)
        parts.append(np.where(solved, values / means[-1] - 1.0, 0.0) / share)
    return means[0] / means[1], parts[0] - parts[1]


def shares_needed(own: Sequence[bool], other: Sequence[bool], level: float) -> int:
    """Return the number of problems whose difference of shares lies above -MARGIN.

    Args:
        own: whether the planner solved each problem.
        other: the same of the baseline.
        level: level of the interval, two-sided.
    """
    gains = np.subtract(own, other, dtype=float)
    away = max(abs(float(gains.mean()) + MARGIN), 1e-3)
    return sample_size(float(np.std([*gains, 0.5**0.5, -(0.5**0.5)])) / away, level)
