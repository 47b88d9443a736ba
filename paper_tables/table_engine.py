"""Tables of suites beside the paper's numbers: Markdown, LaTeX, csv and lines for a terminal."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import Literal

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.files import csv_table
from cvqmpt_lab.benchmarks.results.row import FailReason, ResultRow, sorted_rows, split_problem
from cvqmpt_lab.benchmarks.results.statistics import Interval, jointly_solved
from cvqmpt_lab.paper_tables import writers
from cvqmpt_lab.paper_tables.measures import (
    REFERENCE,
    Measure,
    Rows,
    SuiteRuns,
    grouped,
    split_by_work,
)
from cvqmpt_lab.paper_tables.statements import PublishedValue
from cvqmpt_lab.paper_tables.writers import (
    Lines,
    Ratio,
    Sections,
    bold,
    bounds,
    estimate,
    latex_table,
    number,
    side_by_side,
    text_lines,
)


@dataclass(frozen=True)
class Column:
    """A column of a table: a statistic of a planner's rows."""

    label: str
    unit: str
    measure: Measure
    published: str | None = None  # name of the same metric in the paper, which gives means
    cell: Callable[[Interval], str] = estimate
    best: Literal["least", "most", "none"] = "least"  # which value is the best one of a table


@dataclass(frozen=True)
class Entry:
    """Measures of one planner on all runs of a suite or on a group of them."""

    planner: str
    rows: Rows
    columns: Mapping[str, Column]
    measured: Mapping[str, Interval]  # by name of the column
    published: Mapping[str, PublishedValue]  # the paper's numbers, by its metric
    group: tuple[str, ...]  # cells that name the group
    suffix: str  # suffix of the names of its metrics in csv

    @property
    def paper_name(self) -> str | None:
        """Name in the paper."""
        return next((value.paper_name for value in self.published.values()), None)

    @property
    def title(self) -> str:
        """Name here and in the paper."""
        return f"{self.planner} ({self.paper_name})" if self.paper_name else self.planner

    @property
    def n_runs(self) -> int:
        """Problems or whole tasks, each with every random seed."""
        return _n_runs(self.rows)

    @property
    def n_problems(self) -> int:
        """Problems, or phases of tasks."""
        return len({row.problem for row in self.rows})

    def cell(self, column: str) -> str:
        """Our number as its column shows it."""
        return self.columns[column].cell(self.measured[column])

    def paper_cell(self, metric: str) -> str:
        """The paper's number."""
        return self.published[metric].value if metric in self.published else "–"


@dataclass(frozen=True)
class SuiteTable:
    """The table of the rows of one suite in all its forms."""

    suite: str
    size: str  # size of the suite, e.g. "20 problems"
    found: Sequence[Entry]  # in the order of the csv
    sections: Sections
    latex: Callable[[str, str], str]  # text of LaTeX from a caption and a label

    @property
    def brief(self) -> list[str]:
        """Lines for a terminal: the first section, and what ∞ and fallbacks mean, if any."""
        first = [line for line in next(iter(self.sections.values())) if not isinstance(line, str)]
        lines = [line for part in writers.narrow(first) for line in text_lines(part)]
        told = [
            f"{item.planner} {count} of {item.n_runs}"
            for item in self.found
            if not item.suffix  # all rows of a planner
            and (count := _n_runs(row for row in item.rows if row.fallback))
        ]
        if any("∞" in line for line in lines):
            lines.append("∞: a failed run counts as infinite; too many failed for a finite value")
        if told:
            lines.append(f"paths found by another method than the planner: {', '.join(told)}")
        return lines

    @property
    def markdown(self) -> str:
        """All sections."""
        return writers.markdown(self.sections)

    @property
    def csv(self) -> str:
        """Long form, full precision; undefined is empty, failures make ``inf``."""
        header = ("suite", "metric", "unit", "planner", "source", "value", "low", "high", "n")
        lines: list[Sequence[object]] = [header]
        for item in self.found:
            for name, column in item.columns.items():
                paper = item.published.get(column.published or "")
                if paper:
                    cells = (item.planner, "paper", paper.value, "", "", "")
                    lines.append((self.suite, name, paper.unit, *cells))
            for name, ours in item.measured.items():
                unit, numbers = item.columns[name].unit, (ours.estimate, ours.low, ours.high)
                metric = name + item.suffix
                lines.append((self.suite, metric, unit, item.planner, "ours", *numbers, ours.n))
        return csv_table(lines)


