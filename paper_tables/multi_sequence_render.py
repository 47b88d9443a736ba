"""Render the runs of the multi-sequence task in the layout of the paper's Table II. Plans nothing."""

from collections.abc import Iterable, Mapping, Sequence

from cvqmpt_lab.results.row import ResultRow
from paper_tables.cells import Lines, bounds, latex_table, markdown_table, number
from paper_tables.multi_sequence_summary import (
    PHASE_COLUMNS,
    TIMES,
    PhasesTable,
    build_phases_table,
    metrics,
    phase_metric,
    time_metric,
)
from paper_tables.paper_numbers import PublishedValue
from paper_tables.statements import statement_lines
from paper_tables.summary import BriefColumn, PlannerSummary, Rendered, brief_lines, count_lines, csv_of

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
    "Fallbacks: phases whose path did not come the way the planner's name promises; they count as its own.",
)
_PLANNING, _EXECUTION = (time_metric(time, "paper", "mean") for time in ("planning_time", "execution_time"))
BRIEF = (
    BriefColumn("solved [%]", "accuracy", "solved"),
    BriefColumn("planning [s]", "planning_time", _PLANNING, "our mean", interval=True),
    BriefColumn("execution [s]", "execution_time", _EXECUTION, "our mean"),
)


def render_multi_sequence(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> Rendered:
    """The rows of the suite in all forms."""
    table = build_phases_table(rows, published)
    return Rendered(
        size=f"{table.n_tasks} tasks",
        markdown=render_markdown(table),
        latex=render_latex(table),
        csv=csv_of(table.suite, table.planners, metrics(table.phases)),
        brief=brief_lines(table.planners, BRIEF),
    )


def render_markdown(table: PhasesTable) -> str:
    """Table II for both sets of phases, statements, the breakdown by phase, fallbacks, failures and notes."""
    parts = {f"{table.n_tasks} tasks, {PARTS[part]}": _time_lines(table.planners, part) for part in PARTS}
    parts["What the paper says"] = statement_lines(table.verdicts)
    parts["By phase (medians over the runs that reached it)"] = _phase_lines(table)
    parts["Fallbacks"] = count_lines(table.planners, "fallbacks")
    parts["Failures"] = count_lines(table.planners, "failures")
    sections = [f"## {title}\n\n{markdown_table(lines)}" for title, lines in parts.items()]
    notes = "".join(f"- {note}\n" for note in (*NOTES, *table.footnotes, *table.published_notes))
    return "\n".join([*sections, f"## Notes\n\n{notes}"])


def _time_lines(planners: Sequence[PlannerSummary], part: str) -> Lines:
    """Solved tasks and every time; the paper's beside those of its own phases."""
    lines = [["planner", "tasks run", "solved [%]"]]
    for label, _ in TIMES.values():
        lines[0] += [f"{label} [s]: paper", "ours, mean"] if part == "paper" else [f"{label} [s]: mean"]
        lines[0].append("median")
    for planner in planners:
        line = [planner.title, str(planner.n_runs), planner.cell("solved")]
        for time in TIMES:
            line += [planner.paper_cell(time)] if part == "paper" else []
            line += [planner.cell(time_metric(time, part, statistic)) for statistic in ("mean", "median")]
        lines.append(line)
    return lines


def _phase_lines(table: PhasesTable) -> Lines:
    lines = [["phase", "planner", "n", "solved [%]", *(label for label, _ in PHASE_COLUMNS.values())]]
    for phase in table.phases:
        for planner in table.planners:
            solved = planner.measured[phase_metric("solved", phase)]
            if not solved.n:
                continue
            line = [phase, planner.name, str(solved.n), number(solved.estimate)]
            for column in PHASE_COLUMNS:
                name = phase_metric(column, phase)
                wide = column in ("planning", "execution")
                line.append(planner.cell(name) if wide else number(planner.measured[name].estimate))
            lines.append(line)
    return lines


def render_latex(table: PhasesTable) -> str:
    """The paper's layout: planners as columns; each time: the paper's value, then our mean with interval."""
    planners = table.planners
    lines = [["Solved (%)", "ours", *(number(planner.measured["solved"].estimate) for planner in planners)]]
    for time, (label, _) in TIMES.items():
        means = [planner.measured[time_metric(time, "paper", "mean")] for planner in planners]
        lines.append([f"{label} (s)", "paper", *(planner.paper_cell(time) for planner in planners)])
        lines.append(["", "ours", *(number(mean.estimate) for mean in means)])
        lines.append(["", "", *map(bounds, means)])
    caption = f"Multi-sequence task, {table.n_tasks} tasks, {PARTS['paper']}. {NOTES[2]} {NOTES[3]}"
    names = [["", "", *(planner.paper_name or planner.name for planner in planners)]]
    return latex_table(caption, table.suite, [names, lines])
