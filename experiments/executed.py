"""The suite `executed`: place motions with the can and tasks, executed in simulation.

Each motion and each task is planned once per speed and executed by each controller at two contact
times; where these disagree the row is undecided. Contacts are not part of any bit-for-bit check.
"""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, RunStoreError
from cvqmpt_lab.base.files import csv_table, read_text, write_text
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.certificate.motion_check import certified_motion
from cvqmpt_lab.execution.execute import (
    CONTACT_TIMES_S,
    Execution,
    Outcome,
    agreed,
    execute_motion,
    execute_task,
)
from cvqmpt_lab.paper_tables.measures import grouped
from cvqmpt_lab.planning.margins import Margin, solve_with_margin
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.tasks.solve import solve_task
from cvqmpt_lab.tasks.task import Task
from cvqmpt_lab.trajectory.timing import TimingSettings

MOTIONS, TASKS = ("place-task-with-can", 50), ("multi-sequence", 10)
CONTROLLERS = ("computed-torque", "computed-torque-unknown-load")
SPEEDS = (1.0, 0.5)
PLANNER, BUDGET, SEED = "birrt", Budget(iterations=40_000), 0
FILE, TABLE = "executed.csv", "table.md"


class Row(NamedTuple):
    """One motion or task, one speed, one controller; of two contact times the worse number."""

    suite: str
    problem: str
    speed: float
    controller: str
    outcome: str
    why: str
    off_path_mm: float
    tilt_rad: float
    contacts: int  # pairs that touched, but for those at grasp and place
    saturated_ms: float
    drift_mm: float | None  # of the load in the hand
    placed: bool | None
    duration_s: float
    planner: str
    seed: int
    commit: str
    mujoco: str


def run_executed(
    out: Path,
    suites: Sequence[tuple[str, int]] = (MOTIONS, TASKS),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Row]:
    """Run what is missing of the suite in a folder, and write its rows and table.

    Args:
        out: folder; rows that it has are kept.
        suites: names, and how many problems of each.
        progress: called with the numbers of rows done and of all.
    """
    rows = read_rows(out / FILE) if (out / FILE).exists() else []
    done = {(row.suite, row.problem, row.speed, row.controller) for row in rows}
    total = sum(count for _, count in suites) * len(SPEEDS) * len(CONTROLLERS)
    progress(len(rows), total)
    for name, count in suites:
        for index in range(count):
            for speed in SPEEDS:
                missing = [c for c in CONTROLLERS if (name, str(index), speed, c) not in done]
                if not missing:
                    continue
                rows += _rows(name, index, speed, missing)
                write_text(out / FILE, csv_table([Row._fields, *rows]))
                progress(len(rows), total)
    write_text(out / TABLE, table(rows))
    return rows


def _rows(suite: str, index: int, speed: float, controllers: Sequence[str]) -> Iterator[Row]:
    made = provenance()
    item = suite_named(suite).solvable(index)
    run, why = _planned(item, speed)
    for controller in controllers:
        found = [run(controller, time) for time in CONTACT_TIMES_S] if run else []
        outcome, reason = agreed(found) if found else (Outcome.NOT_EXECUTED, why)
        yield Row(
            suite,
            str(index),
            speed,
            controller,
            str(outcome),
            reason,
            _worst(1e3 * one.off_path_m for one in found),
            _worst(one.tilt_rad for one in found),
            max((len(one.contacts) for one in found), default=0),
            _worst(1e3 * one.saturated_s for one in found),
            _worst(1e3 * (one.drift_m or 0.0) for one in found) if isinstance(item, Task) else None,
            all(one.placed for one in found) if isinstance(item, Task) else None,
            found[0].seconds if found else np.nan,
            PLANNER,
            SEED,
            f"{made['git_commit']}{'-dirty' if made['git_dirty'] else ''}",
            version("mujoco"),
        )


def _planned(item: Any, speed: float) -> tuple[Callable[[str, float], Execution] | None, str]:
    """Plan a motion or task; return the function that executes it, or None and the reason.

    The function takes the name of a controller and a contact time [s].
    """
    timing = TimingSettings(speed=speed)
    if isinstance(item, Task):
        task = solve_task(item, PLANNER, BUDGET, SEED, timing, margin=Margin())
        if not task.solved:
            return None, f"not planned: {task.failure}"
        return lambda controller, time: execute_task(task, controller, time), ""
    solution, _ = solve_with_margin(item, PLANNER, BUDGET, SEED, Margin())
    if not solution.solved or solution.path is None:
        return None, f"not planned: {solution.plan.status}"
    motion = certified_motion(solution.problem, solution.path, timing)
    return lambda controller, time: execute_motion(item, motion, controller, time), ""


def _worst(values: Iterator[float]) -> float:
    return round(max(values, default=np.nan), 6)


_NUMBERS: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(("contacts", "seed"), int),
    **dict.fromkeys(("speed", "off_path_mm", "tilt_rad", "saturated_ms", "duration_s"), float),
    "drift_mm": lambda text: float(text) if text else None,
    "placed": lambda text: text == "True" if text else None,
}


def read_rows(path: Path) -> list[Row]:
    """The rows of a file of this suite."""
    records: list[dict[str, Any]] = list(csv.DictReader(io.StringIO(read_text(path, "rows"))))
    try:
        numbers = [{k: kind(record[k]) for k, kind in _NUMBERS.items()} for record in records]
        return [Row(**(a | b)) for a, b in zip(records, numbers, strict=True)]
    except (KeyError, TypeError, ValueError) as error:
        raise RunStoreError(f"{path} is no file of executed motions: {error}") from error


def table(rows: Sequence[Row]) -> str:
    """Markdown: a title, and a line for each suite, speed and controller."""
    if not rows:
        raise InvalidInputError("no rows of executed motions")
    heads = (
        "problems | speed | controller | executed | undecided | off path, median (most) [mm] | "
        "tilt, most [rad] | with contacts | at limits, most [ms] | drift, most [mm] | placed"
    )
    lines = [f"| {heads} |", "|---|" + "---|" * heads.count("|")]
    groups = grouped(((row.suite, row.speed, row.controller), row) for row in rows)
    for (suite, speed, controller), some in groups.items():
        ran = [row for row in some if np.isfinite(row.off_path_mm)]
        off = [row.off_path_mm for row in ran] or [np.nan]
        drift = [row.drift_mm for row in ran if row.drift_mm is not None]
        cells = [
            f"{len(some)} of {suite}",
            f"{speed:g}",
            controller,
            f"{sum(row.outcome == Outcome.EXECUTED for row in some)}",
            f"{sum(row.outcome == Outcome.UNDECIDED for row in some)}",
            f"{np.median(off):.2g} ({max(off):.2g})",
            f"{max((row.tilt_rad for row in ran), default=np.nan):.3g}",
            f"{sum(row.contacts > 0 for row in ran)}",
            f"{max((row.saturated_ms for row in ran), default=np.nan):.3g}",
            f"{max(drift):.2g}" if drift else "",
            f"{sum(bool(row.placed) for row in some)}" if drift else "",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(["# Executed in simulation", "", *lines, ""])
