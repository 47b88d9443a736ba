"""Planners of others beside ours on the same problems:
paths found and certified, wall clock and length.
"""

from collections.abc import Iterable, Mapping, Sequence

from cvqmpt_lab.results.row import ResultRow
from paper_tables import table_engine as table
from paper_tables.measures import REFERENCE, VALUES, median_of, ratio_to, share_of, solved
from paper_tables.paper_numbers import PublishedValue
from paper_tables.table_engine import BriefColumn, Column

COLUMNS: Mapping[str, Column] = {
    "found": Column("path found [%]", "%", share_of(lambda row: row.certified is not None)),
    "certified": Column("certified [%]", "%", share_of(solved)),
    "wall_median": Column("time [s]", "s", median_of("wall_time")),
    "wall_ratio": Column(f"time / {REFERENCE}", "1", ratio_to(REFERENCE, VALUES["wall_time"])),
    "path_length_median": Column("length [rad]", "rad", median_of("path_length", "solved")),
    "length_ratio": Column(
        f"length / {REFERENCE}", "1", ratio_to(REFERENCE, VALUES["path_length"])
    ),
}
BRIEF = (
    BriefColumn("certified [%]", "accuracy", "certified"),
    BriefColumn("time [s]", "time", "wall_median", interval=True),
    BriefColumn("time ratio", "time", "wall_ratio", interval=True),
    BriefColumn("length [rad]", "path_length", "path_length_median"),
)
NOTES = (
    "Estimate [95 % interval]. Every planner has one thread, the same convex pieces of the robot, "
    "the same obstacles "
    "and pairs of pieces, its own collision checker; what it loads for a robot and a scene is "
    "loaded before.",
    "Path found: the planner returned a path in time. Certified: the path, as it was returned, "
    "also keeps constraint, "
    "limits and obstacles between its states; Wilson intervals.",
    "Time: wall clock around the whole call, for ours with shortening, for theirs with their own; "
    "the certificate is "
    "left out. Median with runs that are not certified as infinite, order-statistic interval.",
    f"Ratios to {REFERENCE}: geometric mean over problems that both solved, paired by problem and "
    f"seed, "
    "bootstrap interval.",
    "Length: of certified paths, Euclidean in joint space.",
    "What favours ours: roboplan and sscbirrt bound roll, pitch and yaw, and get a box of nine "
    "tenths of what fits "
    "into the problem's bounds at any roll; HPP keeps the hand upright exactly; its time holds "
    "its random shortcuts, "
    "as sscbirrt's holds its smoothing; roboplan has no shortening that knows constraints. "
    "roboplan and sscbirrt check "
    "states 0.05 rad apart, as they are set up by their makers; their refused paths collide.",
    "Extension length of roboplan, validation and shortcuts of HPP were chosen on problems that "
    "are not in this table.",
)


def peers_table(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> table.Rendered:
    """Paths, time and length of every planner, failures and notes."""
    runs = table.suite_runs(rows, published)
    found = table.entries(runs, COLUMNS)
    problems = len({row.problem for row in runs.rows})
    made = sorted(
        {
            f"{row.planner}: {row.sampler_used}"
            for row in runs.rows
            if row.vertices is None and row.sampler_used
        }
    )
    return table.Rendered(
        size=f"{problems} problems",
        sections={
            f"{problems} problems": table.column_lines(found, COLUMNS),
            "Failures": table.count_lines(found, "failures"),
            "Notes": [*NOTES, *made, *table.seed_notes(runs)],
        },
        latex=table.latex_planners(
            " ".join(NOTES), runs.rows[0].suite, found, {name: {"": name} for name in COLUMNS}
        ),
        csv=table.csv_of(runs.rows[0].suite, found),
        brief=table.brief_lines(found, BRIEF),
    )
