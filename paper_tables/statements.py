"""Sentences of the paper about its numbers, judged by its own table and by ours."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import Interval
from paper_tables.cells import Lines, estimate
from paper_tables.comparison import Value, paired_ratio
from paper_tables.paper_numbers import PublishedValue


@dataclass(frozen=True)
class Statement:
    """A sentence of the paper: `planner` needs `reduction` (a fraction; 0: any) less of `metric` than `baseline`."""

    text: str
    metric: str
    reduction: float
    planner: str = "opt-cvq-mpt"
    baselines: tuple[str, ...] = ("ompl-projected", "atlas-rrt", "tb-rrt")


@dataclass(frozen=True)
class Verdict:
    """A statement against one baseline."""

    statement: Statement
    baseline: str
    paper: float | None
    """What the paper's own numbers say, as a fraction."""
    ours: Interval
    """What ours say."""
    verdict: str
    """In words."""


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
        lines.append([text, item.baseline, paper, estimate(ours), str(ours.n), item.verdict])
    return lines


def _verdict(
    statement: Statement,
    baseline: str,
    rows: Sequence[ResultRow],
    published: Sequence[PublishedValue],
    value: Value,
) -> Verdict:
    """The ratio over problems and seeds that both solved."""
    numbers = {item.planner: float(item.value) for item in published if item.metric == statement.metric}
    paper = None
    if statement.planner in numbers and baseline in numbers:
        paper = 1.0 - numbers[statement.planner] / numbers[baseline]
    ratio = paired_ratio(
        [row for row in rows if row.planner == statement.planner],
        [row for row in rows if row.planner == baseline],
        value,
    )
    ours = Interval(_less(ratio.estimate), _less(ratio.high), _less(ratio.low), ratio.n)
    return Verdict(statement, baseline, paper, ours, _in_words(statement, ours))


def _less(ratio: float | None) -> float | None:
    return None if ratio is None else 1.0 - ratio


def _in_words(statement: Statement, ours: Interval) -> str:
    if ours.estimate is None or ours.low is None or ours.high is None:
        return "not judged: too few that both solved"
    if ours.low > 0.0 and ours.low >= statement.reduction:
        return "confirmed"
    if statement.reduction > 0.0 and ours.high >= statement.reduction:
        return "compatible: the interval contains it"
    if ours.low > 0.0:
        return "less than stated"
    return "not confirmed: more of it" if ours.high < 0.0 else "not confirmed: no clear difference"
