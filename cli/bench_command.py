"""`cvqmpt bench`: cost of the stages of planning, and of the paper's state check."""

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path

from cli.options import log, positive_int, writable_file
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.warm_up import compile_kernels
from experiments.paper_check import paper_check
from experiments.stage_times import Measured, stage_times, tuning_problems

EXAMPLES = (
    "cvqmpt bench stages --problems 60",
    "cvqmpt bench paper-check --json check.json",
)
BENCHES: Mapping[str, Callable[[int], list[Measured]]] = {
    "stages": stage_times,
    "paper-check": lambda problems: paper_check(tuning_problems(1)[0]),
}
REMOVED = (
    "kernels", "collision", "planners", "networks", "transformer", "sequences", "throughput",
    "growth", "edge-model", "calibration", "unconstrained", "scan", "meshes",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which bench, how much, where to."""
    add = parser.add_argument
    add("bench", help=", ".join(BENCHES))
    add("--problems", type=positive_int, default=20, metavar="N", help="of stages: problems (20)")
    add("--json", type=Path, metavar="F", help="write the figures as json too")


def run(args: argparse.Namespace) -> int:
    """Measure and print a table."""
    if args.bench in REMOVED:
        raise InvalidInputError(
            f"bench {args.bench} was removed, its last figures are in docs/performance.md; use "
            f"bench stages, or planners of a run: cvqmpt reproduce place-task"
        )
    if args.bench not in BENCHES:
        raise UnknownChoiceError("bench", args.bench, BENCHES)
    if args.json:
        writable_file(args.json)
    compile_kernels(log)
    figures = BENCHES[args.bench](args.problems)
    width = max(len(figure.name) for figure in figures)
    for figure in figures:
        spread = f"  [{figure.low:.4g} .. {figure.high:.4g}]" if figure.low != figure.high else ""
        print(f"{figure.name:{width}}  {figure.median:.4g} {figure.unit}{spread}")
    if args.json:
        write_text(args.json, json.dumps([figure._asdict() for figure in figures], indent=1) + "\n")
    return 0
