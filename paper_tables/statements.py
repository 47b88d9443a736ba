"""Sentences of the paper about its numbers, judged by its own table and by ours."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import Interval
from paper_tables.cells import Lines, estimate
from paper_tables.comparison import Value, fraction, paired_ratio
from paper_tables.paper_numbers import PublishedValue

NOTHING = "–"
"""The baseline of a share, which is of nothing but itself."""


@dataclass(frozen=True)
class Statement:
    """A sentence of the paper: `planner` needs `reduction` (a fraction; 0: any) less of `metric` than `baseline`."""

    text: str
    metric: str
    reduction: float
    planner: str = "opt-cvq-mpt"
    baselines: tuple[str, ...] = ("ompl-projected", "atlas-rrt", "tb-rrt")
    published: str | None = None
    """The paper's metric, where ours has another name."""


class Ruling(StrEnum):
    """What an interval says of a stated number."""

    CONFIRMED = "confirmed"
    COMPATIBLE = "compatible: the interval contains it"
    LESS = "less than stated"
    MORE = "not confirmed: more of it"
    UNCLEAR = "not confirmed: no clear difference"
    UNJUDGED = "not judged: too few that both solved"

    @property
    def holds(self) -> bool:
        """Whether the statement can stand."""
        return self in (Ruling.CONFIRMED, Ruling.COMPATIBLE)


@dataclass(frozen=True)
class Verdict:
    """A statement against one baseline."""

    statement: Statement
    baseline: str
    paper: float | None
    """What the paper's own numbers say, as a fraction."""
    ours: Interval
    """What ours say."""
    ruling: Ruling


def judged(
    statements: Sequence[Statement],
    rows: Sequence[ResultRow],
    published: Sequence[PublishedValue],
    values: Mapping[str, Value],
) -> tuple[Verdict, ...]:
    """Verdicts on statements about planners that were run; values: of a row, by metric."""
    run = {row.planner for row in rows}
    return tuple(
        _verdict(statement, baseline, rows, published, values[statement.metric])
        for statement in statements
        for baseline in statement.baselines
        if {statement.planner, baseline} <= run
    )


def statement_lines(verdicts: Sequence[Verdict]) -> Lines:
    """A line a verdict."""
    lines = [["statement", "against", "paper's numbers [%]", "ours [%]", "n", "verdict"]]
    for item in verdicts:
        paper = "–" if item.paper is None else f"{100.0 * item.paper:.1f}"
        text = f"{item.statement.planner} {item.statement.text}"
        ours = item.ours.scaled(100.0)
        lines.append([text, item.baseline, paper, estimate(ours), str(ours.n), item.ruling])
    return lines


def judged_share(
    statement: Statement, rows: Sequence[ResultRow], counted: Callable[[ResultRow], bool]
) -> tuple[Verdict, ...]:
    """The verdict on a share of the planner's rows that is at least `reduction`; none where it was not run."""
    own = [row for row in rows if row.planner == statement.planner]
    ours = fraction(own, counted)
    if ours.low is None or ours.high is None:
        return ()
    reached = Ruling.CONFIRMED if ours.low >= statement.reduction else Ruling.COMPATIBLE
    said = reached if ours.high >= statement.reduction else Ruling.LESS
    return (Verdict(statement, NOTHING, statement.reduction, ours, said),)


def _verdict(
    statement: Statement,
    baseline: str,
    rows: Sequence[ResultRow],
    published: Sequence[PublishedValue],
    value: Value,
) -> Verdict:
    """The ratio over problems and seeds that both solved."""
    metric = statement.published or statement.metric
    numbers = {item.planner: float(item.value) for item in published if item.metric == metric}
    paper = None
    if statement.planner in numbers and baseline in numbers:
        paper = 1.0 - numbers[statement.planner] / numbers[baseline]
    ratio = paired_ratio(
        [row for row in rows if row.planner == statement.planner],
        [row for row in rows if row.planner == baseline],
        value,
    )
    return Verdict(statement, baseline, paper, ours := less(ratio), ruling(ours, statement.reduction))


def less(ratio: Interval) -> Interval:
    """How much less of something a ratio means, as a fraction."""
    estimate, low, high = (None if x is None else 1.0 - x for x in (ratio.estimate, ratio.high, ratio.low))
    return Interval(estimate, low, high, ratio.n)


def ruling(ours: Interval, stated: float) -> Ruling:
    """What is said of a stated reduction (a fraction) by a measured one."""
    if ours.estimate is None or ours.low is None or ours.high is None:
        return Ruling.UNJUDGED
    if ours.low > 0.0 and ours.low >= stated:
        return Ruling.CONFIRMED
    if stated > 0.0 and ours.high >= stated:
        return Ruling.COMPATIBLE
    if ours.low > 0.0:
        return Ruling.LESS
    return Ruling.MORE if ours.high < 0.0 else Ruling.UNCLEAR
