"""Render runs on scanned scenes: the paper's robot beside them, map and truth, the paper's words. Plans nothing."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import attrgetter

from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import Interval
from paper_tables.cells import markdown_table
from paper_tables.comparison import Value, share, typical, values_of
from paper_tables.paper_numbers import PublishedValue
from paper_tables.place_task_render import BRIEF, render_latex, render_markdown
from paper_tables.place_task_summary import METRICS, build_place_table
from paper_tables.statements import Statement, judged, statement_lines
from paper_tables.summary import BriefColumn, Metric, Rendered, Runs, brief_lines, csv_of, metric_lines

VALUES: Mapping[str, Value] = {
    "time": attrgetter("t_total_s"),
    "vertices": attrgetter("vertices"),
    "path_length": attrgetter("path_length_rad"),
}
WHAT = {"time": "in planning time", "vertices": "in vertices", "path_length": "in path length"}
STATEMENTS = tuple(
    Statement(f"outperforms {what}", metric, 0.0, planner, ("ompl-projected", "atlas-rrt", "tb-rrt", "birrt"))
    for metric, what in WHAT.items()
    for planner in ("cvq-mpt", "opt-cvq-mpt")
)
"""The paper: "CVQ-MPT and Opt-CV-MPT outperform traditional planners, similar to the Place Task experiment". """


def true_share(rows: Iterable[ResultRow]) -> Interval:
    """Percentage of the certified paths that are free in the scene that was scanned, too."""
    return share([row for row in rows if row.solved], lambda row: row.true_free is True)


def _median_of(column: str) -> Callable[[Runs], Interval]:
    """Over the runs that say it."""
    return lambda runs: typical(values_of(runs.rows, attrgetter(column)))


SENSED: Mapping[str, Metric] = {
    "certified_in_map": Metric(
        "certified in the map [%]", "%", lambda runs: share(runs.rows, attrgetter("solved"))
    ),
    "free_in_truth": Metric("of these free in truth [%]", "%", lambda runs: true_share(runs.rows)),
    "true_clearance_median": Metric("clearance in truth [m]", "m", _median_of("true_clearance_m")),
    "sense_median": Metric("images to map [s]", "s", _median_of("t_sense_s")),
    "whole_median": Metric("images to certificate [s]", "s", _median_of("t_whole_s")),
}
"""What only scanned scenes have."""
FREE = BriefColumn("true [%]", "free_in_truth", "free_in_truth")
NOTES = (
    "Planners know the map alone. Certified in the map: as elsewhere; free in truth: a second certificate, in the "
    "scene that was scanned, Wilson interval over the paths certified in the map.",
    "Images to map: reading depth images, intrinsics and extrinsics, removing the robot, lonely points, and the rest. "
    "Images to certificate: everything until the path is certified in the map, everything counted. Medians.",
    "The paper's scenes, starts and goals are not published: its numbers are of other problems, on a real robot.",
    "Statements compare over problems that both solved, geometric mean; a positive number is less of it.",
)


def render_sensor(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> Rendered:
    """The rows of the suite in all forms."""
    rows, metrics = list(rows), {**METRICS, **SENSED}
    table = build_place_table(rows, published, metrics)
    sections = {
        "In the map and in truth": metric_lines(
            table.planners, {name: m.label for name, m in SENSED.items()}
        ),
        'The paper: "CVQ-MPT and Opt-CV-MPT outperform traditional planners"': statement_lines(
            judged(STATEMENTS, rows, published, VALUES)
        ),
    }
    extra = "\n".join(f"## {title}\n\n{markdown_table(lines)}" for title, lines in sections.items())
    notes = "".join(f"- {note}\n" for note in NOTES)
    brief = (*(column._replace(interval=False) for column in BRIEF), FREE)
    return Rendered(
        size=f"{table.n_problems} scenes",
        markdown=f"{extra}\n{render_markdown(table)}\n## Notes on scanned scenes\n\n{notes}",
        latex=render_latex(table),
        csv=csv_of(table.suite, table.planners, metrics),
        brief=brief_lines(table.planners, brief),
    )
