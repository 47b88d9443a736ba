"""Options of the subcommands that plan."""

import argparse

from cli.options import positive, positive_int
from cvqmpt_lab.methods.table import PLANNERS
from cvqmpt_lab.planning.result import Budget
from cvqmpt_lab.planning.space import BACKENDS


def add_budget(parser: argparse.ArgumentParser) -> None:
    """--cutoff, --iterations and --backend."""
    parser.add_argument("--cutoff", type=positive, metavar="S", help="give up after S seconds (10)")
    parser.add_argument(
        "--iterations",
        type=positive_int,
        metavar="N",
        help="give up after N iterations: repeatable bit for bit",
    )
    parser.add_argument(
        "--backend", default="compiled", help=f"collision backend: {', '.join(BACKENDS)} (compiled)"
    )


def budget(args: argparse.Namespace) -> Budget:
    """The budget asked for; 10 s when nothing was."""
    seconds = 10.0 if args.cutoff is None and args.iterations is None else args.cutoff
    return Budget(seconds=seconds, iterations=args.iterations)


def planner_list(text: str) -> tuple[str, ...]:
    """Names separated by commas; "all" is every planner."""
    return (
        tuple(PLANNERS) if text == "all" else tuple(name.strip() for name in text.split(",") if name.strip())
    )
