"""Two runs of the same problems or two planners of a run, paired by problem and seed."""

import math
import operator
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from cvqmpt_lab.base.errors import InvalidInputError, UnknownChoiceError, require_choice
from cvqmpt_lab.benchmarks.results.provenance import ProvenanceFile, unlike_settings
from cvqmpt_lab.benchmarks.results.statistics import Interval
from cvqmpt_lab.benchmarks.results.store import directory_rows
from cvqmpt_lab.paper_tables.measures import VALUES, Rows, fraction, mean_ratio, paired, solved
from cvqmpt_lab.paper_tables.table_engine import by_planner
from cvqmpt_lab.paper_tables.writers import Lines, change, estimate

COMPARED_VALUES = {
    "time": VALUES["time"],
    "work": VALUES["work"],
    "checks": VALUES["state_checks"],
    "projections": VALUES["projections"],
    "length": VALUES["path_length"],
}
OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
Pair = tuple[str, int]  # problem and seed


class Side(NamedTuple):
    """One side of a comparison: a results directory, or one planner in it."""

    folder: Path
    planner: str | None = None

    @staticmethod
    def read(text: str) -> "Side":
        """Read FOLDER or FOLDER:PLANNER; names of planners may contain colons."""
        parts = text.split(":")
        for count in range(len(parts), 0, -1):
            folder = Path(":".join(parts[:count]))
            if folder.is_dir() or count == 1:
                break
        return Side(folder, ":".join(parts[count:]) or None)

    def unlike(self, other: "Side") -> list[str]:
        """Return a line for each setting in which the other run differs from this one."""
        return unlike_settings(*(ProvenanceFile(side.folder).read() for side in (self, other)))


class Compared(NamedTuple):
    """One planner in two runs, or two planners: A and B."""

    planner: str
    pairs: int
    solved: tuple[Interval, Interval]  # [%]
    gained: tuple[Pair, ...]  # runs that only B solved
    lost: tuple[Pair, ...]  # runs that only A solved
    # ratios B / A of COMPARED_VALUES, over the runs that both solved
    changes: Mapping[str, Interval]
    left_out: tuple[int, int]  # runs of A alone and of B alone, which are not compared
    same_paths: int  # runs whose paths are equal bit for bit


def compared(a: Rows, b: Rows) -> list[Compared]:
    """Compare every planner that both runs have.

    Raises:
        InvalidInputError: suites, problems or seeds differ, or no planner is in both.
    """
    _require_same_suite(a, b)
    groups = by_planner(a, ()), by_planner(b, ())
    common = [name for name in groups[0] if name in groups[1]]
    if not common:
        raise InvalidInputError(
            f"no planner in common: A has {', '.join(groups[0])}, B has {', '.join(groups[1])}; "
            "run one in both"
        )
    return [_compared(name, groups[0][name], groups[1][name]) for name in common]


def compared_sides(a: Side, b: Side) -> list[Compared]:
    """Compare two runs, or two planners of one run or of two.

    Raises:
        UnknownChoiceError: a run has no rows of its planner.
        InvalidInputError: as `compared`, or a planner is named on one side only.
    """
    rows = directory_rows(a.folder), directory_rows(b.folder)
    if a.planner is None and b.planner is None:
        return compared(*rows)
    if a.planner is None or b.planner is None:
        raise InvalidInputError(
            f"one side names a planner, {a.planner or b.planner}, and the other does not; write "
            "A:PLANNER B:PLANNER, or A B"
        )
    groups = [by_planner(own, ()) for own in rows]
    for side, own in zip((a, b), groups, strict=True):
        require_choice(f"planner in {side.folder}:", side.planner, own)
    _require_same_suite(*rows)
    name = a.planner if a.planner == b.planner else f"{a.planner} → {b.planner}"
    return [_compared(name, groups[0][a.planner], groups[1][b.planner])]


def against(rows: Rows, baseline: str) -> list[Compared]:
    """Compare each planner of a run with one of them; UnknownChoiceError if it has no rows."""
    groups = by_planner(rows, ())
    require_choice("baseline", baseline, groups)
    return [
        _compared(name, groups[baseline], own) for name, own in groups.items() if name != baseline
    ]


def planners_of_one(a: Rows, b: Rows) -> tuple[list[str], list[str]]:
    """Return the planners that only A has, and the planners that only B has."""
    of_a, of_b = by_planner(a, ()), by_planner(b, ())
    return [name for name in of_a if name not in of_b], [name for name in of_b if name not in of_a]


def _require_same_suite(a: Rows, b: Rows) -> None:
    suites = [sorted({row.suite for row in rows}) for rows in (a, b)]
    for side, own in zip("AB", suites, strict=True):
        if len(own) > 1:  # their problems may have equal names
            raise InvalidInputError(
                f"{side} has rows of {len(own)} suites, {', '.join(own)}; compare folders of one"
            )
    if suites[0] != suites[1]:
        raise InvalidInputError(
            f"runs of {', '.join(suites[0])} do not pair with runs of {', '.join(suites[1])}; "
            "compare equal suites"
        )


