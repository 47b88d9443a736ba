"""The table of many kinds of constraints, or of arms:
a line for each kind and planner, ratios within the kind.
"""

from collections.abc import Iterable, Mapping, Sequence

from cvqmpt_lab.results.row import ResultRow, split_problem
from paper_tables import table_engine as table
from paper_tables.measures import RATIOS, REFERENCE, ratio_to, share_of, solved
from paper_tables.paper_numbers import PublishedValue
from paper_tables.table_engine import Column

ALL = "all"
COLUMNS: Mapping[str, Column] = {
    "solved": Column("solved [%]", "%", share_of(solved)),
    **{
        name: Column(f"{RATIOS[name][0]} / {REFERENCE}", "1", ratio_to(REFERENCE, RATIOS[name][1]))
        for name in ("work_ratio", "own_time_ratio", "length_ratio")
    },
}
NOTES = (
    "No constraint was seen in training. Scenes are held out; all planners get the same start and "
    "goals.",
    "Solved: certified, Wilson interval. Ratios to uniform samples: geometric mean over problems "
    "that both solved, "
    "bootstrap interval; work is projections and state checks, time is without goal inverse "
    "kinematics.",
    "Upright: the hand's yaw and place are free. Fixed orientation: its place. Plane, line: its "
    "origin stays there, it "
    "turns freely. Arc: it turns with a crank. Tray: level within 0.02 rad, with a tray. Pouring: "
    "a can in the hand is "
    "tipped about one axis. Door: the shelf's door hangs on its hinge and in the hand. Each of "
    "its doors makes another "
    "robot, whose dictionary's roadmap (`roadmap-cvq`) is made in 0.2 s before the clock starts.",
    "Whether a problem has a solution is not known: an arm without obstacles gets to a goal by a "
    "short search.",
)


ARM_NOTES = (
    "Between two upright hand poses, upright all the way, in held-out scenes of four families.",
    NOTES[1],
)


def arms_table(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> table.Rendered:
    """Every arm in the order of the suite, then all together."""
    return constraints_table(rows, published, "arm", ARM_NOTES)


def constraints_table(
    rows: Iterable[ResultRow],
    published: Sequence[PublishedValue],
    what: str = "constraint",
    notes: Sequence[str] = NOTES,
) -> table.Rendered:
    """Every kind in the order of the suite, then all together; what: a kind of, in the singular."""
    runs = table.suite_runs(rows)
    kinds = dict.fromkeys(
        map(_kind, sorted(runs.rows, key=lambda row: split_problem(row.problem).number))
    )
    found = [
        table.entry(
            planner,
            [row for row in own if kind in (ALL, _kind(row))],
            runs,
            COLUMNS,
            group=(kind,),
            suffix=f"_under_{kind}",
        )
        for kind in (*kinds, ALL)
        for planner, own in runs.groups.items()
    ]
    together = [item for item in found if item.group == (ALL,)]
    size, suite = f"{len({row.problem for row in runs.rows})} problems", runs.rows[0].suite
    lines = table.group_lines(found, [what])
    return table.Rendered(
        size=f"{size}, {len(kinds)} {what}s",
        sections={
            f"By {what}": lines,
            "Fallbacks": table.count_lines(together, "fallbacks"),
            "Failures": table.count_lines(together, "failures"),
            "Notes": notes,
        },
        latex=table.latex_groups(f"{size}, {len(kinds)} {what}s. {notes[1]}", suite, lines),
        csv=table.csv_of(suite, found),
        brief=table.brief_groups(lines, range(len(lines[0]))),
    )


def _kind(row: ResultRow) -> str:
    return split_problem(row.problem).phase
