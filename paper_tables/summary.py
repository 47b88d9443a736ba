"""What every table says of a planner: the paper's numbers, ours, failures and fallbacks, as plain data."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.phase_name import split_problem
from cvqmpt_lab.results.row import FailReason, ResultRow, sorted_rows
from cvqmpt_lab.results.statistics import UNDEFINED, Interval, ProblemKey
from paper_tables.cells import Lines, csv_text, estimate, number, padded
from paper_tables.comparison import Split
from paper_tables.paper_numbers import PublishedValue

CSV_COLUMNS = ("suite", "metric", "unit", "planner", "source", "value", "low", "high", "n")


@dataclass(frozen=True)
class Runs:
    """The rows of one planner, and what some metrics compare them with."""

    rows: Sequence[ResultRow]
    joint: Collection[ProblemKey] = ()
    """Runs that every planner solved."""
    baselines: Mapping[str, Sequence[ResultRow]] = field(default_factory=dict)
    """Rows of the planners that ratios are against."""
    split: Split = field(default_factory=lambda: Split(frozenset(), frozenset()))


@dataclass(frozen=True)
class Metric:
    """A number of a planner."""

    label: str
    unit: str
    measure: Callable[[Runs], Interval]
    published: str | None = None
    """The paper's metric that it answers (the paper gives means)."""


@dataclass(frozen=True)
class Count:
    """How many runs had something in common, and what the first of them said."""

    what: str
    example: str
    runs: int


@dataclass(frozen=True)
class PlannerSummary:
    """One planner of a table."""

    name: str
    paper_name: str | None
    n_runs: int
    published: Mapping[str, PublishedValue]
    measured: Mapping[str, Interval]
    failures: tuple[Count, ...]
    fallbacks: tuple[Count, ...]
    n_fallen_back: int
    """Runs, tasks as a whole, with a fallback."""

    @property
    def title(self) -> str:
        """Its name, and the paper's."""
        return f"{self.name} ({self.paper_name})" if self.paper_name else self.name

    def cell(self, metric: str) -> str:
        """Our estimate with its interval."""
        return estimate(self.measured.get(metric, UNDEFINED))

    def paper_cell(self, metric: str) -> str:
        """The paper's number."""
        return self.published[metric].value if metric in self.published else "–"


@dataclass(frozen=True)
class Rendered:
    """The table of one suite in all its forms."""

    size: str
    """How much was run, as in "20 problems"."""
    markdown: str
    latex: str
    csv: str
    brief: list[str]
    """Lines of at most 100 columns for a terminal."""


def rows_of_one_suite(rows: Iterable[ResultRow]) -> list[ResultRow]:
    """Rows in order; InvalidInputError unless they are of exactly one suite."""
    ordered = sorted_rows(rows)
    suites = sorted({row.suite for row in ordered})
    if len(suites) != 1:
        raise InvalidInputError(f"a table needs the rows of one suite, got {len(suites)}: {suites}")
    return ordered


def by_planner(rows: Sequence[ResultRow], published: Iterable[PublishedValue]) -> dict[str, list[ResultRow]]:
    """Rows by planner, the paper's first and in its order; by planner and backend where one ran with several."""
    backends: dict[str, set[str]] = {}
    for row in rows:
        backends.setdefault(row.planner, set()).add(row.backend)
    paper = [planner for planner in dict.fromkeys(v.planner for v in published) if planner in backends]
    groups: dict[str, list[ResultRow]] = {}
    for planner in (*paper, *sorted(backends.keys() - set(paper))):
        for backend in sorted(backends[planner]):
            name = f"{planner} [{backend}]" if len(backends[planner]) > 1 else planner
            groups[name] = [row for row in rows if (row.planner, row.backend) == (planner, backend)]
    return groups


def summarised(
    name: str, runs: Runs, published: Iterable[PublishedValue], metrics: Mapping[str, Metric]
) -> PlannerSummary:
    """Measure a planner; each bootstrap starts from the same seed, so that metrics do not interact."""
    rows = runs.rows
    paper = {value.metric: value for value in published if value.planner == rows[0].planner}
    failed = [row for row in rows if row.fail_reason not in (None, FailReason.NOT_REACHED)]
    fallen_back = [row for row in rows if row.fallback]
    return PlannerSummary(
        name=name,
        paper_name=next((value.paper_name for value in paper.values()), None),
        n_runs=_n_runs(rows),
        published=paper,
        measured={metric: definition.measure(runs) for metric, definition in metrics.items()},
        failures=_counts((_at(row, str(row.fail_reason)), row.detail or "–") for row in failed),
        fallbacks=_counts((_at(row, ""), str(row.fallback)) for row in fallen_back),
        n_fallen_back=_n_runs(fallen_back),
    )


