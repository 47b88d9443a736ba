"""`cvqmpt reproduce`: run a suite, a folder of problem files, or all suites;
rows, tables, verdicts and a report.
"""

import argparse
from pathlib import Path

from cli.claims_command import PAGE_NAME, pages_of, verdict_lines
from cli.options import ProgressBar, add_model, log, own_command, positive_int
from cli.planner_options import add_budget, add_optimize, budget, optimize_budget, planner_list
from cli.report_command import write_report
from cli.table_command import show_tables
from cvqmpt_lab.benchmarks.suite import SUITES, Suite, folder_suite, suite_named
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.planners import PLANNERS
from cvqmpt_lab.results.provenance import PROVENANCE_FILE
from cvqmpt_lab.warm_up import compile_kernels
from experiments.everything import PROFILES, amounts, planners_of
from experiments.figures.paper import reproduce_figure
from experiments.run import Experiment, default_jobs, executor_for, run_experiment
from paper_tables.suite_tables import render_directory

ALL = "all"
HISTOGRAM = ("histogram", 30)  # the figure that is part of all, and of how many problems
FIXED = (
    "problems",
    "problems_dir",
    "seeds",
    "planners",
    "model",
    "cutoff",
    "iterations",
    "optimize",
)
"""Options that profiles of all suites decide."""
EXAMPLES = (
    "cvqmpt reproduce all --profile small --out runs/all-small",
    "cvqmpt reproduce place-task --problems 20 --seeds 1 --out runs/small",
    "cvqmpt reproduce place-task-with-can --planners birrt,ompl-projected --cutoff 10 --out "
    "runs/can",
    "cvqmpt reproduce --problems-dir problems/ --planners birrt,roadmap --out runs/mine",
    "cvqmpt reproduce place-task --seeds 5 --dask tcp://head:8786 --out runs/cluster",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Suite, how much of it, with which planners, and where to."""
    add = parser.add_argument
    add("suite", nargs="?", help=f"what to reproduce: {', '.join(SUITES)}; or all of it: {ALL}")
    folder = (
        "or a folder of problem files (*.json), by their names; the suite is called like the folder"
    )
    add("--problems-dir", type=Path, metavar="DIR", help=folder)
    takes = "on two cores two hours, three minutes (full)"
    add("--profile", default="full", help=f"of {ALL}: {', '.join(PROFILES)}; {takes}")
    add(
        "--problems",
        type=positive_int,
        metavar="N",
        help="only the first N problems or tasks (all)",
    )
    add("--seeds", type=positive_int, metavar="K", help="seeds 0 to K-1 (1)")
    add(
        "--planners",
        type=planner_list,
        metavar="A,B",
        help=f"of {', '.join(PLANNERS)}, an entry point, package.module:planner (all that can)",
    )
    add_model(parser)
    add_budget(parser)
    add_optimize(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=positive_int, metavar="J", help="processes (one a core)")
    where.add_argument(
        "--dask", metavar="ADDRESS", help="a Dask scheduler that runs it: tcp://HOST:8786"
    )
    add("--out", type=Path, metavar="DIR", help="where results go (runs/SUITE)")


def run(args: argparse.Namespace) -> int:
    """Run what is missing in --out, then render its tables."""
    if args.suite == ALL:
        return _reproduce_all(args)
    suite = _suite(args)
    experiment = Experiment(
        suite=suite.name if args.problems_dir is None else str(args.problems_dir.resolve()),
        problems=tuple(suite.problems[: args.problems]),
        planners=planners_of(suite) if args.planners is None else args.planners,
        seeds=tuple(range(args.seeds or 1)),
        budget=budget(args),
        backend=args.backend,
        model=args.model,
        optimize=optimize_budget(args),
    )
    out = args.out or Path("runs") / suite.name
    compile_kernels(log)
    with executor_for(experiment, args.jobs or default_jobs(), args.dask) as executor:
        run_experiment(experiment, out, executor, own_command(), ProgressBar(suite.name))
    show_tables(out)
    return 0


def _suite(args: argparse.Namespace) -> Suite:
    """The suite that is named, or the problems of the folder."""
    if (args.suite is None) == (args.problems_dir is None):
        raise InvalidInputError(
            f"name a suite ({', '.join(SUITES)}) or give --problems-dir, one of the two"
        )
    return suite_named(args.suite) if args.problems_dir is None else folder_suite(args.problems_dir)


def _reproduce_all(args: argparse.Namespace) -> int:
    """Run what is missing, render everything and print the verdicts."""
    given = [f"--{name.replace('_', '-')}" for name in FIXED if getattr(args, name) is not None]
    if given:
        raise InvalidInputError(
            f"{given[0]} does not go with 'all', whose amounts are fixed; --profile small runs "
            f"less, or name one suite"
        )
    chosen, out, jobs = (
        amounts(args.profile),
        args.out or Path("runs/all"),
        args.jobs or default_jobs(),
    )
    compile_kernels(log)
    for amount in chosen:
        folder = out / amount.folder
        command = [
            *amount.command,
            "--profile",
            args.profile,
            "--jobs",
            str(jobs),
            "--out",
            str(folder),
        ]
        with executor_for(amount.experiment, jobs) as executor:
            run_experiment(amount.experiment, folder, executor, command, ProgressBar(amount.folder))
        render_directory(folder)
    figure, count = HISTOGRAM
    folder = out / figure
    if not (folder / PROVENANCE_FILE).is_file():
        command = ["cvqmpt", "figure", figure, "--problems", str(count), "--out", str(folder)]
        reproduce_figure(figure, folder, command, range(count))
    for path, text in pages_of(out).items():
        write_text(path, text)
    print("\n".join(verdict_lines(out)))
    print(f"every claim, its numbers and commands: {out / PAGE_NAME}")
    print(f"report, for a browser: {write_report(out)}")
    return 0
