"""Scanned scenes measured in several ways: what becomes of success, length and truth when one thing is varied."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter

from cvqmpt_lab.results.phase_name import split_problem
from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.statistics import Interval
from paper_tables.comparison import share, typical, values_of

UNIFORM = "birrt"
"""The planner whose samples are uniform; the others' are learned."""
Setting = tuple[tuple[str, str], ...]
"""Name and value of everything that can be varied, in order."""


@dataclass(frozen=True)
class Level:
    """One planner's runs at one value of what is varied."""

    factor: str
    value: str
    planner: str
    default: bool
    """Whether it is the value that everything else is varied at."""
    solved: Interval
    """Certified in the map [%]."""
    true_free: Interval
    """Of these free in truth [%]."""
    length: Interval
    """Median of the solved runs [rad]."""
    collisions: int
    """Paths certified in the map that collide in truth."""


@dataclass(frozen=True)
class RobustnessTable:
    """All levels, and the padding that follows from them."""

    suite: str
    n_scenes: int
    levels: tuple[Level, ...]
    padding: str | None
    """Least padding [m] at which, and above which, every path is free in truth; None if there is none."""


def setting_of(row: ResultRow) -> Setting:
    """What the row's name says that was set."""
    return tuple(
        (name, value)
        for name, _, value in (word.partition("=") for word in split_problem(row.problem).phase.split())
    )


def build_robustness(rows: Sequence[ResultRow]) -> RobustnessTable:
    """Summarise rows of runs in which one thing at a time differs from what most have."""
    by_setting: dict[Setting, list[ResultRow]] = {}
    for row in rows:
        by_setting.setdefault(setting_of(row), []).append(row)
    default = _most_common(by_setting)
    planners = sorted({row.planner for row in rows}, key=lambda name: (name != UNIFORM, name))
    levels = []
    for k, (factor, usual) in enumerate(default):
        varied = [s for s in by_setting if s[:k] + s[k + 1 :] == default[:k] + default[k + 1 :]]
        for setting in sorted(varied, key=lambda s: _order(s[k][1])):
            for planner in planners:
                chosen = [row for row in by_setting[setting] if row.planner == planner]
                levels.append(_level(factor, setting[k][1], planner, usual, chosen))
    scenes = {split_problem(row.problem).number for row in rows}
    return RobustnessTable(rows[0].suite, len(scenes), tuple(levels), _safe_padding(levels))


def _most_common(settings: Iterable[Setting]) -> Setting:
    """The value that each thing has in most settings."""
    columns = list(zip(*settings, strict=True))
    return tuple(max(dict.fromkeys(column), key=column.count) for column in columns)


def _order(value: str) -> float:
    return float("inf") if value == "all" else float(value)


def _level(factor: str, value: str, planner: str, usual: str, rows: Sequence[ResultRow]) -> Level:
    paths = [row for row in rows if row.solved]
    return Level(
        factor=factor,
        value=value,
        planner=planner,
        default=value == usual,
        solved=share(rows, attrgetter("solved")),
        true_free=share(paths, lambda row: row.true_free is True),
        length=typical(values_of(paths, attrgetter("path_length_rad"))),
        collisions=sum(row.true_free is False for row in paths),
    )


def _safe_padding(levels: Sequence[Level]) -> str | None:
    """See `RobustnessTable.padding`; levels are in order of their values."""
    found = None
    padded = [level for level in levels if level.factor == "padding"]
    for value in reversed(dict.fromkeys(level.value for level in padded)):
        if any(level.collisions for level in padded if level.value == value):
            break
        found = value
    return found
