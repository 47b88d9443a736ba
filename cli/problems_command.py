"""`cvqmpt problems`: list a suite's problems, or write them as json for `plan --problem-file` or `--task-file`."""

import argparse
from pathlib import Path

from cli.options import ProgressBar, positive_int
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import make_folder
from cvqmpt_lab.pipeline import with_sampled_goals
from cvqmpt_lab.tasks.task import Task
from experiments.suites.place_task import UnsolvableProblem
from experiments.suites.table import SUITES, suite_named

EXAMPLES = (
    "cvqmpt problems list place-task --problems 5",
    "cvqmpt problems export place-task --out problems/",
)
ACTIONS = ("list", "export")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Action, suite, how many, where to."""
    parser.add_argument("action", help=", ".join(ACTIONS))
    parser.add_argument("suite", help=f"suite: {', '.join(SUITES)}")
    parser.add_argument("--problems", type=positive_int, metavar="N", help="only the first N (all)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the json files (with export)")


def run(args: argparse.Namespace) -> int:
    """Build each problem; print a line or write a file."""
    if args.action not in ACTIONS:
        raise UnknownChoiceError("action", args.action, ACTIONS)
    suite = suite_named(args.suite)
    indices = suite.problems[: args.problems]
    if args.action == "export":
        if args.out is None:
            raise InvalidInputError("export needs --out DIR")
        make_folder(args.out)
    bar = ProgressBar(f"{args.action} {suite.name}")
    unsolvable = 0
    for done, index in enumerate(indices, start=1):
        problem = suite.item(index)
        if isinstance(problem, UnsolvableProblem):
            unsolvable += 1
            print(f"{index}: unsolvable, {problem.reason}")
        elif args.action == "list":
            print(f"{index}: start {' '.join(f'{x:.3f}' for x in problem.start)}")
        else:
            whole = problem if isinstance(problem, Task) else with_sampled_goals(problem)[0]
            whole.save(args.out / f"{suite.name}-{index:03d}.json")
            bar(done, len(indices))
    print(f"{len(indices) - unsolvable} problems, {unsolvable} unsolvable")
    return 0
