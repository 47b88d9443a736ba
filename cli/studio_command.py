"""`cvqmpt studio`: a page in the browser on which a problem is changed and planned again."""

import argparse
import signal
import threading

from cli.options import Options, log, not_negative_int, option
from cli.problem_options import PROBLEM, ROBOT, problem_asked, robot_source
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.warm_up import compile_kernels


def run(args: argparse.Namespace) -> None:
    """Serve the page until Ctrl-C."""
    from cvqmpt_lab.show.studio import studio  # half a second to import

    problem = _problem(args)
    compile_kernels(log)
    page = studio(problem, args.port)
    ended = threading.Event()
    # Python would lose a KeyboardInterrupt that comes while it collects garbage
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    print(f"{page}; Ctrl-C ends it", flush=True)
    ended.wait()
    page.stop()


def _problem(args: argparse.Namespace) -> PlanningProblem:
    """The problem of a file or suite; without either, one for the robot that is named."""
    if args.suite is None and args.problem_file is None:
        if (source := robot_source(args)) is not None:
            from cvqmpt_lab.benchmarks.templates import problem_template  # half a second to import

            return PlanningProblem.from_dict(problem_template(source))
        args.suite = "place-task"
    if isinstance(problem := problem_asked(args), PlanningProblem):
        return problem
    raise InvalidInputError(f"{args.suite} has tasks, of several phases; studio is for problems")


OPTIONS: Options = {
    **PROBLEM,
    "--port": option("of the page, 0: any (8090)", type=not_negative_int, default=8090),
    "robot of a problem file, or alone, for a problem made for it": ROBOT,
}
COMMANDS = {"studio": (run, OPTIONS)}