def _compared(planner: str, a: Rows, b: Rows) -> Compared:
    rows = [{(row.problem, row.seed): row for row in run} for run in (a, b)]
    pairs = [(pair, row, rows[1][pair]) for pair, row in rows[0].items() if pair in rows[1]]
    if not pairs:
        raise InvalidInputError(
            f"{planner}: no run in common: A has {named(rows[0])}, B has {named(rows[1])}; run "
            "the same ones"
        )
    left_out = len(rows[0]) - len(pairs), len(rows[1]) - len(pairs)
    a, b = [old for _, old, _ in pairs], [new for _, _, new in pairs]
    return Compared(
        planner=planner,
        pairs=len(pairs),
        solved=(fraction(a, solved), fraction(b, solved)),
        gained=tuple(pair for pair, old, new in pairs if new.solved and not old.solved),
        lost=tuple(pair for pair, old, new in pairs if old.solved and not new.solved),
        changes={name: mean_ratio(paired(b, a, value)) for name, value in COMPARED_VALUES.items()},
        left_out=left_out,
        same_paths=sum(old.path_sha256 == new.path_sha256 is not None for _, old, new in pairs),
    )


def named(pairs: Collection[Pair], most: int = 3) -> str:
    """Return the first runs as text, by problem and seed."""
    names = [f"problem {problem} seed {seed}" for problem, seed in list(pairs)[:most]]
    return ", ".join([*names, "…"] if len(pairs) > most else names)


def comparison_lines(found: Sequence[Compared]) -> Lines:
    """Return a line for each planner, without values that no run has, such as unknown work."""
    names = [
        name
        for name in COMPARED_VALUES
        if any(item.changes[name].estimate is not None for item in found)
    ]
    changed = [f"{name} [%]" for name in names]
    lines = [["planner", "runs", "left out of A, B", "solved A, B [%]", *changed, "same paths"]]
    for item in found:
        solved = ", ".join(map(estimate, item.solved))
        changes = [change(item.changes[name]) for name in names]
        left_out = "{}, {}".format(*item.left_out)
        same = str(item.same_paths)
        lines.append([item.planner, str(item.pairs), left_out, solved, *changes, same])
    return lines


def clear(found: Sequence[Compared]) -> list[str]:
    """Return a line for each change whose interval excludes 1, and for gained and lost runs."""
    lines = []
    for item in found:
        for name, part in item.changes.items():
            low, high = part.low or 1.0, part.high or 1.0
            if low > 1.0 or high < 1.0:
                word = "more" if low > 1.0 else "less"
                lines.append(f"{item.planner}: {word} {name}, {change(part)} %")
        for word, pairs in (("gained", item.gained), ("lost", item.lost)):
            if pairs:
                lines.append(f"{item.planner}: {word} {len(pairs)}: {named(pairs)}")
    return lines


class Rule(NamedTuple):
    """Failure condition on a number of `Compared`."""

    column: str  # name in COMPARED_VALUES: the ratio B / A; or "solved": B - A [percentage points]
    operator: str  # one of OPERATORS
    bound: float

    def __str__(self) -> str:
        return f"{self.column} {self.operator} {self.bound:g}"

    @staticmethod
    def read(text: str) -> "Rule":
        """Read a rule COLUMN OP NUMBER; errors list columns and operators."""
        column, sign, number = (part.strip() for part in re.split("([<>=!]+|$)", text, maxsplit=1))
        if column not in (*COMPARED_VALUES, "solved"):
            raise UnknownChoiceError(f"column in {text!r}:", column, (*COMPARED_VALUES, "solved"))
        if sign not in OPERATORS:
            raise UnknownChoiceError(f"operator in {text!r}:", sign, OPERATORS)
        try:
            bound = float(number)
        except ValueError:
            bound = math.nan
        if not math.isfinite(bound):
            raise InvalidInputError(
                f"{text!r}: {number!r} is no finite number; write COLUMN OP NUMBER, such "
                "as 'work > 1.1' or 'solved < -2'"
            )
        return Rule(column, sign, bound)

    def broken(self, found: Sequence[Compared]) -> list[str]:
        """Return a line for each planner that breaks the rule or cannot be judged."""
        lines = []
        for item in found:
            value = self._value(item)
            if value is None:
                lines.append(f"{item.planner}: {self} cannot be judged, no run of both has it")
            elif OPERATORS[self.operator](value, self.bound):
                unit = " points" if self.column == "solved" else " times A's"
                lines.append(f"{item.planner}: {self}, it is {value:.4g}{unit}")
        return lines

    def _value(self, item: Compared) -> float | None:
        if self.column == "solved":
            before, after = (part.estimate for part in item.solved)
            return None if before is None or after is None else after - before
        return item.changes[self.column].estimate
