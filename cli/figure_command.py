"""`cvqmpt figure`: make a figure of the paper, with its numbers."""

import argparse
from pathlib import Path

from cli.options import add_model, log, own_command, positive_int
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import make_folder
from cvqmpt_lab.warm_up import compile_kernels
from experiments.figures.code_update import UpdateSettings
from experiments.figures.paper import FIGURES, reproduce_figure, summary
from experiments.figures.rows import draw_cost, draw_training
from paper_tables.committed import RESULTS

EXAMPLES = (
    "cvqmpt figure histogram --problems 30 --out runs/histogram",
    "cvqmpt figure concept --problem 7 --model runs/published/model --out runs/concept",
    "cvqmpt figure cost --rows runs/place-task --out runs/cost",
    "cvqmpt figure training --rows runs",
)

ROW_FIGURES = {"cost": draw_cost, "training": draw_training}
REMOVED = {  # figures by name, and what is there instead of them
    "equal-time": "cvqmpt plan --optimize improves a path until the time is up",
    "difficulty": "cvqmpt report lists the rows of a run problem by problem",
    "robustness": "cvqmpt reproduce sensor measures planning from noisy cameras",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which figure, of which problem, by which model."""
    add = parser.add_argument
    add("figure", help=f"one of {', '.join((*FIGURES, *ROW_FIGURES))}")
    add(
        "--problem",
        type=int,
        default=0,
        metavar="I",
        help="of concept: index of the place task's problem (0)",
    )
    first = "of histogram: the first N problems (30)"
    add("--problems", type=positive_int, default=30, metavar="N", help=first)
    add_model(parser)
    add("--seed", type=int, default=0, metavar="S", help="seed of all randomness (0)")
    add("--out", type=Path, metavar="DIR", help="where results go (runs/FIGURE)")
    add("--rows", type=Path, metavar="DIR", help=f"rows or trainings, of {', '.join(ROW_FIGURES)}")


def run(args: argparse.Namespace) -> int:
    """Make the figure and say what it shows."""
    known, command = (*FIGURES, *ROW_FIGURES), own_command()
    if args.figure in REMOVED:
        raise InvalidInputError(
            f"figure {args.figure} was removed, its last numbers are in docs/training_log.md; "
            f"{REMOVED[args.figure]}"
        )
    if args.figure not in known:
        raise UnknownChoiceError("figure", args.figure, known)
    if args.figure in ROW_FIGURES:
        if args.rows is None:
            raise InvalidInputError(
                f"figure {args.figure} is drawn from rows or trainings: name their folder with "
                f"--rows"
            )
        out = args.out or Path("runs") / args.figure
        if RESULTS.resolve() in (out.resolve(), *out.resolve().parents):
            raise InvalidInputError(
                f"--out {out} lies in the committed results; name a folder elsewhere: "
                f"runs/{args.figure}"
            )
        make_folder(out)
        written = ROW_FIGURES[args.figure](args.rows, out)
    else:
        out, settings = args.out or Path("runs") / args.figure, UpdateSettings(seed=args.seed)
        compile_kernels(log)
        problems = range(args.problems) if args.figure == "histogram" else (args.problem,)
        updates, written = reproduce_figure(
            args.figure, out, command, problems, args.model, settings
        )
        print("\n".join(summary(updates)))
    for path in written:
        print(f"written {path}")
    return 0
