"""Which problem and which robot, on the command line: a suite or file, --robot or --urdf, and what is said of them."""

import argparse
import math
from pathlib import Path
from typing import Any

from cli.options import numbers
from cvqmpt_lab.codec.plain import mapping, to_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.poses import Placement
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.tasks.task import Task
from experiments.suites.suite import SUITES, suite_named


def add_robot(parser: argparse.ArgumentParser, title: str) -> None:
    """--robot, --urdf and the options of both, under a title."""
    robot = parser.add_argument_group(title)
    robot.add_argument(
        "--robot", metavar="NAME", help="an arm by name: panda, ur5, xarm7, ...; cvqmpt robot lists them"
    )
    robot.add_argument("--urdf", type=Path, metavar="ARM.urdf", help="an arm of hinges and sliders")
    add_robot_options(robot)


def add_robot_options(robot: Any) -> None:
    """What may be said of a robot, whichever way it is named."""
    robot.add_argument("--end-effector", metavar="FRAME", help="its frame that constraint and goals speak of")
    robot.add_argument("--srdf", type=Path, metavar="ARM.srdf", help="file with link pairs not to check")
    robot.add_argument(
        "--package-dir",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="where package:// meshes lie, beside ROS_PACKAGE_PATH; repeatable",
    )
    robot.add_argument(
        "--lock",
        action="append",
        default=[],
        metavar="JOINT=VALUE",
        help="fix a joint [rad or m]; repeatable; joints beside base and end effector are fixed anyway",
    )
    robot.add_argument(
        "--base", metavar="X,Y,Z[,R,P,Y]", help="where its base stands [m], roll, pitch and yaw [rad]"
    )
    robot.add_argument(
        "--acceleration",
        metavar="A[,A...]",
        help="its joints' acceleration limits, one each or one for all [rad/s^2]; --trajectory needs them",
    )


def robot_source(args: argparse.Namespace, problem_file: Path | None = None) -> dict[str, Any] | None:
    """What a problem file would say of the robot of the command line; None without one.

    problem_file: whose robot options without --robot or --urdf speak of.
    """
    options = robot_options(args)
    if args.robot is not None and args.urdf is not None:
        raise InvalidInputError(f"--robot {args.robot} and --urdf {args.urdf}: give one of the two")
    if args.robot is not None:
        return {"name": args.robot, **options}
    if args.urdf is None:
        if options and problem_file is not None:
            own = mapping(
                read_json_object(problem_file, "problem file").get("robot"), f"{problem_file}: robot"
            )
            return {**own, **options, "locked": {**own.get("locked", {}), **options.get("locked", {})}}
        if options:
            raise InvalidInputError(
                "--end-effector, --srdf, --package-dir, --lock, --base and --acceleration describe the robot of "
                "--robot or --urdf; give it"
            )
        return None
    if args.end_effector is None:
        raise InvalidInputError(
            f"--urdf needs --end-effector FRAME, a frame of that URDF; cvqmpt robot {args.urdf} suggests one"
        )
    return {"urdf": str(args.urdf.absolute()), **options}


def chosen_robot(args: argparse.Namespace) -> Robot:
    """The robot of the command line; the Panda unless said otherwise."""
    return robot_from_source(robot_source(args) or {"name": "panda"})


def robot_options(args: argparse.Namespace) -> dict[str, Any]:
    """The options of `add_robot_options` that were given, as fields of a problem file's robot."""
    options: dict[str, Any] = {}
    if args.end_effector is not None:
        options["end_effector"] = args.end_effector
    if args.srdf is not None:
        options["srdf"] = str(args.srdf.absolute())
    if args.package_dir:
        options["package_dirs"] = [str(folder.absolute()) for folder in args.package_dir]
    if args.lock:
        options["locked"] = dict(_locked_joint(text) for text in args.lock)
    if args.base is not None:
        options["base"] = to_plain(_base(args.base))
    if args.acceleration is not None:
        accelerations = numbers("--acceleration", args.acceleration)
        options["acceleration_limits"] = accelerations[0] if len(accelerations) == 1 else accelerations
    return options


def _base(text: str) -> Placement:
    """The pose of --base."""
    x = numbers("--base", text)
    if len(x) not in (3, 6):
        raise InvalidInputError(f"--base {text!r}: write X,Y,Z or X,Y,Z,ROLL,PITCH,YAW [m, rad]")
    return Placement((x[0], x[1], x[2]), (x[3], x[4], x[5]) if len(x) == 6 else None)


def _locked_joint(text: str) -> tuple[str, float]:
    """The joint and value of one --lock."""
    joint, _, value = text.rpartition("=")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not joint or not math.isfinite(number):
        raise InvalidInputError(f"--lock {text!r}: write JOINT=VALUE with a finite number [rad or m]")
    return joint, number


# Which problem, on the command line: an index in a suite, or a file, perhaps for another robot.
def add_problem(
    parser: argparse.ArgumentParser, robot: str = "another robot for the problem of --problem-file"
) -> None:
    """The suite, --problem, --problem-file and the options of its robot, under that title."""
    parser.add_argument("suite", nargs="?", help=f"suite of the problem or task: {', '.join(SUITES)}")
    parser.add_argument("--problem", type=int, default=0, metavar="I", help="index in the suite (0)")
    parser.add_argument("--problem-file", type=Path, metavar="P.json", help="a problem of your own instead")
    add_robot(parser, robot)


def problem_asked(args: argparse.Namespace) -> PlanningProblem | Task:
    """The problem of a suite or file, or the task of a suite."""
    if (args.suite is None) == (args.problem_file is None):
        raise InvalidInputError(f"name a suite ({', '.join(SUITES)}) or give --problem-file, one of the two")
    robot = robot_source(args, args.problem_file)
    if args.problem_file is not None:
        return PlanningProblem.load(args.problem_file, robot=robot)
    if robot:
        raise InvalidInputError(
            "--robot and --urdf go with --problem-file or --start: other problems are for their own robot"
        )
    return suite_named(args.suite).solvable(args.problem)
