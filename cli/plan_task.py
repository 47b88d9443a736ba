"""Tasks of several phases on the command line of `cvqmpt plan`."""

import argparse
import json
import re
import sys
from functools import partial
from pathlib import Path

from cli.options import as_json, log
from cli.problem_options import budget
from cli.show_options import show_solution
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import make_folder, write_text
from cvqmpt_lab.planners import planner_named
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import SLOW
from cvqmpt_lab.tasks.solve import TaskSolution, event_of, solve_task, task_data, task_lines
from cvqmpt_lab.tasks.task import Task
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
        print("\n".join(task_lines(solution, args.planner)))
    say = partial(print, file=sys.stderr if args.json else sys.stdout)
    if args.trajectory is not None:
        say(_write_trajectories(solution, args.trajectory, timing.speed))
    for line in show_solution(args, solution):
        say(line)
    return 0 if solution.solved else 1


def _check_folder(path: Path) -> None:
    """Refuse before planning what would fail afterwards."""
    if path.suffix or path.is_file():
        raise InvalidInputError(
            f"--trajectory {path}: of a task it is a folder, for a file a phase; name one"
        )
    make_folder(path)


def _write_trajectories(solution: TaskSolution, folder: Path, speed: float) -> str:
    """Write a file per planned phase and their index with the gripper's events; return its line."""
    if not solution.solved:
        return "trajectory  none: only tasks whose phases are all certified are written"
    steps = []
    for k, (phase, outcome) in enumerate(solution.steps, start=1):
        said = event_of(phase)
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
