"""The same command gives the same rows, times aside, whatever the number of workers, threads and the hash seed."""

import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from itertools import zip_longest
from pathlib import Path

from cvqmpt_lab.methods.table import CONTROLS, PLANNERS
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, read_rows
from experiments.trust import command
from experiments.trust.check import Check, Trial

CIRCUMSTANCES: tuple[tuple[int, Mapping[str, str]], ...] = (
    (1, {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "1"}),
    (2, {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "2"}),
    (1, {"OPENBLAS_NUM_THREADS": "4", "OMP_NUM_THREADS": "3", "PYTHONHASHSEED": "3"}),
)
"""Workers and environments; rows of the first are those that all others must repeat."""


def _rows(
    suite: str, words: tuple[object, ...], workers: int, environment: Mapping[str, str]
) -> list[ResultRow]:
    with tempfile.TemporaryDirectory() as folder:
        done = command.run(
            ("reproduce", suite, *words, "--jobs", workers, "--out", folder), None, **environment
        )
        if done.returncode:
            raise RuntimeError(f"cvqmpt reproduce {suite} ended with {done.returncode}: {done.stderr[-400:]}")
        return read_rows(Path(folder) / RUNS_FILE)


def untimed(row: ResultRow | None) -> dict[str, object]:
    """What must repeat."""
    if row is None:
        return {}
    return {name: value for name, value in asdict(row).items() if not name.startswith("t_")}


def differences(rows: list[ResultRow], again: list[ResultRow]) -> list[str]:
    """A line for every row that differs, naming the first column in which it does."""
    found = []
    for one, two in zip_longest(rows, again):
        old, new = untimed(one), untimed(two)
        column = next((name for name in {**old, **new} if old.get(name) != new.get(name)), None)
        if column is not None:
            key = (one or two).key
            found.append(f"{key.problem} {key.planner} seed {key.seed}: {column}")
    return found


def repeated(suite: str, planners: tuple[str, ...], iterations: int, problems: int) -> Trial:
    """Rows compared, and those that differ from a run on one worker and one thread."""
    words = ("--problems", problems, "--planners", ",".join(planners), "--iterations", iterations)
    first, tried, faults = None, 0, []
    for workers, environment in CIRCUMSTANCES:
        rows = _rows(suite, words, workers, environment)
        if first is None:
            first = rows
            continue
        tried += len(rows)
        faults += [f"{suite}, {workers} workers, {environment}: {line}" for line in differences(first, rows)]
    return Trial(tried, faults)


CHECKS = (
    Check(
        "rows repeat: four planners",
        "rows",
        short=1,
        long=12,
        attack=lambda problems: repeated(
            "place-task", ("birrt", "ompl-projected", "mpnet", "cvq-mpt"), 300, problems
        ),
    ),
    Check(
        "rows repeat: all planners and controls",
        "rows",
        short=0,
        long=8,
        attack=lambda problems: repeated("place-task", (*PLANNERS, *CONTROLS), 3000, problems),
    ),
    Check(
        "rows repeat: tasks of several phases",
        "rows",
        short=0,
        long=1,
        attack=lambda tasks: repeated("multi-sequence", tuple(PLANNERS), 3000, tasks),
    ),
)
