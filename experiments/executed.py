"""Rows of the suite `executed`: motions and tasks are planned, and executed in simulation.

Each is planned once for a speed, and executed by each controller at two contact times; where these
disagree the row is undecided. Contacts are not part of any bit-for-bit check.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial

from cvqmpt_lab.benchmarks.item import ExecutedProblem
from cvqmpt_lab.benchmarks.results.row import FailReason, ResultRow
from cvqmpt_lab.experiments.experiment import Run
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.physics.execute import (
    CONTACT_TIMES_S,
    Execution,
    Outcome,
    agreed,
    execute_motion,
    execute_task,
)
from cvqmpt_lab.features.physics.simulation import mujoco_module
from cvqmpt_lab.features.plan import Request, plan
from cvqmpt_lab.features.tasks.solve import solve_task
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.margins import Margin

Execute = Callable[[str, float], Execution]  # arguments: controller, contact time [s]


def execution_rows(run: Run, item: ExecutedProblem) -> list[ResultRow]:
    """Plan a motion or task, execute it by each controller and return a row for each.

    Raises:
        InvalidInputError: MuJoCo is not installed.
    """
    mujoco_module()  # refused before anything is planned
    execute = _planned(run, item)
    rows = []
    for name, controller in item.controllers.items():
        if isinstance(execute, str):
            rows.append(run.row(name, FailReason.NOT_EXECUTED, execute, measures=measures_of([])))
            continue
        executions = [execute(controller, time) for time in CONTACT_TIMES_S]
        outcome, detail = agreed(executions)
        reasons = {
            Outcome.EXECUTED: None,
            Outcome.NOT_EXECUTED: FailReason.NOT_EXECUTED,
            Outcome.UNDECIDED: FailReason.UNDECIDED,
        }
        measures = measures_of(executions)
        rows.append(run.row(name, reasons[outcome], detail, certified=True, measures=measures))
    return rows


def _planned(run: Run, item: ExecutedProblem) -> Execute | str:
    """Return a function that executes the planned motion or task, or why there is none."""
    setup, problem = run.experiment, item.problem
    timing = TimingSettings(speed=item.speed)
    if isinstance(problem, Task):
        task = solve_task(
            problem,
            run.method,
            setup.budget,
            run.seed,
            timing,
            backend=setup.backend,
            margin=Margin(),
        )
        return partial(execute_task, task) if task.solved else f"not planned: {task.failure}"
    request = Request(
        run.method, setup.budget, run.seed, Margin(), timing=timing, backend=setup.backend
    )
    planned = plan(problem, request)
    if planned.motion is None:
        return f"not planned: {planned.solution.status}"
    return partial(execute_motion, problem, planned.motion)


def measures_of(executions: Sequence[Execution]) -> dict[str, float | None]:
    """Return the worse numbers of two contact times; None where undefined or not executed."""
    drifts = [1e3 * one.drift_m for one in executions if one.drift_m is not None]
    placed = [one.placed for one in executions if one.placed is not None]
    return {
        "off_path_mm": _most(1e3 * one.off_path_m for one in executions),
        "tilt_rad": _most(one.tilt_rad for one in executions),
        "contacts": _most(float(len(one.contacts)) for one in executions),
        "saturated_ms": _most(1e3 * one.saturated_s for one in executions),
        "drift_mm": _most(drifts),
        "placed": float(all(placed)) if placed else None,
        "simulated_s": executions[0].seconds if executions else None,
    }


def _most(values: Iterable[float]) -> float | None:
    """Return the largest number to 6 digits; None where there is none, or it is not defined."""
    most = max(values, default=math.nan)
    return round(most, 6) if math.isfinite(most) else None
