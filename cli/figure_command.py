"""`cvqmpt figure`: make a figure of the paper, with its numbers."""

import argparse
from pathlib import Path

from cli.options import SEED, WEIGHTS, Options, log, one_of, option, own_command, positive_int
from cvqmpt_lab.warm_up import compile_kernels
from experiments.figures.code_update import UpdateSettings
from experiments.figures.paper import FIGURES, reproduce_figure, summary

LOG = "its last numbers are in docs/training_log.md"
REMOVED = {  # figures by name, and what is there instead of them
    "cost": "cvqmpt claims --write draws it of the committed rows, and table RUNS has its ends",
    "training": "curves.csv in the folder of a training has its curves; plot its columns",
    "equal-time": f"{LOG}; cvqmpt plan --optimize improves a path until the time is up",
    "difficulty": f"{LOG}; cvqmpt report lists the rows of a run problem by problem",
    "robustness": f"{LOG}; cvqmpt reproduce sensor measures planning from noisy cameras",
}


def run(args: argparse.Namespace) -> int:
    """Make the figure and print a summary."""
    out = args.out or Path("runs") / args.figure
    settings = UpdateSettings(seed=args.seed)
    compile_kernels(log)
    problems = range(args.problems) if args.figure == "histogram" else (args.problem,)
    updates, written = reproduce_figure(
        args.figure, out, own_command(), problems, args.model, settings
    )
    print("\n".join(summary(updates)))
    for path in written:
        print(f"written {path}")
    return 0


OPTIONS: Options = {
    "figure": option(f"one of {', '.join(FIGURES)}", type=one_of("figure", FIGURES, REMOVED)),
    "--problem": option(
        "of concept: index of the place task's problem (0)", type=int, default=0, metavar="I"
    ),
    "--problems": option(
        "of histogram: the first N problems (30)", type=positive_int, default=30, metavar="N"
    ),
    **WEIGHTS,
    **SEED,
    "--out": option("where results go (runs/FIGURE)", type=Path, metavar="DIR"),
}
COMMANDS = {"figure": (run, OPTIONS)}
