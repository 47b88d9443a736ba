"""Render the place task's table: planners as lines, the paper's numbers beside ours. Plans nothing."""

from collections.abc import Iterable, Sequence

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import UNDEFINED
from paper_tables.cells import Lines, bounds, latex_table, markdown_table, number
from paper_tables.comparison import RATIOS, REFERENCE, split_metric
from paper_tables.paper_numbers import PublishedValue
from paper_tables.place_task_statements import place_verdicts
from paper_tables.place_task_summary import (
    EFFORT,
    HEADLINES,
    METHOD_NOTES,
    METRICS,
    PAPER_COST,
    Headline,
    PlaceTable,
    build_place_table,
    curve_metric,
)
from paper_tables.statements import statement_lines
from paper_tables.summary import (
    BriefColumn,
    PlannerSummary,
    Rendered,
    brief_lines,
    count_lines,
    csv_of,
    metric_lines,
)

BRIEF = (
    BriefColumn("solved [%]", "accuracy", "accuracy"),
    BriefColumn("time [s]", "time", "time_median", "our median", interval=True),
    BriefColumn("length [rad]", "path_length", "path_length_median", "our median"),
)


def render_place(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> Rendered:
    """The rows of one suite in all forms; sentences of the paper are judged where its numbers stand beside ours."""
    rows = list(rows)
    table = build_place_table(rows, published)
    said = statement_lines(place_verdicts(rows, published)) if published else []
    return Rendered(
        size=f"{table.n_problems} problems",
        markdown=render_markdown(table, said),
        latex=render_latex(table),
        csv=csv_of(table.suite, table.planners, METRICS),
        brief=brief_lines(table.planners, BRIEF),
    )


def render_markdown(table: PlaceTable, said: Lines = ()) -> str:
    """Headlines, what the paper says of them, effort, comparisons, time curve, fallbacks, failures and notes."""
    effort, cost = ({name: METRICS[name].label for name in names} for names in (EFFORT, PAPER_COST))
    curve = {curve_metric(time): f"{time:g} s" for time in table.curve_times}
    parts: dict[str, str] = {
        f"{table.n_problems} problems": markdown_table(_headline_lines(table)),
        "What the paper says": markdown_table(said) if len(said) > 1 else "",
        "Effort (medians)": markdown_table(metric_lines(table.planners, effort)),
        "At the paper's cost of work": markdown_table(metric_lines(table.planners, cost)),
        f"Against {REFERENCE}": markdown_table(_split_lines(table)) if table.n_easy else "",
        "Solved within a time, % of runs": markdown_table(metric_lines(table.planners, curve)),
        "Fallbacks": markdown_table(count_lines(table.planners, "fallbacks")),
        "Failures": markdown_table(count_lines(table.planners, "failures")),
        "Notes": _bullets((*METHOD_NOTES, *table.footnotes)),
        "Notes on the paper's numbers (all but accuracy are means)": _bullets(table.published_notes),
    }
    return "\n".join(f"## {title}\n\n{text}" for title, text in parts.items() if text)


def _bullets(notes: Iterable[str]) -> str:
    return "".join(f"- {note}\n" for note in notes)


def _headline_lines(table: PlaceTable) -> Lines:
    header = ["planner", "runs"]
    for headline in HEADLINES:
        metric = METRICS[headline.typical]
        unit = "" if metric.unit == "1" else f" [{metric.unit}]"
        n_joint = f" (n={table.n_joint})" if headline.published == "path_length" else ""
        header += [f"{metric.label}{unit}: paper", f"ours{n_joint}"]
    lines = [header]
    for planner in table.planners:
        first, second = [planner.title, str(planner.n_runs)], ["– mean", ""]
        for headline in HEADLINES:
            first += [planner.paper_cell(headline.published), planner.cell(headline.typical)]
            second += ["", planner.cell(headline.mean) if headline.mean else ""]
        lines += [first, second]
    return lines


def _split_lines(table: PlaceTable) -> Lines:
    """Ratios on all, easy and hard problems, for every planner but the one they are against."""
    sizes = {"all": table.n_easy + table.n_hard, "easy": table.n_easy, "hard": table.n_hard}
    return [
        ["planner", "runs", *(label for label, _ in RATIOS.values())],
        *(
            [planner.name, f"{part} ({size})", *(planner.cell(split_metric(name, part)) for name in RATIOS)]
            for planner in table.planners
            if planner.name != REFERENCE
            for part, size in sizes.items()
        ),
    ]


def render_latex(table: PlaceTable) -> str:
    """The paper's layout (planners as columns), each metric: the paper's value, then ours."""
    planners = table.planners
    names = [
        ["", "", *(planner.paper_name or planner.name for planner in planners)],
        ["", "", *(planner.name if planner.paper_name else "" for planner in planners)],
    ]
    caption = f"{table.suite}, {table.n_problems} problems: the paper's values and ours. "
    caption += " ".join((*METHOD_NOTES[:4], *table.footnotes))
    blocks = [names, *(_latex_block(headline, planners) for headline in HEADLINES)]
    return latex_table(caption, table.suite, blocks)


def _latex_block(headline: Headline, planners: Sequence[PlannerSummary]) -> Lines:
    """One metric: the paper's line, then an estimate and an interval line for each of our statistics."""
    metric = METRICS[headline.typical]
    label = metric.label if metric.unit == "1" else f"{metric.label} ({metric.unit})"
    lines = [[label, "paper", *(planner.paper_cell(headline.published) for planner in planners)]]
    statistics = [("ours" if headline.mean is None else "ours, median", headline.typical)]
    if headline.mean:
        statistics.append(("ours, mean", headline.mean))
    for name, measured in statistics:
        intervals = [planner.measured.get(measured, UNDEFINED) for planner in planners]
        lines.append(["", name, *(number(interval.estimate) for interval in intervals)])
        lines.append(["", "", *map(bounds, intervals)])
    return lines
