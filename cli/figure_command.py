"""`cvqmpt figure`: make a figure of the paper, with its numbers."""

import argparse
import sys
from pathlib import Path

from cli.options import add_model
from experiments.figures.latent_update import UpdateSettings
from experiments.figures.run_figure import FIGURES, FigureRequest, reproduce_figure, summary
from experiments.warmup import compile_kernels

EXAMPLES = (
    "cvqmpt figure histogram --problem 7 --out runs/histogram",
    "cvqmpt figure concept --model runs/stage2/model --out runs/concept",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which figure, of which problem, by which model."""
    parser.add_argument("figure", help=f"one of {', '.join(FIGURES)}")
    parser.add_argument(
        "--problem", type=int, default=0, metavar="I", help="index of the place task's problem (0)"
    )
    add_model(parser)
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="seed of all randomness (0)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where results go (runs/FIGURE)")


def run(args: argparse.Namespace) -> int:
    """Make the figure and say what it shows."""
    request = FigureRequest(
        figure=args.figure,
        out=args.out or Path("runs") / args.figure,
        problem=args.problem,
        model=args.model,
        settings=UpdateSettings(seed=args.seed),
    )
    compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
    update, written = reproduce_figure(request, ["cvqmpt", *sys.argv[1:]])
    print("\n".join(summary(update)))
    for path in written:
        print(f"written {path}")
    return 0
