"""Render the runs of the multi-sequence task in the layout of the paper's Table II. Plans nothing."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from cvqmpt_lab.results.statistics import UNDEFINED
from cvqmpt_lab.results.store import ResultRow
from paper_tables.cells import aligned, bounds, exact, latex, number
from paper_tables.phases_summary import (
    PHASE_COLUMNS,
    TIMES,
    PhasesTable,
    PlannerTimes,
    build_phases_table,
)
from paper_tables.place_task_summary import read_published

MULTI_SEQUENCE = "multi-sequence"  # the suite
ENVIRONMENT = "Multi-sequence task"
PARTS: Mapping[str, str] = {
    "paper": "the three phases that the paper times (reach the handle, reach the can, carry)",
    "all": "all planned phases",
}
NOTES = (
    "Ours: estimate [95 % interval]; round brackets mark the whole range: too few runs for 95 %.",
    "A task counts as solved when every phase has a certified path that could be timed; Wilson interval.",
    "Planning: wall time of goals, networks, search and simplification, attempts that were taken back included. "
    "Mean over solved tasks (bootstrap interval), because the paper gives means; median with failures as infinite.",
    "Execution: duration of the fastest motion within a tenth of the joints' velocity and acceleration limits, at rest "
    "between phases. The paper's is the wall clock of a simulated controller following waypoints: only ratios compare.",
    "The paper replays a stored motion to open the door; here it is planned, as is the straight way to the can. "
    "Both are outside the first table's times and inside the second's.",
    "The final pose of the can is drawn for every task; in the published code a side effect makes it the same in all.",
)


def render_multi_sequence(rows: list[ResultRow], header: str, published: Path) -> dict[str, str]:
    """Texts of ``multi_sequence.md``, ``.tex`` and ``.csv`` by file name."""
    table = build_phases_table(rows, read_published(published / "multi_sequence.csv", ENVIRONMENT))
    return {
        "multi_sequence.md": render_markdown(table, header),
        "multi_sequence.tex": f"% {header}\n{render_latex(table)}",
        "multi_sequence.csv": render_csv(table),
    }


def render_markdown(table: PhasesTable, header: str) -> str:
    """Table II for both sets of phases, statements, the breakdown by phase, failures and notes."""
    sections = [f"# Multi-sequence task: the paper's numbers and ours\n\n{header}\n"]
    for part, title in PARTS.items():
        sections.append(f"## {table.n_tasks} tasks, {title}\n\n{aligned(_time_lines(table, part))}")
    sections.append("## What the paper says\n\n" + aligned(_statement_lines(table)))
    sections.append(
        "## By phase (medians over the runs that reached it)\n\n" + aligned(_phase_lines(table, True))
    )
    sections.append("## Other planners in a phase\n\n" + _instead(table))
    sections.append("## Failures\n\n" + _failures(table))
    notes = [
        *NOTES,
        *dict.fromkeys(value.note for planner in table.planners for value in planner.published.values()),
    ]
    sections.append("## Notes\n\n" + "".join(f"- {note}\n" for note in notes if note))
    return "\n".join(sections)


def _name(planner: PlannerTimes) -> str:
    return f"{planner.name} ({planner.paper_name})" if planner.paper_name else planner.name


def _time_lines(table: PhasesTable, part: str) -> list[list[str]]:
    header = ["planner", "tasks run", "solved [%]"]
    for label, _ in TIMES.values():
        header += (
            [f"{label} [s]: paper", "ours, mean", "median"]
            if part == "paper"
            else [f"{label} [s]: mean", "median"]
        )
    lines = [header]
    for planner in table.planners:
        if part == "all" and not planner.n_runs:
            continue
        success = planner.success.scaled(100.0)
        line = [_name(planner), str(planner.n_runs), f"{number(success.estimate)} {bounds(success)}".strip()]
        for metric in TIMES:
            paper = planner.published.get(metric)
            line += [paper.printed if paper else "–"] if part == "paper" else []
            for interval in (planner.means[part, metric], planner.medians[part, metric]):
                line.append(f"{number(interval.estimate)} {bounds(interval)}".strip())
        lines.append(line)
    return lines


def _statement_lines(table: PhasesTable) -> list[list[str]]:
    lines = [["statement", "against", "paper's numbers [%]", "ours [%]", "n", "verdict"]]
    for item in table.verdicts:
        paper = "–" if item.paper is None else f"{100.0 * item.paper:.1f}"
        ours = item.ours.scaled(100.0)
        lines.append(
            [
                f"{item.statement.planner} {item.statement.text}",
                item.baseline,
                paper,
                f"{number(ours.estimate)} {bounds(ours)}".strip(),
                str(ours.n),
                item.verdict,
            ]
        )
    return lines


def _phase_lines(table: PhasesTable, with_bounds: bool) -> list[list[str]]:
    lines = [["phase", "planner", "n", *(label for label, _ in PHASE_COLUMNS.values())]]
    for phase in table.phases:
        for planner in table.planners:
            columns = planner.phases[phase]
            if not columns["success"].n:
                continue
            cells = []
            for name in PHASE_COLUMNS:
                interval = columns.get(name, UNDEFINED)
                wide = with_bounds and name in ("planning", "execution")
                cells.append(f"{number(interval.estimate)} {bounds(interval) if wide else ''}".strip())
            lines.append([phase, planner.name, str(columns["success"].n), *cells])
    return lines


def _instead(table: PhasesTable) -> str:
    lines = [["planner", "phase", "samples"]]
    lines += [[planner.name, phase, text] for planner in table.planners for phase, text in planner.instead]
    return aligned(lines) if len(lines) > 1 else "None.\n"


def _failures(table: PhasesTable) -> str:
    lines = [["planner", "reason", "tasks"]]
    lines += [
        [planner.name, reason, f"{count} of {planner.n_runs}"]
        for planner in table.planners
        for reason, count in planner.failures
    ]
    return aligned(lines) if len(lines) > 1 else "None.\n"


def render_latex(table: PhasesTable) -> str:
    """The paper's layout: planners as columns; each time: the paper's value, then our mean with interval."""
    planners = table.planners
    lines = [
        ["", "", *(planner.paper_name or planner.name for planner in planners)],
        ["Solved (%)", "ours", *(number(planner.success.scaled(100.0).estimate) for planner in planners)],
    ]
    for metric, (label, _) in TIMES.items():
        papers = [planner.published.get(metric) for planner in planners]
        means = [planner.means["paper", metric] for planner in planners]
        lines.append([f"{label} (s)", "paper", *(value.printed if value else "–" for value in papers)])
        lines.append(["", "ours", *(number(mean.estimate) for mean in means)])
        lines.append(["", "", *(bounds(mean) for mean in means)])
    body = [" & ".join(map(latex, line)) + r" \\" for line in lines]
    caption = f"Multi-sequence task, {table.n_tasks} tasks, {PARTS['paper']}. {NOTES[2]} {NOTES[3]}"
    return "\n".join(
        [
            r"\begin{table*}[t]",
            r"  \centering\scriptsize\setlength{\tabcolsep}{3pt}",
            rf"  \caption{{{latex(caption)}}}",
            r"  \label{tab:multi-sequence}",
            rf"  \begin{{tabular}}{{ll{'c' * len(planners)}}}",
            r"    \toprule",
            f"    {body[0]}",
            r"    \midrule",
            *(f"    {line}" for line in body[1:]),
            r"    \bottomrule",
            r"  \end{tabular}",
            r"\end{table*}",
            "",
        ]
    )


def render_csv(table: PhasesTable) -> str:
    """Long form, full precision; undefined is empty, failures make ``inf``."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(("planner", "phases", "metric", "statistic", "source", "value", "low", "high", "n"))
    for planner in table.planners:
        for metric in TIMES:
            value = planner.published.get(metric)
            if value:
                writer.writerow([planner.name, "paper", metric, "mean", "paper", value.printed, "", "", ""])
        entries = [((part, metric, "mean"), interval) for (part, metric), interval in planner.means.items()]
        entries += [
            ((part, metric, "median"), interval) for (part, metric), interval in planner.medians.items()
        ]
        entries.append((("all", "solved", "rate"), planner.success))
        entries += [
            ((phase, column, "rate" if column == "success" else "median"), interval)
            for phase, columns in planner.phases.items()
            for column, interval in columns.items()
        ]
        for key, interval in entries:
            numbers = [exact(x) for x in (interval.estimate, interval.low, interval.high)]
            writer.writerow([planner.name, *key, "ours", *numbers, interval.n])
    return buffer.getvalue()
