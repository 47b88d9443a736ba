"""Functions that read the options for problem, robot, budget and planners."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, mapping, require_choice
from cvqmpt_lab.base.files import read_json_object
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.suite import suite_named
from cvqmpt_lab.cli.options import numbers, refuse_given
from cvqmpt_lab.cli.problem_options import ROBOT_DETAILS
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.planning.margins import Margin
from cvqmpt_lab.planning.planners import PLANNERS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import group_states, numbers_of, robot_from_source
from cvqmpt_lab.robot.robot import FrameLimit, Robot
from cvqmpt_lab.robot.source import with_absolute_paths
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.work import PRICES


def robot_source(
    args: argparse.Namespace, problem_file: Path | None = None
) -> dict[str, Any] | None:
    """Return the robot of the command line as json of a problem file; None if none is given.

    Args:
        args: parsed command line.
        problem_file: its robot is changed by the options if neither --robot nor --urdf is given.
    """
    options = robot_options(args)
    if args.robot is not None and args.urdf is not None:
        raise InvalidInputError(f"--robot {args.robot} and --urdf {args.urdf}: give one of the two")
    if args.robot is not None:
        return {"name": args.robot, **options}
    if args.urdf is not None:
        if args.end_effector is None and not args.end_effectors:
            raise InvalidInputError(
                "--urdf needs --end-effector FRAME, a frame of that URDF; cvqmpt robot "
                f"{args.urdf} suggests one"
            )
        return {"urdf": str(args.urdf.absolute()), **options}
    if options and problem_file is None:
        raise InvalidInputError(
            f"{', '.join(ROBOT_DETAILS)} describe the robot of --robot or --urdf; give it"
        )
    if not options or problem_file is None:
        return None
    data = read_json_object(problem_file, "problem file")
    own = mapping(data.get("robot"), f"{problem_file}: robot")
    locked = mapping(own.get("locked", {}), f"{problem_file}: robot.locked")
    return {**own, **options, "locked": {**locked, **options.get("locked", {})}}


def chosen_robot(args: argparse.Namespace, problem_file: Path | None = None) -> Robot:
    """Return the robot of the command line or of a problem file, by default the Panda."""
    source = robot_source(args, problem_file)
    if source is None and problem_file is not None:
        source = read_json_object(problem_file, "problem file").get("robot")
    if problem_file is not None:
        source = with_absolute_paths(problem_file.parent, source)
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
    }
    return {name: value for name, value in given.items() if value not in (None, [], {})}


def configuration(robot: Robot, option: str, text: str) -> np.ndarray:
    """Return a configuration (n,) from numbers or from the name of a group_state of the SRDF."""
    named = text if text in group_states(robot) else numbers(option, text, robot.joint_names)
    return np.array(numbers_of(robot, named, option))


def name_file(args: argparse.Namespace) -> None:
    """Store SUITE|FILE as --problem-file or --task-file if it is a file; refuse URDF and YAML."""
    for given in (args.suite, args.problem_file):
        if given is not None and Path(given).suffix in (".urdf", ".xacro"):
            raise InvalidInputError(
                f"{given} is the description of a robot, not a problem; write one with: cvqmpt "
                f"problems new mine.json --urdf {given}"
            )
        if given is not None and Path(given).suffix in (".yaml", ".yml"):
            raise InvalidInputError(
                f"{given}: a problem file is JSON, not YAML; write an example with: cvqmpt "
                "problems new mine.json --robot ur5; a scene of MoveIt: cvqmpt problems import"
            )
    if args.suite is None or args.suite in SUITES:
        return
    path = Path(args.suite)
    if path.suffix != ".json" and not path.is_file():
        return
    task = read_json_object(path, "problem file").get("schema") == Task.SCHEMA
    if task and not hasattr(args, "task_file"):
        raise InvalidInputError(f"{path} is a task; give a problem file")
    option = "task_file" if task else "problem_file"
    if getattr(args, option) is not None:
        raise InvalidInputError(f"{path} and {getattr(args, option)}: give one file")
    setattr(args, option, path)
    args.suite = None


def is_function(text: str) -> bool:
    """Return whether a --constraint is the address of a function, module:F."""
    return ":" in text and not text.lstrip().startswith("{")


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
    from cvqmpt_lab.constraints.function_files import load_function  # few commands have one

    added = (load_function(address) for address in args.constraint)
    return replace(problem, constraint=(*problem.constraint, *added))


def chosen_problem(args: argparse.Namespace) -> PlanningProblem | Task:
    """Return the problem or task of a suite or file."""
    name_file(args)
    files = [name for name in ("problem_file", "task_file") if hasattr(args, name)]
    if sum(getattr(args, name) is not None for name in ("suite", *files)) != 1:
        options = " or ".join(f"--{name.replace('_', '-')}" for name in files)
        either = "one of the two" if len(files) == 1 else "one of the three"
        raise InvalidInputError(f"name a suite ({', '.join(SUITES)}) or give {options}, {either}")
    if args.suite is None:
        refuse_given(args, ["problem"], "goes with a suite; a file holds one problem, leave it out")
    if args.problem_file is not None:
        robot = robot_source(args, args.problem_file)
        problem = PlanningProblem.load(args.problem_file, robot=robot, clearance=args.clearance)
        return with_limits(args, with_functions(args, problem))
    if robot_source(args):
        raise InvalidInputError(
            "--robot and --urdf go with --problem-file or --start; problems of suites and tasks "
            "have their own robot"
        )
    if args.suite is None:
        return with_limits(args, with_functions(args, Task.load(args.task_file)))
    of_suite = suite_named(args.suite).solvable(args.problem)
    return with_limits(args, with_functions(args, of_suite))


def with_limits(
    args: argparse.Namespace, problem: PlanningProblem | Task
) -> PlanningProblem | Task:
    """Return the problem with --clearance, --tool-speed and --bodies.

    A task keeps its clearance: its hand must touch objects.
    """
    if args.clearance and isinstance(problem, PlanningProblem):
        problem = replace(problem, clearance=args.clearance)
    if getattr(args, "bodies", None):
        given = {"bodies": args.bodies}
        if isinstance(problem, Task):
            problem = replace(problem, robot={**problem.robot, **given})
        else:
            robot = robot_from_source({**problem.robot.source, **given})
            problem = replace(problem, robot=robot)
    if args.tool_speed is None:
        return problem
    if isinstance(problem, Task):
        robot = with_tool_speed(args, robot_from_source(problem.robot))
        return replace(problem, robot=robot.source)
    return replace(problem, robot=with_tool_speed(args, problem.robot))


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
    return Margin(max(args.margin, clearance), args.margin_angle).check()


def with_tool_speed(args: argparse.Namespace, robot: Robot) -> Robot:
    """Return the robot with --tool-speed for its end effectors; without W their own one stays."""
    if args.tool_speed is None:
        return robot
    from cvqmpt_lab.features.motion.frame_speeds import (
        with_frame_limits,  # few commands state a speed
    )

    speed, *turning = args.tool_speed
    limits = dict(robot.frame_limits)
    for name in robot.end_effectors:
        own = limits[name].turning_speed if name in limits else None
        limits[name] = FrameLimit(speed, turning[0] if turning else own)
    return with_frame_limits(robot, limits)


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
    if args.prices is not None and args.cost is None:
        raise InvalidInputError(f"--prices {args.prices}: give --cost, the limit that they price")
    if args.cutoff is None and args.iterations is None and args.cost is None:
        return Budget(seconds=10.0) if cost is None else Budget(cost=cost)
    name = require_choice("--prices", args.prices or "published", PRICES)
    return Budget(args.cutoff, args.iterations, args.cost, PRICES[name])


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
