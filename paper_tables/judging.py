"""What rows say of the paper's statements: effects with intervals, tests, and one correction for
all of them.

A stated number x is tested at STATED_SHARE * x, two-sided: it holds where rows say significantly
more, and does not where they say significantly less. What is solved in time is tested so by what it
is more than CBiRRT's share. The tests of a page are one family, at LEVEL for all together (Holm
1979).
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import (
    UNDEFINED,
    Interval,
    geometric_mean_interval,
    ratio_of_means_interval,
)
from paper_tables.measures import (
    VALUES,
    Pair,
    Rows,
    by_problem,
    fraction,
    paired_values,
    problem_key,
)
from paper_tables.paper_numbers import PublishedValue
from paper_tables.statements import CBIRRT, Statement
from paper_tables.writers import Lines

NOTHING = "–"  # the baseline of a share, which is of nothing but itself
STATED_SHARE = 0.9
LEVEL = 0.05
FEWEST = 3  # problems with numbers of both, for a test


class Ruling(StrEnum):
    """What rows say of a statement, or of a claim."""

    HOLDS = "holds"
    FAILS = "does not hold"
    TOO_FEW = "too few runs to tell"
    INCOMPARABLE = "not comparable"
    NO_ROWS = "no rows yet"


class Effect(NamedTuple):
    """A statement against one baseline, measured: reductions, or a share of runs, as fractions."""

    statement: Statement
    baseline: str
    paper: float | None  # by the paper's own numbers
    paired: Interval  # 1 - geometric mean of paired ratios; or the share
    means: Interval  # 1 - ratio of means; undefined of shares
    p: float | None  # of "exactly what is tested", two-sided; None where nothing can be tested
    above: bool  # whether the estimate is on the statement's side
    note: str = ""


class Verdict(NamedTuple):
    """An effect with what was ruled of it."""

    effect: Effect
    ruling: Ruling


def rulings(effects: Sequence[Effect], level: float = LEVEL) -> list[Ruling]:
    """What is ruled of each, by Holm's step-down:
    sorted p are compared with level / m, level / (m - 1), ...
    """
    tested = sorted(
        (k for k, e in enumerate(effects) if e.p is not None), key=lambda k: effects[k].p or 0.0
    )
    found = [Ruling.INCOMPARABLE if e.statement.incomparable else Ruling.TOO_FEW for e in effects]
    for rank, k in enumerate(tested):
        p = effects[k].p
        if p is None or p > level / (len(tested) - rank):
            break
        found[k] = Ruling.HOLDS if effects[k].above else Ruling.FAILS
    return found


def overall(found: Sequence[Ruling]) -> Ruling:
    """What is ruled of a claim:
    it holds where all its statements do, and does not where one does not.
    """
    if not found:
        return Ruling.NO_ROWS
    order = (Ruling.FAILS, Ruling.INCOMPARABLE, Ruling.TOO_FEW, Ruling.HOLDS)
    return min(found, key=order.index)


# ---------------------------------------------------------------- effects


def effects_of(
    statement: Statement, rows: Rows, published: Sequence[PublishedValue]
) -> list[Effect]:
    """The statement against each baseline, those without rows included:
    against them nothing can be told.
    """
    own = {
        planner: [row for row in rows if row.planner == planner]
        for planner in {r.planner for r in rows}
    }
    if statement.planner not in own:
        return []
    if not statement.baselines:
        return [_share(statement, own, published)]
    value, judged = VALUES[statement.metric], own[statement.planner]
    found = []
    for baseline in statement.baselines:
        others = own.get(baseline, [])
        pairs = paired_values(judged, others, value)
        effect = reduction(statement, baseline, pairs, _published(statement, baseline, published))
        left_out = "" if statement.incomparable else _left_out(judged, others)
        found.append(effect._replace(note="; ".join(filter(None, (effect.note, left_out)))))
    return found


def _left_out(judged: Rows, others: Rows) -> str:
    """How many runs are in no pair because one of two planners, each of which has rows, failed;
    "" for none.
    """
    solved = [{problem_key(row): row.solved for row in rows} for rows in (judged, others)]
    both = solved[0].keys() & solved[1].keys()
    lost = [
        sum(not one[key] and other[key] for key in both) for one, other in (solved, solved[::-1])
    ]
    told = [
        f"{n} that {rows[0].planner} alone failed"
        for n, rows in zip(lost, (judged, others), strict=True)
        if n
    ]
    return f"left out of {len(both)} runs: {' and '.join(told)}" if told else ""


def reduction(
    statement: Statement, baseline: str, pairs: Sequence[Pair], paper: float | None = None
) -> Effect:
    """By both statistics; p is the larger of theirs, 1 where they lie on different sides."""
    paired = less(geometric_mean_interval([pair.ratio for pair in pairs]))
    means = less(ratio_of_means_interval([(pair.own, pair.other) for pair in pairs]))
    if statement.incomparable:
        nothing = UNDEFINED._replace(n=paired.n)
        return Effect(
            statement, baseline, paper, nothing, nothing, None, False, statement.incomparable
        )
    tested = 1.0 - STATED_SHARE * statement.stated  # ratio
    if len(pairs) < FEWEST:
        return Effect(
            statement, baseline, paper, paired, means, None, False, f"{len(pairs)} problems"
        )
    logs = t_test([math.log(pair.ratio / tested) for pair in pairs])
    # Fieller's test of a ratio of means
    differences = t_test([pair.own - tested * pair.other for pair in pairs])
    above = [(one.estimate or 0.0) > 1.0 - tested for one in (paired, means)]
    said = [_alone(p, side) for p, side in zip((logs, differences), above, strict=True)]
    note = ""
    if said[0] is not said[1] or above[0] != above[1]:
        note = (
            f"each alone, paired: {said[0]}, means: {said[1]}; "
            f"{_heaviest(statement.planner, baseline, pairs)}"
        )
    p = max(logs, differences) if above[0] == above[1] else 1.0
    return Effect(statement, baseline, paper, paired, means, p, all(above), note)


def _alone(p: float, above: bool) -> Ruling:
    """What one statistic says, uncorrected."""
    return Ruling.TOO_FEW if p > LEVEL else Ruling.HOLDS if above else Ruling.FAILS


def _heaviest(planner: str, baseline: str, pairs: Sequence[Pair]) -> str:
    """The problem with the largest share of a mean, which decides where the statistics disagree."""
    own, other = (
        math.fsum(column) for column in ([x.own for x in pairs], [x.other for x in pairs])
    )
    shares = [(x.own / own, planner, x.problem) for x in pairs] + [
        (x.other / other, baseline, x.problem) for x in pairs
    ]
    share, name, problem = max(shares)
    return f"problem {problem} alone is {100.0 * share:.0f} % of the mean of {name}"


def less(ratio: Interval) -> Interval:
    """How much less of something a ratio means, as a fraction."""
    middle, low, high = (
        None if x is None else 1.0 - x for x in (ratio.estimate, ratio.high, ratio.low)
    )
    return Interval(middle, low, high, ratio.n)


def t_test(values: Sequence[float]) -> float:
    """Two-sided p of Student's test that the mean is zero; 0 or 1 where all values are equal;
    1 for one value.
    """
    if len(values) < 2:
        return 1.0
    if max(values) - min(values) < 1e-12:
        return 1.0 if abs(values[0]) < 1e-12 else 0.0
    from scipy.stats import ttest_1samp  # slow to import

    return float(ttest_1samp(values, 0.0).pvalue)


def score_test(share: Interval, tested: float) -> float:
    """Two-sided p of a share, whose test Wilson's interval inverts."""
    spread = math.sqrt(tested * (1.0 - tested) / share.n)
    return math.erfc(abs((share.estimate or 0.0) - tested) / spread / math.sqrt(2.0))


