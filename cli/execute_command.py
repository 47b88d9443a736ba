"""`cvqmpt execute`: execute a motion or task in a physics simulation."""

import argparse
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.reports import Entry, Report
from cvqmpt_lab.cli.options import (
    FLAG,
    SEED,
    Options,
    ProgressBar,
    as_json,
    file_of_kind,
    one_of,
    option,
    positive,
    refuse_changed,
    refuse_given,
)
from cvqmpt_lab.cli.plan_command import FILM_SUFFIX
from cvqmpt_lab.cli.problem_arguments import budget, chosen_problem, margin_of_task
from cvqmpt_lab.cli.problem_options import BUDGET, MARGIN, PROBLEM, ROBOT
from cvqmpt_lab.features.motion.limit_use import share_text
from cvqmpt_lab.features.motion.motion_check import certified_motion, dry_run, with_limits_of
from cvqmpt_lab.features.motion.timing import TimingSettings
from cvqmpt_lab.features.motion.trajectory import Motion, Trajectory, read_motion
from cvqmpt_lab.features.physics.execute import (
    CONTACT_TIMES_S,
    Execution,
    Outcome,
    agreed,
    execute_motion,
    execute_task,
    require_simulated,
)
from cvqmpt_lab.features.physics.simulation import CONTROLLERS, Controller, mujoco_module
from cvqmpt_lab.features.plan import Request, plan
from cvqmpt_lab.features.tasks.solve import solve_task
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.margins import Margin
from cvqmpt_lab.planning.planners import default_planner, planner_named
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import JointPath

HOLDS = ("weld", "friction")


def run(args: argparse.Namespace) -> int:
    """Plan unless a motion is given, execute and report; return 1 if not executed as planned."""
    mujoco_module()  # refused before anything is planned
    times = CONTACT_TIMES_S if args.contact_time is None else (args.contact_time,)
    # steps of the simulation are half as long: shorter ones take hours, at longer ones things sink
    if not 1e-4 <= min(times) <= max(times) <= 0.1:
        raise InvalidInputError(f"--contact-time {args.contact_time:g} s: give 0.0001 to 0.1 s")
    item = chosen_problem(args)
    executions, share = (
        _task(args, item, times) if isinstance(item, Task) else _motion(args, item, times)
    )
    outcome, _ = agreed(executions)
    report = _report(executions, share)
    print(as_json(report.data) if args.json else report)
    if args.film is not None:
        from cvqmpt_lab.features.pictures.bodies import Frame, drawing_of_frames
        from cvqmpt_lab.features.pictures.picture import film_solution

        first = executions[0]
        frames = [Frame(*moment) for moment in first.moments]
        drawing = drawing_of_frames(f"{first.name}: {outcome}", first.scene, frames, most=110)
        film_solution(drawing, args.film, progress=ProgressBar("film"))
        if not args.json:
            print(f"film written to {args.film}")
    return 0 if outcome == Outcome.EXECUTED else 1


def _report(executions: Sequence[Execution], share: str) -> Report:
    """Return the report on one motion or task executed at several contact times.

    Args:
        executions: the same motion or task at each contact time.
        share: used part of the limits, in words.
    """
    first = executions[0]
    outcome, why = agreed(executions)
    times = " and ".join(f"{1e3 * one.contact_time:g}" for one in executions)

    def worst(values: Iterable[float]) -> float:
        return max(values, default=0.0)

    off = worst(one.off_path_m for one in executions)
    joints = worst(one.off_rad for one in executions)
    tilt = worst(one.tilt_rad for one in executions)
    lines = [
        (
            "executed",
            f"{first.name}, {first.seconds:.2f} s{share}, by {first.controller}, contact "
            f"times {times} ms",
        ),
        ("path", f"the hand at most {1e3 * off:.2g} mm off it, joints {joints:.2g} rad behind"),
        (
            "constraint",
            ("" if np.isnan(tilt) else f"tilt {tilt:.3g} rad, ")
            + f"{worst(one.outside_rad for one in executions):.2g} rad and "
            f"{worst(one.outside_m for one in executions):.2g} m outside bounds of positive width",
        ),
        *_not_exact(executions),
        ("efforts", f"at their limits for {worst(one.saturated_s for one in executions):.3g} s"),
    ]
    if first.drift_m is not None:
        drift = worst(one.drift_m or 0.0 for one in executions)
        lines.append(("load", f"moves {1e3 * drift:.2g} mm in the hand"))
    if first.placed_off_m is not None:
        off = worst(one.placed_off_m or 0.0 for one in executions)
        lines.append(("placed", f"{1e3 * off:.2g} mm from its place"))
    reason = f": {why}" if why else ""
    lines.append(("outcome", f"{outcome}{reason}"))

    def data() -> dict[str, Any]:
        runs = [execution.data for execution in executions]
        return {"outcome": outcome, "why": why, "executions": runs}

    return Report.of(lines, data)


def _not_exact(executions: Sequence[Execution]) -> list[Entry]:
    """Return lines on values that bounds of width 0 fix, and on functions of the constraint."""
    rad, m = np.max([(one.fixed_off_rad, one.fixed_off_m) for one in executions], axis=0)
    fixed = [f"{x:.2g} {unit}" for x, unit in ((rad, "rad"), (m, "m")) if not np.isnan(x)]
    inexact = "a controller cannot keep {} exactly"
    lines = []
    if fixed:
        off = f"at most {' and '.join(fixed)} off the values that bounds of width 0 fix: "
        lines.append(("fixed", off + inexact.format("them")))
    for uses in zip(*(one.functions for one in executions), strict=True):
        outside, off = np.max([use[1:] for use in uses], axis=0)
        said = "" if np.isnan(outside) else f"; {outside:.2g} outside"
        said += "" if np.isnan(off) else f"; at most {off:.2g} off: {inexact.format('it')}"
        lines.append(("function", f"{uses[0].name}{said}"))
    return lines


