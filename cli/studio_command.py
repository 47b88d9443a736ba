"""`cvqmpt studio`: a page in the browser on which a problem is changed and planned again."""

import argparse
import threading
from pathlib import Path

from cli.options import Options, log, not_negative_int, option
from cli.problem_options import PROBLEM, ROBOT, problem_asked, robot_source
from cvqmpt_lab.benchmarks.suite import SUITES
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.warm_up import compile_kernels


def run(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    from cvqmpt_lab.show.studio import studio  # half a second to import

    problem = _problem(args)
    compile_kernels(log)
    page = studio(problem, args.port)
    print(f"{page}; Ctrl-C ends it", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        page.stop()
    return 0


def _problem(args: argparse.Namespace) -> PlanningProblem:
    """The problem of a file or suite; without either, one for the robot that is named."""
    name = args.what or "place-task"
    if args.what is None and (source := robot_source(args)) is not None:
        from cvqmpt_lab.benchmarks.templates import problem_template  # half a second to import

        return PlanningProblem.from_dict(problem_template(source))
    args.suite, args.problem_file = (None, Path(name)) if name.endswith(".json") else (name, None)
    if isinstance(problem := problem_asked(args), PlanningProblem):
        return problem
    raise InvalidInputError(f"{name} has tasks, of several phases; studio is for problems")


OPTIONS: Options = {
    "what": option(f"problem file, or suite: {', '.join(SUITES)} (place-task)", nargs="?"),
    "--problem": PROBLEM["--problem"],
    "--clearance": PROBLEM["--clearance"],
    "--port": option("of the page, 0: any (8090)", type=not_negative_int, default=8090),
    "robot of a problem file, or alone, for a problem made for it": ROBOT,
}
COMMANDS = {"studio": (run, OPTIONS)}
