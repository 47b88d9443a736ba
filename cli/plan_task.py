"""Tasks of several phases on the command line of `cvqmpt plan`."""

import argparse
import json
import re
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from cli.options import log
from cli.plan_report import as_json, solution_data
from cli.planner_options import budget
from cli.show_options import show_solution
from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import make_folder, write_text
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import SLOW
from cvqmpt_lab.tasks.solve import PhaseOutcome, TaskSolution, solve_task
from cvqmpt_lab.tasks.task import PHASES, Phase, PlannedPhase, Task
from cvqmpt_lab.trajectory.timing import TimingSettings
from cvqmpt_lab.trajectory.trajectory import save_trajectory
from cvqmpt_lab.warm_up import compile_kernels

OF_PROBLEMS = ("cloud", "optimize", "save_path", "view")
INDEX = "task.json"  # in the folder of trajectories: what is done in which order


def run_task(args: argparse.Namespace, task: Task) -> int:
    """Plan a task, report, show; exit code 1 when a phase has no certified path."""
    wrong = next((name for name in OF_PROBLEMS if getattr(args, name)), None)
    if wrong is not None:
        raise InvalidInputError(
            f"--{wrong.replace('_', '-')} does not go with a task; leave it out"
        )
    if args.trajectory is not None:
        _check_folder(args.trajectory)
    planner = planner_named(args.planner, args.model)
    compile_kernels(log)
    timing = TimingSettings(speed=SLOW if args.speed is None else args.speed)
    # refused before anything is planned
    robot_from_source(task.robot).joint_limits.scaled(timing.speed)
    solution = solve_task(task, planner, budget(args), args.seed, timing, backend=args.backend)
    if args.json:
        print(as_json(task_data(solution, args.planner)))
    else:
        print("\n".join(task_report(solution, args.planner)))
    say = partial(print, file=sys.stderr if args.json else sys.stdout)
    if args.trajectory is not None:
        say(_write_trajectories(solution, args.trajectory, timing.speed))
    for line in show_solution(args, solution):
        say(line)
    return 0 if solution.solved else 1


def _check_folder(path: Path) -> None:
    """Refuse before planning what would fail after it."""
    if path.suffix or path.is_file():
        raise InvalidInputError(
            f"--trajectory {path}: of a task it is a folder, for a file a phase; name one"
        )
    make_folder(path)


def _steps(solution: TaskSolution) -> Iterator[tuple[Phase, PhaseOutcome | None]]:
    """The phases in order, planned ones with their outcome, up to the one that failed."""
    outcomes = {outcome.phase.name: outcome for outcome in solution.outcomes}
    for phase in solution.task.phases:
        if isinstance(phase, PlannedPhase) and phase.name not in outcomes:
            return
        yield phase, outcomes.get(phase.name)


def _said(phase: Phase) -> dict[str, Any]:
    """Name and kind of a phase, and what the gripper does in it."""
    kind = next(kind for kind, made in PHASES.items() if type(phase) is made)
    plain = to_plain(phase)
    event = {key: plain[key] for key in ("articulation", "object", "gripper") if key in plain}
    return {"phase": phase.name, "kind": kind, **event}


def task_data(solution: TaskSolution, planner: str) -> dict[str, Any]:
    """The report as plain data for json:
    the phases in order, planned ones as `cvqmpt plan` says of a problem.
    """
    phases = []
    for phase, outcome in _steps(solution):
        said = _said(phase)
        if outcome is not None:
            seconds = outcome.trajectory and outcome.trajectory.duration
            more = {
                "attempts": len(outcome.attempts),
                "duration_s": seconds,
                "reason": outcome.reason,
            }
            said |= more | solution_data(outcome.solution, planner)
            said |= {"solved": outcome.solved, "fallback": outcome.fallback or said["fallback"]}
        phases.append(said)
    whole = {"task": solution.task.name, "planner": planner, "solved": solution.solved}
    return {**whole, "failure": solution.failure, "phases": phases}


def _write_trajectories(solution: TaskSolution, folder: Path, speed: float) -> str:
    """A file for each planned phase, and an index of these and the gripper's events in their order;
    the line for it.
    """
    if not solution.solved:
        return "trajectory  none: only tasks whose phases are all certified are written"
    steps = []
    for k, (phase, outcome) in enumerate(_steps(solution), start=1):
        said = _said(phase)
        if outcome is not None and outcome.arm_trajectory is not None:
            name = f"{k:02d}-{re.sub('[^A-Za-z0-9_.-]', '-', phase.name)}.json"
            save_trajectory(outcome.arm_trajectory, folder / name)
            said |= {"file": name, "duration_s": outcome.arm_trajectory.duration}
        steps.append(said)
    index = {"task": solution.task.name, "speed": speed, "steps": steps}
    write_text(folder / INDEX, json.dumps(index, indent=1) + "\n")
    files = sum("file" in step for step in steps)
    return (
        f"trajectory  {files} files and {len(steps) - files} gripper events, in order in "
        f"{folder / INDEX}"
    )


def task_report(solution: TaskSolution, planner: str) -> list[str]:
    """The lines a person reads."""
    lines = [f"task        {solution.task.name}, planner {planner}"]
    planning = execution = 0.0
    for outcome in solution.outcomes:
        goals = sum(attempt.goal_seconds for attempt in outcome.attempts)
        search = sum(attempt.plan.seconds for attempt in outcome.attempts)
        simplify = sum(
            attempt.simplified.seconds for attempt in outcome.attempts if attempt.simplified
        )
        planning += goals + search + simplify
        line = f"{outcome.phase.name:15} "
        line += (
            f"goals {1e3 * goals:.0f} ms, plan {1e3 * search:.0f} ms, simplify "
            f"{1e3 * simplify:.0f} ms"
        )
        if len(outcome.attempts) > 1:
            line += f" in {len(outcome.attempts)} attempts"
        if outcome.trajectory is not None:
            execution += outcome.trajectory.duration
            line += f", certified, {outcome.trajectory.duration:.1f} s of motion"
        lines.append(line + (f" ({outcome.fallback})" if outcome.fallback else ""))
    if solution.solved:
        return [*lines, f"solved      planning {planning:.2f} s, execution {execution:.1f} s"]
    return [*lines, f"FAILED      {solution.failure}"]
