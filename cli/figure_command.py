"""`cvqmpt figure`: make a figure of the paper, with its numbers."""

import argparse
import sys
from pathlib import Path

from cli.options import add_model, positive_int
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.warm_up import compile_kernels
from experiments.figures.code_update import UpdateSettings
from experiments.figures.run_figure import (
    FIGURES,
    NAME,
    ROW_FIGURES,
    compare_at_equal_time,
    reproduce_figure,
    summary,
)

EXAMPLES = (
    "cvqmpt figure histogram --problem 7 --out runs/histogram",
    "cvqmpt figure concept --model runs/stage2/model --out runs/concept",
    "cvqmpt figure robustness --out runs/sensor-robustness",
    "cvqmpt figure cost --out runs/place-task",
    "cvqmpt figure difficulty --out runs/place-task",
    f"cvqmpt figure {NAME} --problems 30 --out runs/{NAME}",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which figure, of which problem, by which model."""
    parser.add_argument("figure", help=f"one of {', '.join((*FIGURES, NAME, *ROW_FIGURES))}")
    parser.add_argument(
        "--problem", type=int, default=0, metavar="I", help="index of the place task's problem (0)"
    )
    parser.add_argument(
        "--problems",
        type=positive_int,
        default=30,
        metavar="N",
        help=f"of {NAME}: the first N problems (30)",
    )
    add_model(parser)
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of all randomness (0)")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where results go (runs/FIGURE), or rows are",
    )


def run(args: argparse.Namespace) -> int:
    """Make the figure and say what it shows."""
    if args.figure == "learning-curve":
        raise InvalidInputError(
            "figure learning-curve was removed with the sequence network that it measured; its numbers are in "
            "docs/training_log.md"
        )
    known, command = (*FIGURES, NAME, *ROW_FIGURES), ["cvqmpt", *sys.argv[1:]]
    if args.figure not in known:
        raise UnknownChoiceError("figure", args.figure, known)
    if args.figure in ROW_FIGURES:
        if args.out is None:
            raise InvalidInputError(f"figure {args.figure} is drawn from rows: name their folder with --out")
        written = ROW_FIGURES[args.figure](args.out)
    else:
        out, settings = args.out or Path("runs") / args.figure, UpdateSettings(seed=args.seed)
        compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
        if args.figure == NAME:
            written = compare_at_equal_time(out, args.problems, command)
        else:
            update, written = reproduce_figure(args.figure, out, command, args.problem, args.model, settings)
            print("\n".join(summary(update)))
    for path in written:
        print(f"written {path}")
    return 0
