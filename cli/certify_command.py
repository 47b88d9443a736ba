"""`cvqmpt certify`: certify a path or trajectory from any source, or all paths of a run again."""

import argparse
import json
from pathlib import Path

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.certificate.motion_check import dry_run
from cvqmpt_lab.certificate.record import record, report_lines
from cvqmpt_lab.cli.options import FLAG, Options, log, numbers, option, positive, refuse_given
from cvqmpt_lab.cli.problem_arguments import chosen_problem, robot_source
from cvqmpt_lab.cli.problem_options import PROBLEM, ROBOT
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.trajectory.trajectory import read_motion


def run(args: argparse.Namespace) -> int:
    """Certify and print; return 1 if anything is refused or not proven."""
    if args.path.is_dir():
        of_file = (args.suite, args.problem_file, args.current, args.clearance)
        if any(given is not None for given in of_file) or robot_source(args):
            raise InvalidInputError(
                "the rows of a run name their problems and robots; give the directory alone"
            )
        return _certify_run(args.path, args.problems_dir, args.json)
    why = "goes with the directory of a run; name one file: --problem-file"
    refuse_given(args, ["problems_dir"], why)
    motion = read_motion(args.path)
    problem = chosen_problem(args)
    if not isinstance(problem, PlanningProblem):
        raise InvalidInputError(
            f"suite {args.suite} has tasks; certify the directory of a run, or one problem"
        )
    found = dry_run(problem, motion, args.current, args.tolerance, exact_clearance=True)
    contents = record(problem, motion, found)
    lines = report_lines(found, contents)
    print(json.dumps(contents, indent=1, allow_nan=False) if args.json else "\n".join(lines))
    return 0 if found.certificate.valid else 1


def _certify_run(directory: Path, problems_dir: Path | None, as_json: bool) -> int:
    from cvqmpt_lab.experiments.replay import recertify

    summary = {"paths": 0, "certified": 0, "refused": 0}
    troubles = []
    for judged in recertify(directory, problems_dir):
        certified = judged.certificate is not None and judged.certificate.valid
        summary["paths"] += 1
        summary["certified" if certified else "refused"] += 1
        if judged.trouble:
            row = judged.row
            troubles.append(f"{row.problem} {row.planner} seed {row.seed}: {judged.trouble}")
            log(troubles[-1])
    if as_json:
        print(json.dumps({**summary, "troubles": troubles}, indent=1))
    else:
        counted = ", ".join(f"{count} {what}" for what, count in summary.items())
        print(f"{counted}, {len(troubles)} differ from their rows")
    return 1 if troubles else 0


OPTIONS: Options = {
    "path": option(
        "states, or a trajectory, whose limits are checked too; or the directory of a run",
        type=Path,
        metavar="PATH.csv|PATH.json|DIR",
    ),
    **PROBLEM,
    "another robot for --problem-file": ROBOT,
    "--problems-dir": option(
        "folder of the problem files, for the directory of a run of them", type=Path, metavar="DIR"
    ),
    "--current": option(
        "current configuration of the arm, in quotes [rad]; the motion must begin there",
        type=lambda text: np.array(numbers("--current", text)),
        metavar="Q",
    ),
    "--tolerance": option(
        "largest distance between that and the first state (0.01)",
        type=positive,
        default=0.01,
        metavar="RAD",
    ),
    "--json": option("print one json object instead, with every compared value", **FLAG),
}
COMMANDS = {"certify": (run, OPTIONS)}
