"""Functions that read the options for problem, robot, budget and planners."""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, located, mapping
from cvqmpt_lab.base.files import json_object, read_json_object
from cvqmpt_lab.base.readers import plain_readers, read_by_suffix
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.cli.options import NOTES, numbers, refuse_given
from cvqmpt_lab.cli.problem_options import PRICES_USED
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.margins import Margin
from cvqmpt_lab.planning.planners import PLANNERS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.joint_states import is_joint_state
from cvqmpt_lab.robot.load import group_states, numbers_of, robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.source import ARMS, with_absolute_paths
from cvqmpt_lab.robot.urdf import read_urdf
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.work import PRICES

if TYPE_CHECKING:
    from cvqmpt_lab.constraints.function import FunctionConstraint


def robot_source(
    args: argparse.Namespace, say: Callable[[str], None] = NOTES.append
) -> dict[str, Any] | None:
    """Return the robot of --robot as json of a problem file; None if it is not given.

    say: prints the note on an end effector that is a guess.
    """
    if args.robot is None:
        return None
    source, guesses = source_named(args.robot)
    if guesses:
        say(
            f"end effector {guesses[0]} is a guess; cvqmpt robot {args.robot} --end-effector FRAME "
            "--out robot.json chooses another, for --robot robot.json"
        )
    return source


