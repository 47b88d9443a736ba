"""`cvqmpt bench`: medians with spread, and counts, of kernels, collision checking and planners."""

import argparse
import json
from pathlib import Path

from cli.options import log, positive_int, writable_file
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.warm_up import compile_kernels
from experiments.bench.planning import BENCHES, run_bench

EXAMPLES = (
    "cvqmpt bench kernels",
    "cvqmpt bench collision --states 1000000 --json collision.json",
    "cvqmpt bench paper-check",
    "cvqmpt bench edge-model --problems 4",
    "cvqmpt bench transformer --model runs/transformer",
    "cvqmpt bench sequences --problems 60",
    "cvqmpt bench planners --problems 30",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which bench, how much, where to."""
    add = parser.add_argument
    add("bench", help=", ".join(BENCHES))
    add("--problems", type=positive_int, default=20, metavar="N", help="problems, or scenes (20)")
    add(
        "--states",
        type=positive_int,
        default=4000,
        metavar="N",
        help="collision: states of each kind (4000)",
    )
    add("--model", metavar="DIR", help="transformer, sequences: the weights (the shipped VQ-MPT)")
    add("--json", type=Path, metavar="F", help="write the figures as json too")


def run(args: argparse.Namespace) -> int:
    """Measure and print a table."""
    if args.bench not in BENCHES:
        raise UnknownChoiceError("bench", args.bench, BENCHES)
    if args.model is not None and args.bench not in ("transformer", "sequences"):
        raise InvalidInputError("--model is for bench transformer and sequences; leave it out")
    if args.json:
        writable_file(args.json)
    compile_kernels(log)
    figures = run_bench(args.bench, args.problems, args.states, args.model)
    width = max(len(figure.name) for figure in figures)
    for figure in figures:
        spread = f"  [{figure.low:.4g} .. {figure.high:.4g}]" if figure.low != figure.high else ""
        print(f"{figure.name:{width}}  {figure.median:.4g} {figure.unit}{spread}")
    if args.json:
        write_text(args.json, json.dumps([figure._asdict() for figure in figures], indent=1) + "\n")
    return 0