def _n_runs(rows: Iterable[ResultRow]) -> int:
    """Problems or whole tasks, each with every seed."""
    return len({(row.item, row.seed) for row in rows})


def _at(row: ResultRow, what: str) -> str:
    """What happened, with the phase of a task before it."""
    phase = split_problem(row.problem).phase if "/" in row.problem else ""
    return ": ".join(filter(None, (phase, what)))


def _counts(found: Iterable[tuple[str, str]]) -> tuple[Count, ...]:
    """Counts of equal texts, the most frequent first, each with the first example."""
    examples: dict[str, list[str]] = {}
    for what, example in found:
        examples.setdefault(what, []).append(example)
    counts = [Count(what, texts[0], len(texts)) for what, texts in examples.items()]
    return tuple(sorted(counts, key=lambda count: (-count.runs, count.what)))


def seed_notes(groups: Mapping[str, Sequence[ResultRow]]) -> Iterable[str]:
    """How several seeds of a problem count, if there are any, and who ran fewer."""
    seeds = {name: len({row.seed for row in group}) for name, group in groups.items()}
    most = max(seeds.values(), default=1)
    if most > 1:
        yield (
            "Several seeds: a problem counts once in every number and interval, with its median, its mean or its share "
            "over seeds; ratios pair runs by problem and seed."
        )
    fewer = [f"{name} {count}" for name, count in seeds.items() if count < most]
    if fewer:
        yield f"Seeds, where they are fewer than {most}: {', '.join(fewer)}."


def count_lines(planners: Iterable[PlannerSummary], what: str) -> Lines:
    """Failures or fallbacks of all planners; what: "failures" or "fallbacks"."""
    lines = [["planner", "what", "for example", "runs"]]
    for planner in planners:
        for count in getattr(planner, what):
            lines.append(
                [planner.name, count.what or "–", count.example, f"{count.runs} of {planner.n_runs}"]
            )
    return lines


def metric_lines(planners: Iterable[PlannerSummary], labels: Mapping[str, str]) -> Lines:
    """Planners as lines, metrics as columns."""
    return [["planner", *labels.values()], *([p.name, *map(p.cell, labels)] for p in planners)]


class BriefColumn(NamedTuple):
    """A number that a terminal shows: its title, the paper's metric, ours and which statistic, with interval or not."""

    title: str
    published: str
    ours: str
    statistic: str = "ours"
    interval: bool = False


def brief_lines(planners: Sequence[PlannerSummary], columns: Sequence[BriefColumn]) -> list[str]:
    """A line a planner for a terminal, the paper's numbers beside ours, then one about fallbacks, if any."""
    papers = [column.published in planner.published for column in columns for planner in planners]
    shown = 2 if any(papers) else 1
    lines = [[""], ["planner"]]
    for column in columns:
        lines[0] += [column.title, ""][:shown]
        lines[1] += ["paper", column.statistic][-shown:]
    for planner in planners:
        lines.append([planner.name])
        for column in columns:
            interval = planner.measured[column.ours]
            ours = estimate(interval) if column.interval else number(interval.estimate)
            lines[-1] += [planner.paper_cell(column.published), ours][-shown:]
    told = ", ".join(f"{p.name} {p.n_fallen_back} of {p.n_runs}" for p in planners if p.n_fallen_back)
    return ["  ".join(line).rstrip() for line in padded(lines)] + ([f"by fallback: {told}"] if told else [])


def csv_of(suite: str, planners: Iterable[PlannerSummary], metrics: Mapping[str, Metric]) -> str:
    """Long form (`CSV_COLUMNS`), full precision; undefined is empty, failures make ``inf``."""
    lines: list[Sequence[object]] = [CSV_COLUMNS]
    for planner in planners:
        for name, metric in metrics.items():
            value = planner.published.get(metric.published or "")
            if value:
                lines.append((suite, name, value.unit, planner.name, "paper", value.value, "", "", ""))
        for name, interval in planner.measured.items():
            numbers = (interval.estimate, interval.low, interval.high, interval.n)
            lines.append((suite, name, metrics[name].unit, planner.name, "ours", *numbers))
    return csv_text(lines)
