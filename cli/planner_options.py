"""Options of the subcommands that plan."""

import argparse

from cli.options import not_negative, positive, positive_int
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.planners import PLANNERS
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import BACKENDS


def add_budget(parser: argparse.ArgumentParser) -> None:
    """--cutoff, --iterations and --backend."""
    parser.add_argument("--cutoff", type=positive, metavar="S", help="give up after S seconds (10)")
    repeatable = "give up after N iterations: repeatable bit for bit"
    parser.add_argument("--iterations", type=positive_int, metavar="N", help=repeatable)
    backends = f"collision backend: {', '.join(BACKENDS)} (compiled)"
    parser.add_argument("--backend", default="compiled", help=backends)


def budget(args: argparse.Namespace) -> Budget:
    """The budget asked for; 10 s when nothing was."""
    seconds = 10.0 if args.cutoff is None and args.iterations is None else args.cutoff
    return Budget(seconds=seconds, iterations=args.iterations)


def add_optimize(parser: argparse.ArgumentParser, default: float | None = None) -> None:
    """--optimize."""
    more = (
        "spend S seconds more on a shorter path (iterations, where only --iterations bounds "
        "the run)"
    )
    usual = f"; {default:g}, 0 for none" if default else ""
    parser.add_argument("--optimize", type=not_negative, metavar="S", help=more + usual)
    parser.set_defaults(usual_optimize=default)


def optimize_budget(args: argparse.Namespace) -> Budget | None:
    """What --optimize asks for, in the unit that bounds the run."""
    if args.optimize is None and args.cutoff is None and args.iterations is not None:
        return None  # a run that repeats
    seconds = args.usual_optimize if args.optimize is None else args.optimize
    if not seconds:
        return None
    if args.iterations is None or args.cutoff is not None:
        return Budget(seconds=seconds)
    if args.optimize != int(args.optimize):
        raise InvalidInputError(
            f"--optimize {args.optimize:g}: a run of --iterations {args.iterations} knows no "
            f"clock; give a whole "
            "number of iterations, or --cutoff beside it"
        )
    return Budget(iterations=int(args.optimize))


def planner_list(text: str) -> tuple[str, ...]:
    """Names separated by commas; "all" is every planner."""
    if text == "all":
        return tuple(PLANNERS)
    return tuple(name.strip() for name in text.split(",") if name.strip())
