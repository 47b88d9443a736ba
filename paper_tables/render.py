"""Render the runs of a results directory in the paper's layout: markdown, LaTeX and csv. Plans nothing."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.results.provenance import ProvenanceFile, write_text_atomic
from cvqmpt_lab.results.statistics import UNDEFINED
from cvqmpt_lab.results.store import PARTIAL_FILE, RUNS_FILE, ResultRow, read_rows
from paper_tables.cells import aligned, bounds, exact, latex, number
from paper_tables.comparison import RATIOS, REFERENCE, split_metric
from paper_tables.multi_sequence import MULTI_SEQUENCE, render_multi_sequence
from paper_tables.place_task_summary import (
    EFFORT,
    HEADLINES,
    METHOD_NOTES,
    PAPER_COST,
    Headline,
    PlannerSummary,
    Table,
    build_place_table,
    curve_metric,
    read_published,
)

PUBLISHED = Path(__file__).resolve().parent / "published"
CSV_COLUMNS = ("suite", "metric", "unit", "planner", "source", "value", "low", "high", "n")


def render_directory(directory: Path) -> list[Path]:
    """Write ``place_task.md``, ``.tex`` and ``.csv`` beside ``runs.csv``, one block per suite.

    Rows of the multi-sequence task become ``multi_sequence.md`` and so on instead.
    The paper's numbers stand beside the suites whose name contains "place"; it has none for others.

    Raises
    ------
    RunStoreError
        When the directory holds no readable runs with provenance, or cannot be written.
    """
    directory = Path(directory)
    rows = _rows(directory)
    record = ProvenanceFile(directory).read()
    header = _header(record, len(rows))
    if {row.suite for row in rows} == {MULTI_SEQUENCE}:
        return _written(directory, render_multi_sequence(rows, header, PUBLISHED))
    paper = read_published(PUBLISHED / "place_task.csv", "Place Task")
    tables = [
        build_place_table([row for row in rows if row.suite == suite], paper if "place" in suite else ())
        for suite in sorted({row.suite for row in rows})
    ]
    title = "# Place task: the paper's numbers and ours"
    texts = {
        "place_task.md": "\n".join([f"{title}\n\n{header}\n", *map(render_markdown, tables)]),
        "place_task.tex": "\n".join([f"% {header}", *map(render_latex, tables)]),
        "place_task.csv": "".join(render_csv(table, header=i == 0) for i, table in enumerate(tables)),
    }
    return _written(directory, texts)


def _written(directory: Path, texts: Mapping[str, str]) -> list[Path]:
    for name, text in texts.items():
        write_text_atomic(directory / name, text)
    return [directory / name for name in texts]


def _rows(directory: Path) -> list[ResultRow]:
    cure = f"run an experiment with --out {directory} first"
    if not directory.is_dir():
        raise RunStoreError(f"{directory} is not a directory; {cure}")
    if not (directory / RUNS_FILE).is_file():
        if (directory / PARTIAL_FILE).is_file():
            raise RunStoreError(f"{directory} holds an interrupted run; repeat its command to continue it")
        raise RunStoreError(f"{directory} has no {RUNS_FILE}; {cure}")
    rows = read_rows(directory / RUNS_FILE)
    if not rows:
        raise RunStoreError(f"{directory / RUNS_FILE} has no rows; {cure}")
    return rows


def _header(record: Mapping[str, Any], n_runs: int) -> str:
    """One line: settings that name a cut-off, commits, machines, dates and the number of runs."""
    configuration = record["configuration"]
    sessions = [record, *record.get("continued", [])]
    cutoffs = [f"{name} {configuration[name]}" for name in sorted(configuration) if "cutoff" in name]
    commits = _distinct(_commit(session) for session in sessions)
    machines = _distinct(
        f"{session.get('cpu_model') or 'unknown'}, {session.get('cpu_count') or '?'} cores"
        for session in sessions
    )
    dates = _distinct(str(session.get("date_utc") or "unknown") for session in sessions)
    return " · ".join(
        [
            ", ".join(cutoffs) or "cutoff not recorded",
            f"commit {' and '.join(commits)}",
            f"machine {' and '.join(machines)}",
            f"date {' and '.join(dates)}",
            f"{n_runs} runs",
        ]
    )


def _commit(session: Mapping[str, Any]) -> str:
    commit = session.get("git_commit")
    if not commit:
        return "unknown"
    return commit[:12] + (" (modified)" if session.get("git_dirty") else "")


def _distinct(texts: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(texts))


def _cell(summary: PlannerSummary, metric: str) -> str:
    interval = summary.measured.get(metric, UNDEFINED)
    return f"{number(interval.estimate)} {bounds(interval)}".strip()


def _printed(summary: PlannerSummary, metric: str) -> str:
    value = summary.published.get(metric)
    return value.printed if value else "–"


def render_markdown(table: Table) -> str:
    """Planners as rows, metrics as columns, paper | ours; then effort, comparisons, time curve, failures and notes."""
    sections = [
        f"## {table.suite}: {table.n_problems} problems\n\n" + aligned(_headline_lines(table)),
        "### Effort (medians)\n\n"
        + aligned(_plain_lines(table, {name: label for name, (label, _) in EFFORT.items()})),
        "### At the paper's cost of work\n\n"
        + aligned(_plain_lines(table, {name: label for name, (label, _) in PAPER_COST.items()})),
        *([f"### Against {REFERENCE}\n\n" + aligned(_split_lines(table))] if table.n_easy else []),
        "### Solved within a time, % of runs\n\n"
        + aligned(_plain_lines(table, {curve_metric(time): f"{time:g} s" for time in table.curve_times})),
        "### Failures\n\n" + _failures(table),
        "### Notes\n\n" + _bullets(METHOD_NOTES + table.footnotes),
    ]
    if table.published_notes:
        title = "### Notes on the paper's numbers (all but accuracy are means)"
        sections.append(f"{title}\n\n{_bullets(table.published_notes)}")
    return "\n".join(sections)


def _bullets(notes: Iterable[str]) -> str:
    return "".join(f"- {note}\n" for note in notes)


def _headline_lines(table: Table) -> list[list[str]]:
    header = ["planner", "runs"]
    for headline in HEADLINES:
        unit = "" if headline.unit == "1" else f" [{headline.unit}]"
        n_joint = f" (n={table.n_joint})" if headline.published == "path_length" else ""
        header += [f"{headline.label}{unit}: paper", f"ours{n_joint}"]
    lines = [header]
    for summary in table.planners:
        name = f"{summary.name} ({summary.paper_name})" if summary.paper_name else summary.name
        first, second = [name, str(summary.n_runs)], ["– mean", ""]
        for headline in HEADLINES:
            first += [_printed(summary, headline.published), _cell(summary, headline.typical)]
            second += ["", _cell(summary, headline.mean) if headline.mean else ""]
        lines += [first, second] if summary.n_runs else [first]
    return lines


def _plain_lines(table: Table, metrics: Mapping[str, str]) -> list[list[str]]:
    lines = [["planner", *metrics.values()]]
    lines += [[s.name, *(_cell(s, metric) for metric in metrics)] for s in table.planners if s.n_runs]
    return lines


def _split_lines(table: Table) -> list[list[str]]:
    """Ratios on all, easy and hard problems, for every planner but the one they are against."""
    lines = [["planner", "problems", *(label for label, _ in RATIOS.values())]]
    sizes = {"all": table.n_easy + table.n_hard, "easy": table.n_easy, "hard": table.n_hard}
    for summary in table.planners:
        if summary.n_runs and summary.name != REFERENCE:
            lines += [
                [
                    summary.name,
                    f"{part} ({size})",
                    *(_cell(summary, split_metric(name, part)) for name in RATIOS),
                ]
                for part, size in sizes.items()
            ]
    return lines


def _failures(table: Table) -> str:
    lines = [["planner", "status", "reason", "runs"]]
    lines += [
        [summary.name, status, reason or "–", f"{count} of {summary.n_runs}"]
        for summary in table.planners
        for status, reason, count in summary.failures
    ]
    return aligned(lines) if len(lines) > 1 else "None.\n"


def render_latex(table: Table) -> str:
    """The paper's layout (planners as columns, booktabs), each metric: the paper's value, then ours."""
    planners = table.planners
    lines = [
        ["", "", *(summary.paper_name or summary.name for summary in planners)],
        ["", "", *(summary.name if summary.paper_name else "" for summary in planners)],
    ]
    body = [" & ".join(map(latex, line)) + r" \\" for line in lines]
    for headline in HEADLINES:
        body += [r"\midrule", *_latex_block(headline, planners)]
    caption = f"{table.suite}, {table.n_problems} problems: the paper's values and ours. "
    caption += " ".join((*METHOD_NOTES[:4], *table.footnotes))
    return "\n".join(
        [
            r"\begin{table*}[t]",
            r"  \centering\scriptsize\setlength{\tabcolsep}{3pt}",
            rf"  \caption{{{latex(caption)}}}",
            rf"  \label{{tab:{''.join(c if c.isalnum() else '-' for c in table.suite)}}}",
            rf"  \begin{{tabular}}{{ll{'c' * len(planners)}}}",
            r"    \toprule",
            *(f"    {line}" for line in body),
            r"    \bottomrule",
            r"  \end{tabular}",
            r"\end{table*}",
            "",
        ]
    )


def _latex_block(headline: Headline, planners: Sequence[PlannerSummary]) -> list[str]:
    """One metric: the paper's line, then an estimate and an interval line for each of our statistics."""
    label = headline.label if headline.unit == "1" else f"{headline.label} ({headline.unit})"
    lines = [[label, "paper", *(_printed(summary, headline.published) for summary in planners)]]
    statistics: list[tuple[str, str | None]] = [
        ("ours" if headline.mean is None else "ours, median", headline.typical),
        ("ours, mean", headline.mean),
    ]
    for name, metric in statistics:
        if metric:
            intervals = [summary.measured.get(metric, UNDEFINED) for summary in planners]
            lines.append(["", name, *(number(interval.estimate) for interval in intervals)])
            lines.append(["", "", *(bounds(interval) for interval in intervals)])
    return [" & ".join(map(latex, line)) + r" \\" for line in lines]


def render_csv(table: Table, header: bool = True) -> str:
    """Long form (`CSV_COLUMNS`), full precision; undefined is empty, failures make ``inf``.

    The paper's values are means and carry the names of our means.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    if header:
        writer.writerow(CSV_COLUMNS)
    units = {headline.typical: headline.unit for headline in HEADLINES}
    units |= {headline.mean: headline.unit for headline in HEADLINES if headline.mean}
    units |= {metric: unit for metric, (_, unit) in (EFFORT | PAPER_COST).items()}
    units |= {split_metric(metric, part): "1" for metric in RATIOS for part in ("all", "easy", "hard")}
    for summary in table.planners:
        for headline in HEADLINES:
            value, metric = summary.published.get(headline.published), headline.mean or headline.typical
            if value:
                paper = [summary.name, "paper", value.printed, "", "", ""]
                writer.writerow([table.suite, metric, value.unit, *paper])
        for metric, interval in summary.measured.items():
            numbers = [exact(x) for x in (interval.estimate, interval.low, interval.high)]
            unit = units.get(metric, "%")
            writer.writerow([table.suite, metric, unit, summary.name, "ours", *numbers, interval.n])
    return buffer.getvalue()