# ---------------------------------------------------------------- shares


class Cutoff(NamedTuple):
    """The time within which a planner solves a share of its runs."""

    seconds: float
    note: str


def cutoff_of(rows: Rows, share: float) -> Cutoff:
    """The least time [s] within which `share` of the runs are solved;
    infinite where they never are.
    """
    counted = [1.0 / len(seeds) for seeds in by_problem(rows) for _ in seeds]
    times = [row.t_total_s if row.solved else None for seeds in by_problem(rows) for row in seeds]
    done, total = 0.0, math.fsum(counted)
    for time, weight in sorted(
        (t, w) for t, w in zip(times, counted, strict=True) if t is not None
    ):
        done += weight
        if done >= share * total * (1.0 - 1e-12):
            note = f"within {time:.3g} s, in which {CBIRRT} has solved {100.0 * share:.1f} %"
            return Cutoff(time, note)
    return Cutoff(math.inf, f"{CBIRRT} never solves {100.0 * share:.1f} %: without a cutoff")


SHARES: Mapping[str, Callable[[ResultRow, Cutoff], bool]] = {
    "accuracy": lambda row, cutoff: row.solved,
    "failed": lambda row, cutoff: not row.solved,
    "solved_in_time": lambda row, cutoff: (
        row.solved and (row.t_total_s or math.inf) <= cutoff.seconds
    ),
}
"""By metric: what is counted of a planner's runs."""


