"""Two runs of the same problems, before and after a change, paired by problem and seed."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.statistics import Interval
from paper_tables.judging import less
from paper_tables.measures import VALUES, Rows, fraction, mean_ratio, paired, solved
from paper_tables.table_engine import by_planner
from paper_tables.writers import Lines, change, number

COMPARED = {"time": VALUES["time"], "work": VALUES["work"], "length": VALUES["path_length"]}
Pair = tuple[str, int]  # problem and seed


class Compared(NamedTuple):
    """One planner in two runs, A and B."""

    planner: str
    pairs: int
    solved: tuple[Interval, Interval]  # [%]
    gained: tuple[Pair, ...]  # that B alone solves
    lost: tuple[Pair, ...]  # that A alone solves
    # of COMPARED, as reductions (fractions), over the runs that both solve
    changes: Mapping[str, Interval]
    left_out: tuple[int, int]  # runs of A alone and of B alone, which are not compared
    same_paths: int  # runs whose paths are equal bit for bit


def compared(a: Rows, b: Rows) -> list[Compared]:
    """Every planner that both have.

    InvalidInputError where suites, problems or seeds differ, or none is in both.
    """
    suites = [sorted({row.suite for row in rows}) for rows in (a, b)]
    if suites[0] != suites[1]:
        raise InvalidInputError(
            f"runs of {', '.join(suites[0])} do not pair with runs of {', '.join(suites[1])}; "
            "compare equal suites"
        )
    groups = by_planner(a, ()), by_planner(b, ())
    common = [name for name in groups[0] if name in groups[1]]
    if not common:
        raise InvalidInputError(
            f"no planner in common: A has {', '.join(groups[0])}, B has {', '.join(groups[1])}; "
            "run one in both"
        )
    return [_compared(name, groups[0][name], groups[1][name]) for name in common]


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
        solved=(fraction(a, solved).scaled(100), fraction(b, solved).scaled(100)),
        gained=tuple(pair for pair, old, new in pairs if new.solved and not old.solved),
        lost=tuple(pair for pair, old, new in pairs if old.solved and not new.solved),
        changes={name: less(mean_ratio(paired(b, a, value))) for name, value in COMPARED.items()},
        left_out=left_out,
        same_paths=sum(old.path_sha256 == new.path_sha256 is not None for _, old, new in pairs),
    )


def named(pairs: Collection[Pair], most: int = 3) -> str:
    """The first of some runs by problem and seed."""
    names = [f"problem {problem} seed {seed}" for problem, seed in list(pairs)[:most]]
    return ", ".join([*names, "…"] if len(pairs) > most else names)


def comparison_lines(found: Sequence[Compared]) -> Lines:
    """A line for each planner."""
    changed = [f"{name} [%]" for name in COMPARED]
    lines = [["planner", "runs", "left out of A, B", "solved A, B [%]", *changed, "same paths"]]
    for item in found:
        solved = ", ".join(number(part.estimate) for part in item.solved)
        changes = map(change, item.changes.values())
        left_out = "{}, {}".format(*item.left_out)
        same = str(item.same_paths)
        lines.append([item.planner, str(item.pairs), left_out, solved, *changes, same])
    return lines


def clear(found: Sequence[Compared]) -> list[str]:
    """A line for each change whose interval excludes 0, and for runs gained or lost."""
    lines = []
    for item in found:
        for name, part in item.changes.items():
            low, high = part.low or 0.0, part.high or 0.0
            if low > 0.0 or high < 0.0:
                word = "less" if low > 0.0 else "more"
                lines.append(f"{item.planner}: {word} {name}, {change(part)} %")
        for word, pairs in (("gained", item.gained), ("lost", item.lost)):
            if pairs:
                lines.append(f"{item.planner}: {word} {len(pairs)}: {named(pairs)}")
    return lines
