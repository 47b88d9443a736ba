"""The table of scanned scenes measured in several ways: what follows when one thing is varied."""

from collections.abc import Iterable, Mapping, Sequence

from cvqmpt_lab.results.row import ResultRow, split_problem
from cvqmpt_lab.results.statistics import Interval
from paper_tables import table_engine as table
from paper_tables.measures import REFERENCE, Rows, SuiteRuns, median_of, share_of, solved
from paper_tables.paper_numbers import PublishedValue
from paper_tables.table_engine import Column

Setting = tuple[tuple[str, str], ...]  # name and value of everything that can be varied, in order
TITLES = {
    "noise": "Errors, times an Azure Kinect's",
    "pixels": "Measured pixels, of all cameras",
    "cameras": "Cameras",
    "resolution": "Edge of the map's cells [m]",
    "padding": "Padding of the map's cells [m]",
}
DEFAULT = " *"  # after the value that everything else is varied at


def _collisions(rows: Rows, runs: SuiteRuns) -> Interval:
    """Paths certified in the map that collide in truth, counted."""
    paths = [row for row in rows if row.solved]
    return Interval(sum(row.true_free is False for row in paths), None, None, len(paths))


COLUMNS: Mapping[str, Column] = {
    "solved": Column("solved [%]", "%", share_of(solved)),
    "true_free": Column(
        "free in truth [%]", "%", share_of(lambda row: row.true_free is True, solved)
    ),
    "collisions": Column(
        "collide in truth", "1", _collisions, cell=lambda count: str(count.estimate)
    ),
    "length": Column("length [rad]", "rad", median_of("path_length", "solved")),
}
NOTES = (
    "One thing is varied, everything else is at its default (marked *). Scenes, starts and goals "
    "are the same.",
    "Solved: certified in the map, Wilson interval; a start or goal that the map takes for "
    "occupied is a failure.",
    "Free in truth: of the solved ones, those free in the scene that was scanned. Length: median "
    "of the solved ones.",
    "birrt draws uniform samples, the other planners learned ones.",
)


def robustness_table(
    rows: Iterable[ResultRow], published: Sequence[PublishedValue]
) -> table.Rendered:
    """A table for each thing that is varied, and the padding that follows from them."""
    rows = list(rows)
    levels = levels_of(rows)
    advice = _advice(levels)
    lines = table.group_lines(levels, ["", "value"])
    header, suite = lines[0][1:], rows[0].suite
    parts = {
        TITLES.get(factor, factor): [header, *(line[1:] for line in lines[1:] if line[0] == factor)]
        for factor in dict.fromkeys(level.group[0] for level in levels)
    }
    size = f"{len({split_problem(row.problem).number for row in rows})} scenes"
    caption = (
        f"{size.replace('scenes', 'scanned scenes')}, measured in several ways. {advice} {NOTES[0]}"
    )
    return table.Rendered(
        size=size,
        sections={"": [advice], **parts, "Notes": NOTES},
        latex=table.latex_groups(caption, suite, lines),
        csv=table.csv_of(suite, levels),
        brief=[*table.brief_groups(lines, (0, 1, 2, 4, 5, 6)), advice],
    )


def levels_of(rows: Iterable[ResultRow]) -> list[table.Entry]:
    """Planners at every value of one thing, the rest as in most runs;
    a group is what is varied and its value.
    """
    runs = table.suite_runs(rows)
    by_setting: dict[Setting, list[ResultRow]] = {}
    for row in runs.rows:
        by_setting.setdefault(_setting(row), []).append(row)
    default = _most_common(by_setting)
    planners = sorted(
        {row.planner for row in runs.rows}, key=lambda name: (name != REFERENCE, name)
    )
    levels = []
    for k, (factor, usual) in enumerate(default):
        varied = [s for s in by_setting if s[:k] + s[k + 1 :] == default[:k] + default[k + 1 :]]
        for setting in sorted(varied, key=lambda s: _order(s[k][1])):
            value = setting[k][1]
            group = factor, value + (DEFAULT if value == usual else "")
            for planner in planners:
                chosen = [row for row in by_setting[setting] if row.planner == planner]
                suffix = f"_at_{factor}={value}"
                levels.append(
                    table.entry(planner, chosen, runs, COLUMNS, group=group, suffix=suffix)
                )
    return levels


def _setting(row: ResultRow) -> Setting:
    """What the row's name says that was set."""
    words = (word.partition("=") for word in split_problem(row.problem).phase.split())
    return tuple((name, value) for name, _, value in words)


def _most_common(settings: Iterable[Setting]) -> Setting:
    """The value that each thing has in most settings."""
    columns = list(zip(*settings, strict=True))
    return tuple(max(dict.fromkeys(column), key=column.count) for column in columns)


def _order(value: str) -> float:
    return float("inf") if value == "all" else float(value)


def safe_padding(levels: Sequence[table.Entry]) -> str | None:
    """Least padding [m] at which, and above which, every path is free in truth;
    None if there is none.
    """
    found = None
    padded = [level for level in levels if level.group[0] == "padding"]
    for value in reversed(dict.fromkeys(level.group[1] for level in padded)):
        if any(
            level.measured["collisions"].estimate for level in padded if level.group[1] == value
        ):
            break
        found = value
    return found


def _advice(levels: Sequence[table.Entry]) -> str:
    padding = safe_padding(levels)
    if padding is None:
        return "No padding that was tried makes every path free in truth."
    paths = sum(
        level.measured["true_free"].n for level in levels if level.group == ("padding", padding)
    )
    return (
        f"Recommended padding: {padding.removesuffix(DEFAULT)} m, the least from which on every "
        f"path was free in truth "
        f"({paths} of {paths})."
    )