# ---------------------------------------------------------------- from rows to numbers


def rows_of_one_suite(rows: Iterable[ResultRow]) -> list[ResultRow]:
    """Return rows in order; InvalidInputError unless they are of exactly one suite."""
    ordered = sorted_rows(rows)
    suites = sorted({row.suite for row in ordered})
    if len(suites) != 1:
        raise InvalidInputError(f"a table needs the rows of one suite, got {len(suites)}: {suites}")
    return ordered


def by_planner(rows: Rows, published: Iterable[PublishedValue]) -> dict[str, list[ResultRow]]:
    """Return rows by planner (and backend if there are several), the paper's planners first."""
    groups = grouped([((row.planner, row.backend), row) for row in rows])
    planners, paper = [planner for planner, _ in groups], [value.planner for value in published]
    places = {planner: paper.index(planner) for planner in {*planners} & {*paper}}
    named = {}
    for planner, backend in sorted(groups, key=lambda key: (places.get(key[0], len(paper)), key)):
        name = f"{planner} [{backend}]" if planners.count(planner) > 1 else planner
        named[name] = groups[planner, backend]
    return named


def suite_runs(rows: Iterable[ResultRow], published: Iterable[PublishedValue] = ()) -> SuiteRuns:
    """Return grouped rows; InvalidInputError unless they are of exactly one suite.

    Problems that could not be made are left out.
    """
    ordered = rows_of_one_suite(rows)
    unmade = {row.problem: row.detail or "" for row in ordered if not row.made}
    ordered = [row for row in ordered if row.made] or ordered
    groups = by_planner(ordered, published)
    solving = sorted(name for name, own in groups.items() if any(row.solved for row in own))
    joint = frozenset(jointly_solved({name: groups[name] for name in solving}))
    reference: Rows = next((own for own in groups.values() if own[0].planner == REFERENCE), [])
    return SuiteRuns(ordered, groups, solving, joint, split_by_work(reference), unmade)


def entry(
    name: str,
    rows: Rows,
    runs: SuiteRuns,
    columns: Mapping[str, Column],
    published: Iterable[PublishedValue] = (),
    group: tuple[str, ...] = (),
    suffix: str = "",
) -> Entry:
    """Measure a planner on some of its rows.

    Args:
        name: name of the planner, with its backend in brackets if there are several.
        rows: rows of the planner that are measured.
        runs: all rows of the suite.
        columns: columns of the table, by name.
        published: the paper's numbers.
        group: cells that name the group of the rows.
        suffix: suffix of the metrics in csv.
    """
    owner = name.partition(" [")[0]  # without its backend
    return Entry(
        planner=name,
        rows=rows,
        columns=columns,
        measured={column: definition.measure(rows, runs) for column, definition in columns.items()},
        published={value.metric: value for value in published if value.planner == owner},
        group=group,
        suffix=suffix,
    )


def entries(
    runs: SuiteRuns, columns: Mapping[str, Column], published: Sequence[PublishedValue] = ()
) -> list[Entry]:
    """Return an entry for every planner with all its rows."""
    return [entry(name, rows, runs, columns, published) for name, rows in runs.groups.items()]


def _n_runs(rows: Iterable[ResultRow]) -> int:
    return len({(row.item, row.seed) for row in rows})


def published_notes(runs: SuiteRuns, published: Iterable[PublishedValue]) -> list[str]:
    """Return notes on the paper's numbers of planners that ran, with metric and planners."""
    ran = {row.planner for row in runs.rows}
    noted = [value for value in published if value.note and value.planner in ran]
    owners = grouped([((value.metric, value.note), value.paper_name) for value in noted])
    return [f"{metric} ({', '.join(names)}): {note}" for (metric, note), names in owners.items()]


def goalless(rows: Rows) -> list[str]:
    """Return the names of problems that have no goal, so that every planner fails on them."""
    reasons = grouped((row.problem, row.fail_reason) for row in rows)
    return [name for name, found in reasons.items() if set(found) == {FailReason.NO_GOAL}]


