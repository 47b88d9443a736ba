"""Options of the subcommands that plan."""

import argparse

from cli.options import Options, not_negative, option, positive, positive_int
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.planners import PLANNERS
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import BACKENDS

BUDGET: Options = {
    "--cutoff": option("give up after S seconds (10)", type=positive, metavar="S"),
    "--iterations": option(
        "give up after N iterations: repeatable bit for bit", type=positive_int, metavar="N"
    ),
    "--backend": option(f"collision backend: {', '.join(BACKENDS)} (compiled)", default="compiled"),
}


def budget(args: argparse.Namespace) -> Budget:
    """The budget asked for; 10 s when nothing was."""
    seconds = 10.0 if args.cutoff is None and args.iterations is None else args.cutoff
    return Budget(seconds=seconds, iterations=args.iterations)


def optimize_option(usual: str = "") -> Options:
    """--optimize; usual: what the help says of its default."""
    text = (
        "spend S seconds more on a shorter path (iterations, where only --iterations bounds "
        "the run)"
    )
    return {"--optimize": option(text + usual, type=not_negative, metavar="S")}


def optimize_budget(args: argparse.Namespace, usual: float | None = None) -> Budget | None:
    """What --optimize asks for, in the unit that bounds the run; `usual` [s] where it is left out."""
    if args.optimize is None and args.cutoff is None and args.iterations is not None:
        return None  # a run that repeats
    seconds = usual if args.optimize is None else args.optimize
    if not seconds:
        return None
    if args.iterations is None or args.cutoff is not None:
        return Budget(seconds=seconds)
    if args.optimize != int(args.optimize):
        raise InvalidInputError(
            f"--optimize {args.optimize:g}: a run of --iterations {args.iterations} knows no "
            f"clock; give a whole number of iterations, or --cutoff beside it"
        )
    return Budget(iterations=int(args.optimize))


def planner_list(text: str) -> tuple[str, ...]:
    """Names separated by commas; "all" is every planner."""
    if text == "all":
        return tuple(PLANNERS)
    return tuple(name.strip() for name in text.split(",") if name.strip())
