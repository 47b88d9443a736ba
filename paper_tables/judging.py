"""The rule by which rows judge the paper's claims; docs/judgement.md states it with its sources.

All effects are *gains*: 0 is no effect, and positive gains agree with the paper. The gain of a
problem is the mean over its seeds of log(baseline / own), or the difference of two fractions of
solved runs. The rule does not depend on suites and planners.
"""

import math
from collections.abc import Iterable, Sequence
from enum import StrEnum
from statistics import fmean, median, stdev
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.paper_tables.measures import Pair
from cvqmpt_lab.paper_tables.statements import Claim
from cvqmpt_lab.paper_tables.writers import Lines
from cvqmpt_lab.results.statistics import CONFIDENCE, UNDEFINED, Interval, student_interval

NOTHING = "–"
REACHED = 0.9  # fraction of the paper's number that counts as reaching it
LEVEL = 0.05  # limit of the probability that any claim of a page is wrongly *replicated*
POWER = 0.8  # power of a study that would decide an inconclusive claim
FEWEST = 3  # smallest number of problems for an interval
DRAWS = 2000  # simulated studies of the paper's size


class Word(StrEnum):
    """Result of a claim, or of its comparison with one baseline; the worst is the first."""

    OPPOSITE = "opposite"
    SAME = "no difference"
    NO_ROWS = "no rows yet"
    OPEN = "inconclusive"
    STATISTIC = "depends on the statistic"  # by `rule` alone, as the next one
    HARDWARE = "depends on hardware"
    SMALLER = "same direction, smaller"
    REPLICATED = "replicated"
    UNTESTABLE = "not testable"


def word_of(gain: Interval, margin: float, reached: float, similar: bool = False) -> Word:
    """Return the word for an interval.

    Args:
        gain: interval of the gain; its bounds are None if there are too few problems.
        margin: largest gain of either sign that counts as no difference.
        reached: gain that is required for *replicated*, see `Verdict.reached`.
        similar: whether the claim is that at most `margin` is lost.
    """
    if gain.low is None or gain.high is None:
        return Word.OPEN
    low, high = gain.low, gain.high
    if similar:
        if low > -margin:
            return Word.REPLICATED
        return Word.OPPOSITE if high < -margin else Word.OPEN
    if low > 0.0 and high >= reached:
        return Word.REPLICATED
    if low >= -margin and high <= margin:
        return Word.SAME
    if high < 0.0:
        return Word.OPPOSITE
    return Word.SMALLER if low > 0.0 else Word.OPEN


def share_gain(gains: Sequence[float], level: float) -> Interval:
    """Return the mean difference of solved fractions with Student's interval.

    Two pseudo-problems are added, one for each side (Agresti and Min 2005). Without them, ten of
    ten solved by both planners would be certain to be equal.

    Args:
        gains: differences of the problems.
        level: two-sided level of the interval.
    """
    pseudo = (math.sqrt(0.5), -math.sqrt(0.5))
    found = student_interval([*gains, *pseudo], 1.0 - level)
    return found._replace(estimate=fmean(gains), n=len(gains))


def sample_size(ratio: float, level: float) -> int:
    """Return the number of values whose mean a t test distinguishes from a number with POWER.

    Args:
        ratio: standard deviation of the values, divided by the distance of their mean from the
            number.
        level: two-sided level of the test.
    """
    from scipy.special import stdtrit  # slow to import

    count, last = FEWEST, 0
    for _ in range(30):  # fixed-point iteration: the quantiles depend on the count
        quantiles = stdtrit(count - 1, 1.0 - level / 2.0) + stdtrit(count - 1, POWER)
        last, count = count, max(FEWEST, math.ceil((float(quantiles) * ratio) ** 2))
        if abs(count - last) <= 1:
            break
    return max(count, last)


