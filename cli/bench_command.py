"""`cvqmpt bench`: medians with spread, and counts, of kernels, collision checking and planners."""

import argparse
import json
import sys
from pathlib import Path

from cli.options import positive_int, writable_file
from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.warm_up import compile_kernels
from experiments.bench.planning import BENCHES, run_bench

EXAMPLES = (
    "cvqmpt bench kernels",
    "cvqmpt bench collision --states 1000000 --json collision.json",
    "cvqmpt bench sight --problems 4",
    "cvqmpt bench planners --problems 30",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which bench, how much, where to."""
    parser.add_argument("bench", help=", ".join(BENCHES))
    parser.add_argument(
        "--problems",
        type=positive_int,
        default=20,
        metavar="N",
        help="tuning problems to plan; sight: scenes (20)",
    )
    parser.add_argument(
        "--states",
        type=positive_int,
        default=4000,
        metavar="N",
        help="collision: states of each kind in which both checkers are compared (4000)",
    )
    parser.add_argument("--json", type=Path, metavar="F", help="write the figures as json too")


def run(args: argparse.Namespace) -> int:
    """Measure and print a table."""
    if args.bench not in BENCHES:
        raise UnknownChoiceError("bench", args.bench, BENCHES)
    if args.json:
        writable_file(args.json)
    compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
    figures = run_bench(args.bench, args.problems, args.states)
    width = max(len(figure.name) for figure in figures)
    for figure in figures:
        spread = f"  [{figure.low:.4g} .. {figure.high:.4g}]" if figure.low != figure.high else ""
        print(f"{figure.name:{width}}  {figure.median:.4g} {figure.unit}{spread}")
    if args.json:
        write_text(args.json, json.dumps([figure._asdict() for figure in figures], indent=1) + "\n")
    return 0