def _task(
    args: argparse.Namespace, task: Task, times: tuple[float, ...]
) -> tuple[list[Execution], str]:
    """Plan and execute a task; return also the used part of the limits in words."""
    refuse_given(args, ["motion"], "goes with a problem; a task is always planned, leave it out")
    refuse_given(args, ["hold"], "goes with a problem; in a task fingers hold by friction")
    timing = TimingSettings(speed=_speed(args))
    margin = margin_of_task(args)
    solution = solve_task(task, "birrt", budget(args), args.seed, timing, args.backend, margin)
    executions = [execute_task(solution, args.controller, time) for time in times]
    return executions, _at_speed(args)


def _motion(
    args: argparse.Namespace, problem: PlanningProblem, times: tuple[float, ...]
) -> tuple[list[Execution], str]:
    """Execute a motion from a file, or plan one; return also the used part of the limits."""
    found = None if args.motion is None else read_motion(args.motion)
    if found is not None:
        problem = with_limits_of(problem, found)
    if found is not None and found.times is not None and args.speed is not None:
        raise InvalidInputError(
            f"--speed {args.speed:g} goes with a planned motion or a path; {args.motion} has times "
            "of its own: leave it out, or plan again with --speed"
        )
    if found is not None:
        why = f"is for planning; the motion of {args.motion} is not planned: leave one of them out"
        refuse_changed(args, {**MARGIN, **SEED, **BUDGET}, why)
    # refused before anything is planned
    require_simulated(problem)
    Controller(args.controller, problem.robot)
    if found is None:
        motion, share = _planned(args, problem), _at_speed(args)
    else:
        motion, share = _read(args, problem, found.of_joints(problem.robot.joint_names))
    friction = args.hold == "friction"
    times_run = (execute_motion(problem, motion, args.controller, t, friction) for t in times)
    return list(times_run), share


def _speed(args: argparse.Namespace) -> float:
    """Return the fraction of the limits that a planned motion uses."""
    return 1.0 if args.speed is None else args.speed


def _at_speed(args: argparse.Namespace) -> str:
    """Return the part of the limits that a planned motion uses, in words."""
    return f" at {_speed(args):g} of the limits"


def _planned(args: argparse.Namespace, problem: PlanningProblem) -> Trajectory:
    """Return a certified motion of a problem."""
    margin = Margin(*args.margin).check()
    settings = TimingSettings(speed=_speed(args))
    problem.robot.joint_limits.scaled(_speed(args))
    method = planner_named(default_planner(problem)[0])
    request = Request(
        method, budget(args), args.seed, margin, timing=settings, backend=args.backend
    )
    planned = plan(problem, request)
    if planned.motion is None:
        solution = planned.solution
        raise InvalidInputError(
            f"problem {problem.name} is not solved: {solution.plan.detail or solution.status}"
            "; cvqmpt plan prints details"
        )
    return planned.motion


def _read(
    args: argparse.Namespace, problem: PlanningProblem, found: Motion
) -> tuple[Trajectory, str]:
    """Return the motion of a file and the used part of the limits; refuse one not certified."""
    if found.times is None:
        settings = TimingSettings(speed=_speed(args))
        return certified_motion(problem, JointPath(found.positions), settings), _at_speed(args)
    if found.velocities is None or found.accelerations is None:
        raise InvalidInputError(
            f"{args.motion} has no accelerations: write it with cvqmpt plan --trajectory"
        )
    judged = dry_run(problem, found)
    if not judged.certificate.valid:
        reasons = "; ".join(judged.certificate.reasons)
        raise InvalidInputError(f"{args.motion} is not certified for this problem: {reasons}")
    states = found.positions, found.velocities, found.accelerations
    motion = Trajectory(problem.robot.joint_names, found.times, *states)
    return motion, share_text(judged.uses)


OPTIONS: Options = {
    **PROBLEM,
    **ROBOT,
    "--motion": option(
        "a motion for the problem, as written by plan --trajectory; without it one is planned",
        type=Path,
        metavar="M.json|M.csv",
    ),
    "--controller": option(
        f"one of {', '.join(CONTROLLERS)} (computed-torque)",
        type=one_of("controller", CONTROLLERS),
        default="computed-torque",
    ),
    "--hold": option(
        "how the hand holds the load of a problem: weld or friction (weld); a task takes friction",
        type=one_of("--hold", HOLDS),
    ),
    "--speed": option(
        "fraction of the joint limits that a planned motion uses (1)",
        type=float,
        metavar="FACTOR",
    ),
    "--contact-time": option(
        "time constant of contacts; by default 4 and 1 ms, which must agree [s]",
        type=positive,
        metavar="S",
    ),
    **MARGIN,
    **SEED,
    **BUDGET,
    "--film": option(
        "a film of the execution",
        type=partial(file_of_kind, "--film", (FILM_SUFFIX,)),
        metavar="RUN.gif",
    ),
    "--json": option("print one json object instead of the report", **FLAG),
}
COMMANDS = {"execute": (run, OPTIONS)}