class Verdict(NamedTuple):
    """A claim about one planner against one baseline."""

    claim: Claim
    planner: str
    baseline: str
    kind: str  # kind of problems, if a claim is judged for each kind; else ""
    pairs: Sequence[Pair]
    level: float  # two-sided error level of the interval
    paper: float | None  # gain by the paper's numbers
    failed: tuple[int, int, int] = (0, 0, 0)  # failed runs of planner and baseline, all runs
    known: bool = True  # whether there are enough rows for a verdict

    @property
    def comparison(self) -> tuple[str, str, str]:
        """Planner, baseline and kind of problems."""
        return self.planner, self.baseline, self.kind

    @property
    def against(self) -> str:
        """Baseline and kind of problems."""
        return f"{self.baseline}, {self.kind}" if self.kind else self.baseline

    @property
    def gains(self) -> list[float]:
        """Gains of the problems: log ratios, or differences of solved shares."""
        if self.claim.is_share:
            return [pair.own - pair.other for pair in self.pairs]
        return [-math.log(pair.ratio) for pair in self.pairs]

    @property
    def gain(self) -> Interval:
        """Mean over problems with Student's interval at the level of the page.

        For fractions of solved runs see `share_gain`.
        """
        gains = self.gains
        if len(gains) < FEWEST:
            return Interval(fmean(gains) if gains else None, None, None, len(gains))
        if self.claim.is_share:
            return share_gain(gains, self.level)
        return student_interval(gains, 1.0 - self.level)

    @property
    def reached(self) -> float:
        """Gain required for *replicated*: REACHED times the paper's effect, if it has one."""
        if self.paper is None or self.paper <= 0.0:
            return self.claim.margin
        if self.claim.is_share:
            return REACHED * self.paper
        return -math.log(1.0 - REACHED * (1.0 - math.exp(-self.paper)))

    @property
    def word(self) -> Word:
        """Word by the rule of docs/judgement.md."""
        if self.claim.untestable:
            return Word.UNTESTABLE
        if not self.pairs:
            return Word.NO_ROWS
        gain = self.gain if self.known else UNDEFINED
        return word_of(gain, self.claim.margin, self.reached, self.claim.similar)

    @property
    def inside(self) -> bool | None:
        """Whether the paper's number lies in the measured interval; None if one is missing."""
        low, high = self.gain.low, self.gain.high
        if self.paper is None or low is None or high is None:
            return None
        return low <= self.paper <= high

    @property
    def needed(self) -> int | None:
        """Number of problems that would decide an inconclusive claim, at the measured effect."""
        gains = self.gains
        if self.word is not Word.OPEN or len(gains) < FEWEST:
            return None
        mean, margin = fmean(gains), self.claim.margin
        away = abs(mean + margin) if self.claim.similar else max(abs(mean), margin - abs(mean))
        spread = stdev(gains) or math.sqrt(1.0 / len(gains))  # the spread of the pseudo-problems
        return max(len(gains) + 1, sample_size(spread / max(away, 1e-3), self.level))

    @property
    def resolved(self) -> Interval:
        """95 % range of the paper's statistic in studies of the paper's size.

        Studies are drawn from these rows, with the paper's number of problems and one seed each.
        The statistic is the ratio of means, or the difference of fractions of solved runs.
        """
        count = self.claim.runs
        if not count or not self.pairs:
            return UNDEFINED
        rng = np.random.default_rng(0)
        most = max(len(pair.values) for pair in self.pairs)
        # (problems, seeds, 2); problems with fewer seeds repeat theirs
        runs = np.array([[pair.values[k % len(pair.values)] for k in range(most)]
                         for pair in self.pairs], dtype=np.float64)  # fmt: skip
        size = (DRAWS, count)
        drawn = runs[rng.integers(len(runs), size=size), rng.integers(most, size=size)].mean(axis=1)
        own, other = drawn.T
        gains = own - other if self.claim.is_share else np.log(other / own)
        tail = (1.0 - CONFIDENCE) / 2.0
        middle, low, high = (float(x) for x in np.quantile(gains, [0.5, tail, 1.0 - tail]))
        return Interval(middle, low, high, count)

    @property
    def means(self) -> float | None:
        """Gain of the ratio of means, the paper's statistic, in which large values weigh more."""
        if self.claim.is_share or not self.pairs:
            return None
        own, other = (math.fsum(side) for side in self._sides())
        return math.log(other / own)

    @property
    def heaviest(self) -> float | None:
        """Largest share of one problem in the mean of either planner."""
        if self.claim.is_share or not self.pairs:
            return None
        return max(max(side) / math.fsum(side) for side in self._sides())

    def _sides(self) -> tuple[list[float], list[float]]:
        return [pair.own for pair in self.pairs], [pair.other for pair in self.pairs]

    def shown(self, gain: float | None) -> str:
        """Return a gain as a signed change of the planner's value [%], or as percentage points."""
        if gain is None:
            return NOTHING
        change = 100.0 * (gain if self.claim.is_share else math.expm1(-gain))
        return f"{round(change):+d}".replace("-", "−").replace("+0", "0")

    def bounds_text(self, gain: Interval) -> str:
        """Return the bounds of an interval as changes, the smaller first; "" without bounds."""
        if gain.low is None:
            return ""
        bounds = (gain.low, gain.high) if self.claim.is_share else (gain.high, gain.low)
        return ", ".join(map(self.shown, bounds))

    def interval_text(self, gain: Interval) -> str:
        """Return estimate and bounds as changes, with the unit."""
        if gain.estimate is None:
            return NOTHING
        bounds = self.bounds_text(gain)
        inside = f" [{bounds}]" if bounds else ""
        return f"{self.shown(gain.estimate)}{inside} {self.claim.unit}"


def overall(verdicts: Iterable[Verdict]) -> Word:
    """Return the word of a claim, the worst word of its comparisons."""
    order = list(Word)
    return min((x.word for x in verdicts), key=order.index, default=Word.NO_ROWS)


def verdict_lines(verdicts: Iterable[Verdict]) -> Lines:
    """Return a line for each verdict; the last three columns only show the sensitivity."""
    columns = "planner,against,paper,measured,problems,failed,paper inside?,verdict,to decide,"
    lines = [f"{columns}single runs resolve,means,median,heaviest".split(",")]
    for item in verdicts:
        unit, runs = item.claim.unit, item.resolved
        middle = median(item.gains) if item.pairs else None
        gains = (item.paper, item.means, middle)
        paper, means, typical = (NOTHING if x is None else f"{item.shown(x)} {unit}" for x in gains)
        cells = [item.planner, item.against, paper, item.interval_text(item.gain)]
        cells += [str(len(item.pairs)), "{} / {} of {}".format(*item.failed)]
        cells += [{None: NOTHING, True: "yes", False: "no"}[item.inside], str(item.word)]
        cells.append(NOTHING if item.needed is None else f"{item.needed} problems")
        cells.append(f"{runs.n}: [{item.bounds_text(runs)}] {unit}" if runs.n else NOTHING)
        heaviest = NOTHING if item.heaviest is None else f"{100.0 * item.heaviest:.0f} %"
        lines.append([*cells, means, typical, heaviest])
    return lines