def source_named(
    text: str, options: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Return a robot as json of a problem file, and the end effectors it may have, if guessed.

    Args:
        text: name of a robot, URDF file, robot file, or file of a problem or task.
        options: fields that replace those of the robot.
    """
    given, path = dict(options or {}), Path(text)
    if text in ARMS or not (path.suffix or path.exists()):
        return {"name": text, **given}, []
    if path.suffix == ".json":
        data = read_json_object(path, "robot file")
        own = mapping(data["robot"], f"{path}: robot") if "robot" in data else data
        own = with_absolute_paths(path.parent, own)
        locked = mapping(own.get("locked", {}), f"{path}: robot.locked")
        if "locked" in given:
            given["locked"] = {**locked, **given["locked"]}
        return {**own, **given}, []
    source = {"urdf": str(path.absolute()), **given}
    if {"end_effector", "end_effectors"} & given.keys():
        return source, []
    guesses = read_urdf(path, given.get("package_dirs", ())).likely_end_effectors()
    return {**source, "end_effector": guesses[0]}, guesses


def chosen_robot(args: argparse.Namespace, file: Path | None = None) -> Robot:
    """Return the robot of --robot, or else of a problem or task file, by default the Panda."""
    source = robot_source(args)
    if source is None and file is not None:
        source, _ = source_named(str(file))
    return robot_from_source({"name": "panda"} if source is None else source)


def robot_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the given options of `ROBOT_DETAILS` as fields of a problem file's robot."""
    given = {
        "end_effector": args.end_effector,
        "end_effectors": args.end_effectors,
        "srdf": args.srdf and str(args.srdf.absolute()),
        "package_dirs": [str(folder.absolute()) for folder in args.package_dir],
        "locked": dict(args.lock),
        "base": args.base,
        "tool": args.tool,
        "joint_limits": args.joint_limits and str(args.joint_limits.absolute()),
        "velocity_limits": args.velocity,
        "acceleration_limits": args.acceleration,
        "jerk_limits": args.jerk,
        "effort_limits": args.effort,
        "hard_limits": args.hard_limits or None,
        "skip_missing_meshes": args.skip_missing_meshes or None,
        "visual_as_collision": args.visual_as_collision or None,
        "bodies": args.bodies,
    }
    return {name: value for name, value in given.items() if value not in (None, [], {})}


def configuration(robot: Robot, option: str, text: str, file: Path | None = None) -> np.ndarray:
    """Return a configuration (n,) of the command line.

    Args:
        robot: whose configuration it is.
        option: for messages.
        text: numbers, the name of a group_state of the SRDF, start or goal of a file, or a file
            with a JointState message.
        file: file of a problem or task; None: start and goal have no meaning.
    """
    if text in ("start", "goal") and file is not None:
        data = read_json_object(file, "problem file")
        given = data.get("start") if text == "start" else (data.get("goals") or [None])[0]
        if given is None:
            field = "start" if text == "start" else "goals"
            found = f", such as cvqmpt ik {file} --region {text} finds"
            found = found if f"{text}_region" in data else ""
            raise InvalidInputError(
                f"{option} {text}: {file} has no configuration in {field!r}; write numbers{found}"
            )
        return np.array(numbers_of(robot, given, f"{file}: {text}"))
    if Path(text).suffix in (".json", ".yaml", ".yml"):
        state = read_by_suffix(plain_readers(), text, "joint state", most=2**20)
        if not is_joint_state(state):
            raise InvalidInputError(
                f"{option} {text} is no JointState with name and position; write numbers"
            )
        return np.array(numbers_of(robot, state, f"{option} {text}"))
    named = text if text in group_states(robot) else numbers(option, text, robot.joint_names)
    return np.array(numbers_of(robot, named, option))


def named_file(text: str) -> Path | None:
    """Return the path of a problem or task file, None for a suite; refuse URDF and YAML."""
    path = Path(text)
    if path.suffix in (".urdf", ".xacro"):
        raise InvalidInputError(
            f"{path} is the description of a robot, not a problem; write one with: cvqmpt problems "
            f"new mine.json --robot {path}"
        )
    if path.suffix in (".yaml", ".yml"):
        raise InvalidInputError(
            f"{path}: a problem file is JSON, not YAML; write an example with: cvqmpt problems new "
            "mine.json --robot ur5; a scene of MoveIt: cvqmpt problems import"
        )
    if text not in SUITES and path.is_dir():
        raise InvalidInputError(f"{path} is a folder; name one problem or task file")
    is_file = text not in SUITES and (path.suffix == ".json" or path.is_file())
    return path if is_file else None


def name_file(args: argparse.Namespace) -> None:
    """Store SUITE|FILE as `suite`, `problem_file` or `task_file`; the others are None."""
    if hasattr(args, "problem_file"):
        return
    args.problem_file = args.task_file = None
    path = None if args.suite is None else named_file(args.suite)
    if path is None:
        return
    task = read_json_object(path, "problem file").get("schema") == Task.SCHEMA
    setattr(args, "task_file" if task else "problem_file", path)
    args.suite = None


def is_function(text: str) -> bool:
    """Return whether a --constraint is a function: its address module:F, or json with it."""
    if text.lstrip().startswith("{"):
        return "function" in json_object(text, "--constraint")
    return ":" in text


def function_of_option(text: str) -> "FunctionConstraint":
    """Return the function of a --constraint."""
    if not is_function(text):
        raise InvalidInputError(
            f"--constraint {text}: give a function, module:F; a region stands in the field "
            "constraint of the file"
        )
    from cvqmpt_lab.constraints.function_files import function_given  # few commands have one

    return function_given(text)


def motion_given(args: argparse.Namespace) -> bool:
    """Return whether start, goal or a region as constraint are given."""
    regions = [text for text in args.constraint if not is_function(text)]
    return any((args.start, args.start_pose, args.goal, args.goal_pose, regions))


def with_functions(
    args: argparse.Namespace, problem: PlanningProblem | Task
) -> PlanningProblem | Task:
    """Return the problem with the functions of --constraint added to its constraint."""
    if not args.constraint:
        return problem
    if not isinstance(problem, PlanningProblem) or not all(map(is_function, args.constraint)):
        raise InvalidInputError(
            f"--constraint {args.constraint[0]}: regions go with --start and --goal of "
            "plan, functions (module:F) with any problem; a task states its own constraints"
        )
    added = map(function_of_option, args.constraint)
    return replace(problem, constraint=(*problem.constraint, *added))


def chosen_problem(args: argparse.Namespace) -> PlanningProblem | Task:
    """Return the problem or task of a suite or file, with the robot of --robot."""
    name_file(args)
    if args.suite is not None:
        item = suite_named(args.suite).solvable(args.problem)
        item = with_robot(item, robot_source(args), f"--robot {args.robot}")
        return with_clearance(args, with_functions(args, item))
    if args.problem_file is None and args.task_file is None:
        raise InvalidInputError(f"name a suite ({', '.join(SUITES)}), or a problem or task file")
    refuse_given(args, ["problem"], "goes with a suite; a file holds one problem, leave it out")
    robot = robot_source(args)
    if args.problem_file is not None:
        problem = PlanningProblem.load(args.problem_file, robot=robot, clearance=args.clearance)
        return with_clearance(args, with_functions(args, problem))
    return with_functions(args, Task.load(args.task_file, robot=robot))


def with_robot(
    item: PlanningProblem | Task, source: Mapping[str, Any] | None, where: str
) -> PlanningProblem | Task:
    """Return a problem or task with another robot, which keeps the door or drawer in its hand.

    Args:
        item: problem or task of a suite.
        source: json of the robot; None: that of the item.
        where: for errors.
    """
    if source is None:
        return item
    own = item.robot if isinstance(item, Task) else item.robot.source
    held = {name: own[name] for name in ("articulated",) if name in own}
    with located(where):
        if isinstance(item, Task):
            return replace(item, robot={**held, **source})
        return replace(item, robot=robot_from_source({**held, **source}))


def with_clearance(
    args: argparse.Namespace, problem: PlanningProblem | Task
) -> PlanningProblem | Task:
    """Return the problem with --clearance.

    A task keeps its clearance: its hand must touch objects.
    """
    if args.clearance and isinstance(problem, PlanningProblem):
        problem = replace(problem, clearance=args.clearance)
    return problem


def margin_of_task(args: argparse.Namespace, most: float = 0.1) -> Margin:
    """Return the margin of a task: --margin or --clearance, whichever is larger.

    A phase keeps less where its hand must come nearer to objects; its margin says so.

    most: largest margin [m].
    """
    clearance = args.clearance or 0.0
    if clearance > most:
        raise InvalidInputError(
            f"--clearance {clearance:g}: a task keeps it as its margin, from 0 to {most:g} m; give "
            "less"
        )
    metres, radians = args.margin
    return Margin(max(metres, clearance), radians).check()


def end_velocities(
    args: argparse.Namespace, robot: Robot
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the velocities (n,) of --start-velocity and --end-velocity; None: not given."""
    names = robot.joint_names
    for said in ("start_velocity", "end_velocity"):
        velocity = getattr(args, said)
        if velocity is not None and len(velocity) != len(names):
            raise InvalidInputError(
                f"--{said.replace('_', '-')} has {len(velocity)} numbers; give {len(names)}, one "
                f"each for {', '.join(names)}"
            )
    start, end = args.start_velocity, args.end_velocity
    return (
        None if start is None else np.array(start),
        None if end is None else np.array(end),
    )


def budget(args: argparse.Namespace, cost: float | None = None) -> Budget:
    """Return the budget of the options; without any: a cost, or 10 s.

    cost: in the paper's seconds [s]; None: 10 s of wall time.
    """
    if args.cutoff is None and args.iterations is None and args.cost is None:
        return Budget(seconds=10.0) if cost is None else Budget(cost=cost)
    limit, prices = args.cost or (None, PRICES_USED)
    return Budget(args.cutoff, args.iterations, limit, PRICES[prices])


def optimize_budget(args: argparse.Namespace, default: float | None = None) -> Budget | None:
    """Return the budget of --optimize in the unit that limits the run; `default` is in seconds."""
    clockless = args.cutoff is None and (args.iterations is not None or args.cost is not None)
    if args.optimize is None and clockless:
        return None  # the run must repeat bit for bit
    seconds = default if args.optimize is None else args.optimize
    if not seconds:
        return None
    if not clockless:
        return Budget(seconds=seconds)
    if args.cost is not None:
        return replace(budget(args), cost=seconds)
    if args.optimize != int(args.optimize):
        raise InvalidInputError(
            f"--optimize {args.optimize:g}: a run limited by --iterations {args.iterations} "
            "measures no time; give a whole number of iterations, or add --cutoff"
        )
    return Budget(iterations=int(args.optimize))


def planner_list(text: str) -> tuple[str, ...]:
    """Return names separated by commas; "all" means every planner."""
    if text == "all":
        return tuple(PLANNERS)
    return tuple(name.strip() for name in text.split(",") if name.strip())
