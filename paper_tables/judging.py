"""What rows say of the paper's claims: effects with intervals, tests, one correction for all.

A stated number x is tested at STATED_SHARE * x, two-sided: it holds where rows say significantly
more, and does not where they say significantly less. What is solved in time is tested so by what it
is more than CBiRRT's share. The tests of a page are one family, at LEVEL for all together (Holm
1979).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import UNDEFINED, Interval, ratio_of_means_interval
from paper_tables.measures import (
    VALUES,
    Pair,
    Rows,
    by_problem,
    fraction,
    grouped,
    mean_ratio,
    paired,
    problem_key,
)
from paper_tables.statements import CBIRRT, Claim, PublishedValue
from paper_tables.writers import Lines

NOTHING = "–"  # the baseline of a share, which is of nothing but itself
STATED_SHARE = 0.9  # of a stated change that is tested
LEVEL = 0.05  # of all tests of a page together
FEWEST = 3  # problems with numbers of both, for a test


class Ruling(StrEnum):
    """Ruling of rows on a claim, or on it against one baseline."""

    HOLDS = "holds"
    FAILS = "does not hold"
    TOO_FEW = "too few runs to tell"
    INCOMPARABLE = "not comparable"
    NO_ROWS = "no rows yet"


class Verdict(NamedTuple):
    """A claim against one baseline, measured: reductions, or a share of runs, as fractions."""

    claim: Claim
    baseline: str
    paper: float | None  # by the paper's own numbers
    paired: Interval  # 1 - geometric mean of paired ratios; or the share
    means: Interval  # 1 - ratio of means; undefined of shares
    p: float | None  # of "exactly what is tested", two-sided; None where nothing can be tested
    above: bool  # whether the estimate is on the claim's side
    note: str = ""
    ruling: Ruling = Ruling.TOO_FEW  # by `ruled`


def ruled(verdicts: Sequence[Verdict], level: float = LEVEL) -> list[Verdict]:
    """Rule by Holm's step-down: sorted p are compared with level / m, level / (m - 1), ..."""
    found = list(verdicts)
    tested = sorted((verdict.p, k) for k, verdict in enumerate(found) if verdict.p is not None)
    for rank, (p, k) in enumerate(tested):
        if p > level / (len(tested) - rank):
            break
        ruling = Ruling.HOLDS if found[k].above else Ruling.FAILS
        found[k] = found[k]._replace(ruling=ruling)
    return found


def overall(verdicts: Iterable[Verdict]) -> Ruling:
    """Rule a claim: it holds if it does against all baselines, and fails if it does against one."""
    order = (Ruling.FAILS, Ruling.INCOMPARABLE, Ruling.TOO_FEW, Ruling.HOLDS)
    return min((x.ruling for x in verdicts), key=order.index, default=Ruling.NO_ROWS)


# ---------------------------------------------------------------- what is measured


def verdicts_of(claim: Claim, rows: Rows, published: Sequence[PublishedValue]) -> list[Verdict]:
    """The claim against each baseline; against those without rows nothing can be told."""
    own = grouped((row.planner, row) for row in rows)
    if claim.planner not in own:
        return []
    if not claim.baselines:
        return [_share(claim, own, published)]
    judged = own[claim.planner]
    metric = claim.published or claim.metric
    numbers = {item.planner: float(item.value) for item in published if item.metric == metric}
    found = []
    for baseline in claim.baselines:
        others = own.get(baseline, [])
        paper = None
        if claim.planner in numbers and baseline in numbers:
            paper = 1.0 - numbers[claim.planner] / numbers[baseline]
        verdict = reduction(claim, baseline, paired(judged, others, VALUES[claim.metric]), paper)
        silent = verdict.ruling is Ruling.INCOMPARABLE
        left_out = "" if silent else _left_out(judged, others)
        found.append(verdict._replace(note="; ".join(filter(None, (verdict.note, left_out)))))
    return found


def _left_out(judged: Rows, others: Rows) -> str:
    """How many runs are in no pair because one of two planners failed; "" for none."""
    ours = {problem_key(row): row.solved for row in judged}
    theirs = {problem_key(row): row.solved for row in others}
    both = ours.keys() & theirs.keys()
    told = []
    for rows, own, other in ((judged, ours, theirs), (others, theirs, ours)):
        lost = sum(not own[key] and other[key] for key in both)
        if lost:
            told.append(f"{lost} that {rows[0].planner} alone failed")
    return f"left out of {len(both)} runs: {' and '.join(told)}" if told else ""


def reduction(
    claim: Claim, baseline: str, pairs: Sequence[Pair], paper: float | None = None
) -> Verdict:
    """Reduction by both statistics; p is the larger one, 1 if they lie on different sides."""
    means = less(ratio_of_means_interval([(pair.own, pair.other) for pair in pairs]))
    found = Verdict(claim, baseline, paper, less(mean_ratio(pairs)), means, None, False)
    if claim.incomparable and not pairs:
        nothing = UNDEFINED._replace(n=len(pairs))
        why, ruling = claim.incomparable, Ruling.INCOMPARABLE
        return found._replace(paired=nothing, means=nothing, note=why, ruling=ruling)
    if len(pairs) < FEWEST:
        return found._replace(note=f"{len(pairs)} problems")
    tested = 1.0 - STATED_SHARE * claim.stated  # ratio
    # Student's test of the logarithms; Fieller's of a ratio of means
    logs = t_test([math.log(pair.ratio / tested) for pair in pairs])
    differences = t_test([pair.own - tested * pair.other for pair in pairs])
    above = [(one.estimate or 0.0) > 1.0 - tested for one in (found.paired, means)]
    alone = []
    for p, side in zip((logs, differences), above, strict=True):
        ruling = Ruling.HOLDS if side else Ruling.FAILS
        alone.append(Ruling.TOO_FEW if p > LEVEL else ruling)
    note = ""
    if alone[0] is not alone[1] or above[0] != above[1]:
        heaviest = _heaviest(claim.planner, baseline, pairs)
        note = f"each alone, paired: {alone[0]}, means: {alone[1]}; {heaviest}"
    p = max(logs, differences) if above[0] == above[1] else 1.0
    return found._replace(p=p, above=all(above), note=note)