def goalless_text(rows: Rows) -> str:
    """Return how many problems have no goal, such as "2 of 20 problems have no goal", or ""."""
    count, every = len(goalless(rows)), len({row.problem for row in rows})
    have = "has" if count == 1 else "have"
    return f"{count} of {every} problems {have} no goal" if count else ""


def run_notes(runs: SuiteRuns) -> Iterable[str]:
    """Yield notes on problems left out or without a goal, on seeds, and on planners with fewer."""
    if text := goalless_text(runs.rows):
        names = ", ".join(goalless(runs.rows)[:5])
        yield f"{text}, such as {names}: every planner fails on them, and this counts."
    if runs.unmade:
        name, why = next(iter(runs.unmade.items()))
        yield (
            f"Left out: {len(runs.unmade)} problems that could not be made, such as {name} ({why})."
        )
    seeds = {name: len({row.seed for row in rows}) for name, rows in runs.groups.items()}
    most = max(seeds.values())
    if most > 1:
        yield (
            "There are several seeds: each problem counts once in every number and interval, with "
            "its median, mean or fraction over seeds; ratios pair runs by problem and seed."
        )
    fewer = [f"{name} {count}" for name, count in seeds.items() if count < most]
    if fewer:
        yield f"Planners with fewer than {most} seeds: {', '.join(fewer)}."
    again = {name: repeated(rows) for name, rows in runs.groups.items()}
    if texts := [f"{name} {count}" for name, count in again.items() if count]:
        yield (
            f"Rows with the same path as an earlier row of the planner: {', '.join(texts)}. They "
            "are counted like the others, but are not independent of them."
        )


def repeated(rows: Rows) -> int:
    """Return how many rows of a planner have the same path, bit for bit, as an earlier row."""
    paths = [row.path_sha256 for row in rows if row.path_sha256]
    return len(paths) - len(set(paths))


# ---------------------------------------------------------------- from numbers to lines


def cells_of(
    found: Sequence[Entry], name: str, cell: Callable[[Interval], str] | None = None
) -> list[str]:
    """Return the cells of a column, with the best value bold if less than half have it.

    A planner that did not run all problems cannot be the best one. A ratio to a planner is the
    best one only if it is better than that planner, below 1.

    Args:
        found: entries of planners that are compared.
        name: name of the column.
        cell: how a cell is written; None: as its column says.
    """
    column = found[0].columns[name]
    cells = [(cell or column.cell)(item.measured[name]) for item in found]
    numbers = [item.measured[name].estimate for item in found]
    known = [x for x in numbers if x is not None and math.isfinite(x)]
    most = max(item.n_problems for item in found)
    whole = [item.n_problems == most for item in found]
    compared = [
        x
        for x, every in zip(numbers, whole, strict=True)
        if every and x is not None and math.isfinite(x)
    ]
    if not compared or column.best == "none":
        return cells
    best = min(compared) if column.best == "least" else max(compared)
    values = [text.partition(" ")[0] for text in cells]
    shown = values[numbers.index(best)]
    if 2 * values.count(shown) > len(known) or (isinstance(column.label, Ratio) and best >= 1.0):
        return cells
    return [
        bold(text) if value == shown and every else text
        for text, value, every in zip(cells, values, whole, strict=True)
    ]


def column_lines(found: Sequence[Entry], names: Iterable[str]) -> Lines:
    """Return a line for each planner with some of its columns."""
    names = list(names)
    labels = [found[0].columns[name].label for name in names]
    planners = [item.planner for item in found]
    columns = [cells_of(found, name) for name in names]
    return [["planner", *labels], *map(list, zip(planners, *columns, strict=True))]


def group_lines(found: Sequence[Entry], head: Sequence[str], count: str = "problems") -> Lines:
    """Return a line for each group and planner that has runs.

    Args:
        found: entries of the table.
        head: titles of the cells that name the group.
        count: title of the number of problems.
    """
    lines = [[*head, "planner", count, *(column.label for column in found[0].columns.values())]]
    for group, members in groupby((item for item in found if item.rows), attrgetter("group")):
        same = list(members)
        columns = zip(*(cells_of(same, name) for name in same[0].columns), strict=True)
        for item, cells in zip(same, columns, strict=True):
            lines.append([*group, item.planner, str(item.n_problems), *cells])
    return lines


