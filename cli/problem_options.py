"""Which problem, on the command line: an index in a suite, or a file, perhaps for another robot."""

import argparse
from pathlib import Path

from cli.robot_options import add_robot, robot_source
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.tasks.task import Task
from experiments.suites.table import SUITES, suite_named


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
