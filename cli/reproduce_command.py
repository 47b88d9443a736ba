"""`cvqmpt reproduce`: run a suite of the paper and write its rows and tables, or make a figure of it."""

import argparse
import sys
from pathlib import Path

from cli.figure_options import FIGURES, add_figure_options, refuse_others, run_figure
from cli.options import ProgressBar, add_budget, budget, planner_list, positive_int
from cvqmpt_lab.errors import UnknownChoiceError
from cvqmpt_lab.methods.table import PLANNERS
from cvqmpt_lab.results.store import ResultRow
from experiments.run import Experiment, default_jobs, run_experiment
from experiments.suites.table import SUITES, suite_named
from experiments.warmup import compile_kernels
from paper_tables.render import render_directory

EXAMPLES = (
    "cvqmpt reproduce place-task --problems 20 --seeds 1 --out runs/small",
    "cvqmpt reproduce place-task --planners birrt,ompl-projected --cutoff 10 --out runs/two",
    "cvqmpt reproduce place-task --suite place-task-with-can --out runs/can",
    "cvqmpt reproduce multi-sequence --tasks 2 --planners birrt,guided-birrt",
    "cvqmpt reproduce histogram --problem 7 --out runs/histogram",
    "cvqmpt reproduce concept --model runs/stage2/model --out runs/concept",
)
MULTI_SEQUENCE = "multi-sequence"
TASKS = ("place-task", MULTI_SEQUENCE, *FIGURES)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Suite, how much of it, with which planners, and where to."""
    parser.add_argument("task", help=f"what to reproduce: {', '.join(TASKS)}")
    parser.add_argument("--suite", help=f"variant of its problems: {', '.join(SUITES)} (the task's own)")
    parser.add_argument("--problems", type=positive_int, metavar="N", help="only the first N problems (all)")
    parser.add_argument(
        "--tasks", type=positive_int, metavar="N", help="multi-sequence: the first N tasks (all)"
    )
    parser.add_argument("--seeds", type=positive_int, metavar="K", help="seeds 0 to K-1 (1)")
    parser.add_argument(
        "--planners",
        type=planner_list,
        metavar="A,B",
        help=f"of {', '.join(PLANNERS)} (all)",
    )
    add_budget(parser)
    parser.add_argument("--jobs", type=positive_int, metavar="J", help="processes (one a core)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where results go (runs/SUITE, runs/FIGURE)")
    add_figure_options(parser)


def run(args: argparse.Namespace) -> int:
    """Run what is missing in --out, then render its tables; or make a figure."""
    if args.task not in TASKS:
        raise UnknownChoiceError("task", args.task, TASKS)
    refuse_others(args)
    if args.task == MULTI_SEQUENCE:
        from cli.task_options import run_multi_sequence

        return run_multi_sequence(args)
    if args.task in FIGURES:
        return run_figure(args)
    suite = suite_named(args.suite or args.task)
    experiment = Experiment(
        suite=suite.name,
        problems=tuple(suite.problems[: args.problems]),
        planners=tuple(PLANNERS) if args.planners is None else args.planners,
        seeds=tuple(range(args.seeds or 1)),
        budget=budget(args),
        backend=args.backend,
    )
    out = args.out or Path("runs") / suite.name
    compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
    bar = ProgressBar(suite.name)

    def show(done: int, total: int, row: ResultRow | None) -> None:
        bar(done, total, f"{row.planner} {row.problem} {row.status}" if row else "")

    rows = run_experiment(experiment, out, args.jobs or default_jobs(), ["cvqmpt", *sys.argv[1:]], show)
    written = render_directory(out)
    markdown = next(path for path in written if path.suffix == ".md")
    print(markdown.read_text())
    print(f"{len(rows)} rows in {out / 'runs.csv'}")
    for path in written:
        print(f"table in {path}")
    return 0
