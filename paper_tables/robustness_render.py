"""Render runs on scenes that were measured in several ways. Plans nothing."""

from collections.abc import Iterable, Sequence

from cvqmpt_lab.results.row import ResultRow
from paper_tables.cells import Lines, csv_text, estimate, latex_table, markdown_table, padded
from paper_tables.paper_numbers import PublishedValue
from paper_tables.robustness_summary import Level, RobustnessTable, build_robustness
from paper_tables.summary import CSV_COLUMNS, Rendered, rows_of_one_suite

TITLES = {
    "noise": "Errors, times an Azure Kinect's",
    "pixels": "Measured pixels, of all cameras",
    "cameras": "Cameras",
    "resolution": "Edge of the map's cells [m]",
    "padding": "Padding of the map's cells [m]",
}
HEADER = [
    "value",
    "planner",
    "problems",
    "solved [%]",
    "free in truth [%]",
    "collide in truth",
    "length [rad]",
]
NOTES = (
    "One thing is varied, everything else is at its default (marked *). Scenes, starts and goals are the same.",
    "Solved: certified in the map, Wilson interval; a start or goal that the map takes for occupied is a failure.",
    "Free in truth: of the solved ones, those free in the scene that was scanned. Length: median of the solved ones.",
    "birrt draws uniform samples, the other planners learned ones.",
)


def render_robustness(rows: Iterable[ResultRow], published: Sequence[PublishedValue]) -> Rendered:
    """The rows of the suite in all forms."""
    table = build_robustness(rows_of_one_suite(rows))
    factors = tuple(dict.fromkeys(level.factor for level in table.levels))
    parts = [f"## {TITLES.get(f, f)}\n\n{markdown_table([HEADER, *_lines(table, f)])}" for f in factors]
    notes = "".join(f"- {note}\n" for note in NOTES)
    brief = [["", *HEADER[:2], *HEADER[3:6]]]
    for factor in factors:
        for line in _lines(table, factor):
            brief.append([factor, *line[:2], *(cell.partition(" ")[0] for cell in line[3:6])])
    blocks = [[["", *HEADER]], *([[f, *line] for line in _lines(table, f)] for f in factors)]
    caption = f"{table.n_scenes} scanned scenes, measured in several ways. {_advice(table)} {NOTES[0]}"
    return Rendered(
        size=f"{table.n_scenes} scenes",
        markdown="\n".join([f"{_advice(table)}\n", *parts, f"## Notes\n\n{notes}"]),
        latex=latex_table(caption, table.suite, blocks),
        csv=_csv(table),
        brief=[*("  ".join(line).rstrip() for line in padded(brief)), _advice(table)],
    )


def _advice(table: RobustnessTable) -> str:
    if table.padding is None:
        return "No padding that was tried makes every path free in truth."
    chosen = [level for level in table.levels if (level.factor, level.value) == ("padding", table.padding)]
    paths = sum(level.true_free.n for level in chosen)
    return (
        f"Recommended padding: {table.padding} m, the least from which on every path was free in truth "
        f"({paths} of {paths})."
    )


def _lines(table: RobustnessTable, factor: str) -> Lines:
    return [
        [
            level.value + (" *" if level.default else ""),
            level.planner,
            str(level.solved.n),
            estimate(level.solved),
            estimate(level.true_free),
            str(level.collisions),
            estimate(level.length),
        ]
        for level in table.levels
        if level.factor == factor
    ]


def _csv(table: RobustnessTable) -> str:
    """Long form, as of other tables; the metric names what is varied."""
    lines: list[Sequence[object]] = [CSV_COLUMNS]
    for level in table.levels:
        lines += (_csv_line(table.suite, level, what) for what in ("solved", "true_free", "length"))
    return csv_text(lines)


def _csv_line(suite: str, level: Level, what: str) -> Sequence[object]:
    interval = getattr(level, what)
    unit = "rad" if what == "length" else "%"
    numbers = (interval.estimate, interval.low, interval.high, interval.n)
    return (suite, f"{what}_at_{level.factor}={level.value}", unit, level.planner, "ours", *numbers)
