"""The figures of `cvqmpt reproduce`: their options and their run."""

import argparse
import sys
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError
from experiments.warmup import compile_kernels

FIGURES = ("histogram", "concept")
OF_FIGURES = ("problem", "model", "seed")
OF_SUITES = ("suite", "problems", "seeds", "planners", "cutoff", "iterations", "jobs")


def add_figure_options(parser: argparse.ArgumentParser) -> None:
    """Which problem, by which model."""
    group = parser.add_argument_group(f"figures ({', '.join(FIGURES)})")
    group.add_argument("--problem", type=int, metavar="I", help="index of the place task's problem (0)")
    group.add_argument("--model", type=Path, metavar="DIR", help="folder of weights (those of the package)")
    group.add_argument("--seed", type=int, metavar="S", help="seed of all randomness (0)")


def refuse_others(args: argparse.Namespace) -> None:
    """Refuse options that the task would ignore."""
    wrong: tuple[str, ...] = (*OF_SUITES, "tasks") if args.task in FIGURES else (*OF_FIGURES, "tasks")
    if args.task == "multi-sequence":
        wrong = (*OF_FIGURES, "suite", "problems")
    given = [name for name in wrong if getattr(args, name) is not None]
    if given:
        raise InvalidInputError(f"--{given[0]} does not go with {args.task}; leave it out")


def run_figure(args: argparse.Namespace) -> int:
    """Make the figure and say what it shows."""
    from experiments.figures.latent_update import UpdateSettings
    from experiments.figures.run_figure import FigureRequest, reproduce_figure, summary

    request = FigureRequest(
        figure=args.task,
        out=args.out or Path("runs") / args.task,
        problem=args.problem or 0,
        model=args.model,
        settings=UpdateSettings(seed=args.seed or 0),
    )
    compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
    update, written = reproduce_figure(request, ["cvqmpt", *sys.argv[1:]])
    print("\n".join(summary(update)))
    for path in written:
        print(f"written {path}")
    return 0
