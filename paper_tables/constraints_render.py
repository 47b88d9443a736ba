"""Render runs under many kinds of constraints: a line for each kind and planner. Plans nothing."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter

from cvqmpt_lab.results.phase_name import split_problem
from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import Interval
from paper_tables.cells import Lines, csv_text, estimate, latex_table, markdown_table, padded
from paper_tables.comparison import RATIOS, REFERENCE, paired_ratio, share
from paper_tables.paper_numbers import PublishedValue
from paper_tables.summary import CSV_COLUMNS, Rendered, by_planner, count_lines, rows_of_one_suite, summarised
from paper_tables.summary import Runs as PlannerRuns

ALL = "all kinds"
SHOWN = {name: RATIOS[name] for name in ("work_ratio", "own_time_ratio", "length_ratio")}
HEADER = [
    "constraint",
    "planner",
    "problems",
    "solved [%]",
    *(f"{label} / {REFERENCE}" for label, _ in SHOWN.values()),
]
NOTES = (
    "No constraint was seen in training. Scenes are held out; all planners get the same start and goals.",
    "Solved: certified, Wilson interval. Ratios to uniform samples: geometric mean over problems that both solved, "
    "bootstrap interval; work is projections and state checks, time is without goal inverse kinematics.",
    "Upright: the hand's yaw and place are free. Fixed orientation: its place. Plane, line: its origin stays there, it "
    "turns freely. Arc: it turns with a crank. Tray: level within 0.02 rad, with a tray. Pouring: a can in the hand is "
    "tipped about one axis. Door: the shelf's door hangs on its hinge and in the hand.",
    "Whether a problem has a solution is not known: an arm without obstacles gets to a goal by a short search.",
)


@dataclass(frozen=True)
class KindSummary:
    """One planner under one kind of constraint."""

    kind: str
    planner: str
    solved: Interval
    """[%]."""
    ratios: Mapping[str, Interval]
    """To uniform samples, by name of `SHOWN`."""


def kind_of(row: ResultRow) -> str:
    """The kind of constraint that a row's name says."""
    return split_problem(row.problem).phase


def summaries(rows: Sequence[ResultRow]) -> list[KindSummary]:
    """Every kind in the order of the suite, then all together; planners as they come."""
    kinds = dict.fromkeys(kind_of(row) for row in sorted(rows, key=lambda r: split_problem(r.problem).number))
    groups = by_planner(rows, ())
    return [
        _summary(
            kind, planner, [row for row in group if kind in (ALL, kind_of(row))], groups.get(REFERENCE, [])
        )
        for kind in (*kinds, ALL)
        for planner, group in groups.items()
    ]


def _summary(
    kind: str, planner: str, rows: Sequence[ResultRow], reference: Sequence[ResultRow]
) -> KindSummary:
    ratios = {name: paired_ratio(rows, reference, value) for name, (_, value) in SHOWN.items()}
    return KindSummary(kind, planner, share(rows, attrgetter("solved")), ratios)


def render_constraints(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> Rendered:
    """The rows of the suite in all forms."""
    rows = rows_of_one_suite(rows)
    found = summaries(rows)
    planners = [summarised(name, PlannerRuns(group), (), {}) for name, group in by_planner(rows, ()).items()]
    kinds = list(dict.fromkeys(item.kind for item in found))
    parts = {
        "By kind of constraint": markdown_table([HEADER, *_lines(found)]),
        "Fallbacks": markdown_table(count_lines(planners, "fallbacks")),
        "Failures": markdown_table(count_lines(planners, "failures")),
        "Notes": "".join(f"- {note}\n" for note in NOTES),
    }
    size = f"{len({row.problem for row in rows})} problems"
    blocks = [[HEADER], *(_lines([item for item in found if item.kind == kind]) for kind in kinds)]
    brief = padded(
        [
            HEADER,
            *(
                [cell.partition(" ")[0] if k > 2 else cell for k, cell in enumerate(line)]
                for line in _lines(found)
            ),
        ]
    )
    return Rendered(
        size=f"{size}, {len(kinds) - 1} kinds",
        markdown="\n".join(f"## {title}\n\n{text}" for title, text in parts.items()),
        latex=latex_table(
            f"{size} under {len(kinds) - 1} kinds of constraints. {NOTES[1]}", rows[0].suite, blocks
        ),
        csv=_csv(rows[0].suite, found),
        brief=["  ".join(line).rstrip() for line in brief],
    )


def _lines(found: Iterable[KindSummary]) -> Lines:
    return [
        [
            item.kind,
            item.planner,
            str(item.solved.n),
            estimate(item.solved),
            *map(estimate, item.ratios.values()),
        ]
        for item in found
    ]


def _csv(suite: str, found: Iterable[KindSummary]) -> str:
    """Long form, as of other tables; the metric names the kind."""
    lines: list[Sequence[object]] = [CSV_COLUMNS]
    for item in found:
        for name, unit, interval in (
            ("solved", "%", item.solved),
            *((name, "1", ratio) for name, ratio in item.ratios.items()),
        ):
            numbers = (interval.estimate, interval.low, interval.high, interval.n)
            lines.append((suite, f"{name}_under_{item.kind}", unit, item.planner, "ours", *numbers))
    return csv_text(lines)