def counted(found: Sequence[Entry]) -> Sections:
    """Return the sections of fallbacks and failures."""
    return {"Fallbacks": count_lines(found, fallback), "Failures": count_lines(found, failure)}


def fallback(row: ResultRow) -> tuple[str, str] | None:
    """Return phase and reason of a run whose path another method found; None for others."""
    return (_phase(row), row.fallback) if row.fallback else None


def failure(row: ResultRow) -> tuple[str, str] | None:
    """Return phase and reason, and details of a failed run; None for phases not reached."""
    reason = row.fail_reason
    if reason is None or reason is FailReason.NOT_REACHED:
        return None
    what = ": ".join(filter(None, (_phase(row), reason.shown)))
    return what, row.detail or "–"


def _phase(row: ResultRow) -> str:
    return split_problem(row.problem).phase if "/" in row.problem else ""


def count_lines(
    found: Iterable[Entry], message_of: Callable[[ResultRow], tuple[str, str] | None]
) -> Lines:
    """Return messages of all planners, the most frequent first, with one example each.

    message_of: message and detail of a row; None: the row is not counted.
    """
    lines = [["planner", "reason", "example", "runs"]]
    for item in found:
        examples = grouped([pair for row in item.rows if (pair := message_of(row))])
        for what, same in sorted(examples.items(), key=lambda x: (-len(x[1]), x[0])):
            runs = f"{len(same)} of {item.n_runs}"
            lines.append([item.planner, what or "–", same[0], runs])
    return lines


def latex_planners(
    caption: str, label: str, found: Sequence[Entry], metrics: Mapping[str, Mapping[str, str]]
) -> str:
    """Return LaTeX in the paper's layout, with planners as columns.

    Args:
        caption: caption of the table.
        label: label of the table.
        found: entries of the planners.
        metrics: the paper's metrics, each with our columns by title.
    """
    parts, labels = [], max(len(metric) for metric in metrics) + 20
    for shown in side_by_side(labels, [max(14, len(item.planner)) for item in found]):
        names = [["", "", *(found[k].paper_name or found[k].planner for k in shown)]]
        if any(found[k].paper_name for k in shown):
            own = (found[k].planner if found[k].paper_name else "" for k in shown)
            names.append(["", "", *own])
        parts.append([names, *(_latex_block(found, shown, *item) for item in metrics.items())])
    return latex_table(caption, label, parts)


def _latex_block(
    found: Sequence[Entry], shown: Sequence[int], published: str, ours: Mapping[str, str]
) -> Lines:
    """Return lines of a metric: the paper's, then estimate and interval of each of our columns.

    Args:
        found: entries of all planners, of which the best is bold.
        shown: places of those in this table.
        published: the paper's metric.
        ours: our columns by title.
    """
    column = found[0].columns[next(iter(ours.values()))]
    with_unit = column.unit == "1" or f"[{column.unit}]" in column.label
    lines = [["paper", *(found[k].paper_cell(published) for k in shown)]]
    if all(cell == "–" for cell in lines[0][1:]):
        lines = []
    for title, name in ours.items():
        estimates = cells_of(found, name, lambda interval: number(interval.estimate))
        lines.append([title, *(estimates[k] for k in shown)])
        lines.append(["", *(bounds(found[k].measured[name]) for k in shown)])
    label = column.label if with_unit else f"{column.label} ({column.unit})"
    return [[label if k == 0 else "", *line] for k, line in enumerate(lines)]


def latex_groups(caption: str, label: str, lines: Lines) -> str:
    """Return LaTeX of `group_lines` with a rule between groups."""
    parts, widths = [], [max(map(len, column)) for column in zip(*lines, strict=True)]
    for shown in side_by_side(sum(widths[:2]), widths[2:]):
        header, *rest = ([*line[:2], *(line[2 + k] for k in shown)] for line in lines)
        parts.append([[header], *(list(part) for _, part in groupby(rest, itemgetter(0)))])
    return latex_table(caption, label, parts)