def _share(
    statement: Statement, own: Mapping[str, Rows], published: Sequence[PublishedValue]
) -> Effect:
    accuracy = next((x for x in published if (x.planner, x.metric) == (CBIRRT, "accuracy")), None)
    cutoff, known = Cutoff(math.inf, ""), 0.0
    if statement.metric == "solved_in_time" and accuracy is not None:
        known = float(accuracy.value) / 100.0
        cutoff = cutoff_of(own.get(CBIRRT, ()), known)
    counted = SHARES[statement.metric]
    ours = fraction(own[statement.planner], lambda row: counted(row, cutoff))
    ours = UNDEFINED if statement.incomparable else ours
    tested = known + STATED_SHARE * (statement.stated - known)
    p = None if ours.n < FEWEST else score_test(ours, tested)
    note = statement.incomparable or cutoff.note
    return Effect(
        statement,
        NOTHING,
        statement.stated,
        ours,
        UNDEFINED,
        p,
        (ours.estimate or 0.0) > tested,
        note,
    )


def _published(
    statement: Statement, baseline: str, published: Sequence[PublishedValue]
) -> float | None:
    metric = statement.published or statement.metric
    numbers = {item.planner: float(item.value) for item in published if item.metric == metric}
    if statement.planner not in numbers or baseline not in numbers:
        return None
    return 1.0 - numbers[statement.planner] / numbers[baseline]


# ---------------------------------------------------------------- lines


def percent(effect: Effect, interval: Interval) -> str:
    """A reduction as a signed change [%], a share as it is; no decimals."""
    if interval.estimate is None:
        return NOTHING
    sign = 1.0 if effect.baseline == NOTHING else -1.0
    bounds = sorted(sign * 100.0 * x for x in (interval.low, interval.high) if x is not None)
    inside = f" [{', '.join(f'{round(x)}' for x in bounds)}]" if bounds else ""
    signed = "" if effect.baseline == NOTHING else "+"
    return f"{round(sign * 100.0 * interval.estimate):{signed}d}{inside}".replace("-", "−")


def verdict_lines(verdicts: Iterable[Verdict]) -> Lines:
    """A line a verdict."""
    lines = [["planner", "against", "paper [%]", "paired [%]", "means [%]", "n", "p", "verdict"]]
    for effect, ruled in verdicts:
        sign = 100.0 if effect.baseline == NOTHING else -100.0
        paper = (
            NOTHING if effect.paper is None else f"{round(sign * effect.paper)}".replace("-", "−")
        )
        p = NOTHING if effect.p is None else "<0.001" if effect.p < 0.001 else f"{effect.p:.3f}"
        numbers = (percent(effect, effect.paired), percent(effect, effect.means))
        lines.append(
            [
                effect.statement.planner,
                effect.baseline,
                paper,
                *numbers,
                str(effect.paired.n),
                p,
                str(ruled),
            ]
        )
    return lines


def precision(effect: Effect) -> str:
    """How well the paired effect is known, as half the width of its interval."""
    if effect.paired.low is None or effect.paired.high is None:
        return ""
    return f"known to ±{50.0 * (effect.paired.high - effect.paired.low):.0f} points"
