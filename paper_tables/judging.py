"""What rows say of the paper's sentences: measured reductions and shares, with verdicts."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import Interval
from paper_tables.measures import VALUES, Rows, fraction, paired_ratio, solved
from paper_tables.paper_numbers import PublishedValue
from paper_tables.statements import Statement
from paper_tables.writers import Lines, estimate

NOTHING = "–"  # the baseline of a share, which is of nothing but itself
SHARES: Mapping[str, tuple[Callable[[ResultRow], bool], Callable[[ResultRow], bool]]] = {
    "accuracy": (lambda row: True, solved),
    "true_free": (solved, lambda row: row.true_free is True),
}
"""By metric: which runs, and what is counted of them."""


PRECISION = 0.2
"""Width of a 95 % interval up to which a number inside it is called compatible, and a difference unclear."""


class Ruling(StrEnum):
    """What an interval says of a stated number."""

    CONFIRMED = "confirmed"
    COMPATIBLE = "compatible: the interval contains it"
    LESS = "less than stated"
    MORE = "not confirmed: more of it"
    UNCLEAR = "not confirmed: no clear difference"
    TOO_FEW = "too few runs to tell"
    UNJUDGED = "not judged: too few that both solved"

    @property
    def holds(self) -> bool:
        """Whether the statement can stand."""
        return self in (Ruling.CONFIRMED, Ruling.COMPATIBLE)


class Verdict(NamedTuple):
    """A statement against one baseline."""

    statement: Statement
    baseline: str
    paper: float | None  # what the paper's own numbers say, as a fraction
    ours: Interval
    ruling: Ruling


def judged(
    statements: Iterable[Statement], rows: Rows, published: Sequence[PublishedValue]
) -> tuple[Verdict, ...]:
    """Verdicts on statements about planners that were run."""
    own = {planner: [row for row in rows if row.planner == planner] for planner in {r.planner for r in rows}}
    return tuple(
        _share(statement, own[statement.planner])
        if baseline == NOTHING
        else _reduction(statement, baseline, own, published)
        for statement in statements
        for baseline in statement.baselines or (NOTHING,)
        if statement.planner in own and (baseline in own or baseline == NOTHING)
    )


def _share(statement: Statement, rows: Rows) -> Verdict:
    among, counted = SHARES[statement.metric]
    ours = fraction([row for row in rows if among(row)], counted)
    found = Ruling.CONFIRMED
    if ours.low is None or ours.high is None:
        found = Ruling.UNJUDGED
    elif ours.high < statement.stated:
        found = Ruling.LESS
    elif ours.low < statement.stated:
        found = Ruling.COMPATIBLE if _precise(ours) else Ruling.TOO_FEW
    return Verdict(statement, NOTHING, statement.stated, ours, found)


def _reduction(
    statement: Statement, baseline: str, own: Mapping[str, Rows], published: Sequence[PublishedValue]
) -> Verdict:
    """The ratio over problems and seeds that both solved."""
    metric = statement.published or statement.metric
    numbers = {item.planner: float(item.value) for item in published if item.metric == metric}
    paper = None
    if statement.planner in numbers and baseline in numbers:
        paper = 1.0 - numbers[statement.planner] / numbers[baseline]
    ours = less(paired_ratio(own[statement.planner], own[baseline], VALUES[statement.metric]))
    return Verdict(statement, baseline, paper, ours, ruling(ours, statement.stated))


def less(ratio: Interval) -> Interval:
    """How much less of something a ratio means, as a fraction."""
    middle, low, high = (None if x is None else 1.0 - x for x in (ratio.estimate, ratio.high, ratio.low))
    return Interval(middle, low, high, ratio.n)


def ruling(ours: Interval, stated: float) -> Ruling:
    """What a measured reduction says of a stated one (fractions)."""
    if ours.estimate is None or ours.low is None or ours.high is None:
        return Ruling.UNJUDGED
    if ours.low > 0.0 and ours.low >= stated:
        return Ruling.CONFIRMED
    if stated > 0.0 and ours.high >= stated:
        return Ruling.COMPATIBLE if _precise(ours) else Ruling.TOO_FEW
    if ours.low > 0.0:
        return Ruling.LESS
    if ours.high < 0.0:
        return Ruling.MORE
    return Ruling.UNCLEAR if _precise(ours) else Ruling.TOO_FEW


def _precise(ours: Interval) -> bool:
    """Whether an interval is narrow enough to judge a number inside it."""
    return ours.low is not None and ours.high is not None and ours.high - ours.low <= PRECISION


def statement_lines(verdicts: Sequence[Verdict]) -> Lines:
    """A line a verdict; nothing without verdicts."""
    lines = [["statement", "against", "paper's numbers [%]", "ours [%]", "n", "verdict"]]
    for item in verdicts:
        paper = "–" if item.paper is None else f"{100.0 * item.paper:.1f}"
        text = f"{item.statement.planner} {item.statement.text}"
        ours = item.ours.scaled(100.0)
        lines.append([text, item.baseline, paper, estimate(ours), str(ours.n), item.ruling])
    return lines if verdicts else []