def _heaviest(planner: str, baseline: str, pairs: Sequence[Pair]) -> str:
    """The problem with the largest share of a mean, which decides where the statistics disagree."""
    own = math.fsum(pair.own for pair in pairs)
    other = math.fsum(pair.other for pair in pairs)
    shares = [(pair.own / own, planner, pair.problem) for pair in pairs]
    shares += [(pair.other / other, baseline, pair.problem) for pair in pairs]
    share, name, problem = max(shares)
    return f"problem {problem} alone is {100.0 * share:.0f} % of the mean of {name}"


def less(ratio: Interval) -> Interval:
    """Reduction as a fraction: 1 - ratio."""
    bounds = ratio.estimate, ratio.high, ratio.low
    middle, low, high = (None if x is None else 1.0 - x for x in bounds)
    return Interval(middle, low, high, ratio.n)


def t_test(values: Sequence[float]) -> float:
    """Two-sided p of t = mean sqrt(n) / s (Student); equal values: 0 or 1, one value: 1."""
    if len(values) < 2:
        return 1.0
    if max(values) - min(values) < 1e-12:
        return 1.0 if abs(values[0]) < 1e-12 else 0.0
    from scipy.stats import ttest_1samp  # slow to import

    return float(ttest_1samp(values, 0.0).pvalue)


def score_test(share: Interval, tested: float) -> float:
    """Two-sided p of a share p: z = |p - t| / sqrt(t (1 - t) / n), as Wilson's interval has it."""
    spread = math.sqrt(tested * (1.0 - tested) / share.n)
    return math.erfc(abs((share.estimate or 0.0) - tested) / spread / math.sqrt(2.0))


def cutoff_of(rows: Rows, share: float) -> float:
    """The least time [s] within which `share` of the runs are solved; inf if never."""
    weighted = []
    problems = by_problem(rows)
    for seeds in problems:
        weighted += [(row.t_total_s or 0.0, 1.0 / len(seeds)) for row in seeds if row.solved]
    done = 0.0
    for time, weight in sorted(weighted):
        done += weight
        if done >= share * len(problems) * (1.0 - 1e-12):
            return time
    return math.inf


def _share(claim: Claim, own: Mapping[str, Rows], published: Sequence[PublishedValue]) -> Verdict:
    """A claim on a share of runs; solved in time: what is above CBiRRT's share."""
    if claim.incomparable:
        why, ruling = claim.incomparable, Ruling.INCOMPARABLE
        return Verdict(claim, NOTHING, claim.stated, UNDEFINED, UNDEFINED, None, False, why, ruling)
    accuracy = next((x for x in published if (x.planner, x.metric) == (CBIRRT, "accuracy")), None)
    cutoff, note, known = math.inf, "", 0.0
    if claim.metric == "solved_in_time" and accuracy is not None:
        known = float(accuracy.value) / 100.0
        cutoff = cutoff_of(own.get(CBIRRT, ()), known)
        note = f"within {cutoff:.3g} s, in which {CBIRRT} has solved {100.0 * known:.1f} %"
        if math.isinf(cutoff):
            note = f"{CBIRRT} never solves {100.0 * known:.1f} %: without a cutoff"

    def counted(row: ResultRow) -> bool:
        in_time = row.solved and (row.t_total_s or math.inf) <= cutoff
        return in_time is not (claim.metric == "failed")

    ours = fraction(own[claim.planner], counted)
    tested = known + STATED_SHARE * (claim.stated - known)
    p = None if ours.n < FEWEST else score_test(ours, tested)
    above = (ours.estimate or 0.0) > tested
    return Verdict(claim, NOTHING, claim.stated, ours, UNDEFINED, p, above, note)


# ---------------------------------------------------------------- lines


def percent(verdict: Verdict, interval: Interval) -> str:
    """A reduction as a signed change [%], a share as it is; no decimals."""
    if interval.estimate is None:
        return NOTHING
    sign, signed = (1.0, "") if verdict.baseline == NOTHING else (-1.0, "+")
    bounds = sorted(sign * 100.0 * x for x in (interval.low, interval.high) if x is not None)
    inside = f" [{', '.join(f'{round(x)}' for x in bounds)}]" if bounds else ""
    return f"{round(sign * 100.0 * interval.estimate):{signed}d}{inside}".replace("-", "−")


def verdict_lines(verdicts: Iterable[Verdict]) -> Lines:
    """A line for each verdict."""
    lines = [["planner", "against", "paper [%]", "paired [%]", "means [%]", "n", "p", "verdict"]]
    for verdict in verdicts:
        paper, p = NOTHING, NOTHING
        if verdict.paper is not None:
            sign = 100.0 if verdict.baseline == NOTHING else -100.0
            paper = f"{round(sign * verdict.paper)}".replace("-", "−")
        if verdict.p is not None:
            p = "<0.001" if verdict.p < 0.001 else f"{verdict.p:.3f}"
        numbers = [percent(verdict, interval) for interval in (verdict.paired, verdict.means)]
        n, ruling = str(verdict.paired.n), str(verdict.ruling)
        lines.append([verdict.claim.planner, verdict.baseline, paper, *numbers, n, p, ruling])
    return lines
