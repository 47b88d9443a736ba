"""`cvqmpt reproduce`: run suites or folders of problems; `cvqmpt figure`: a figure of the paper.

Runs give rows, tables, verdicts and a report, figures their numbers.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import write_bytes
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.results.provenance import PROVENANCE_FILE
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.benchmarks.results.store import directory_rows
from cvqmpt_lab.benchmarks.suite import folder_suite, suite_named
from cvqmpt_lab.cli.options import (
    ONE_OF,
    REACH,
    SEED,
    WEIGHTS,
    Options,
    ProgressBar,
    compiling,
    log,
    one_of,
    option,
    own_command,
    positive_int,
    refuse_changed,
    refuse_given,
    writable_file,
)
from cvqmpt_lab.cli.problem_arguments import budget, optimize_budget, planner_list
from cvqmpt_lab.cli.problem_options import BUDGET, CODE, optimize_option
from cvqmpt_lab.cli.tables_command import show_tables, write_claims, write_report
from cvqmpt_lab.experiments.experiment import PROFILES, Experiment, parts_of, planners_of
from cvqmpt_lab.experiments.figures.code_update import UpdateSettings
from cvqmpt_lab.experiments.figures.paper import FIGURES, reproduce_figure, summary
from cvqmpt_lab.experiments.run import default_jobs, executor_for, run_experiment
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.paper_tables.committed import RESULTS
from cvqmpt_lab.paper_tables.measures import grouped
from cvqmpt_lab.paper_tables.rendering import render_directory
from cvqmpt_lab.paper_tables.table_engine import by_planner
from cvqmpt_lab.planning.planners import PLANNERS
from cvqmpt_lab.planning.warm_up import compile_kernels

ALL = "all"
FIXED_BY_PROFILE = (
    "problems",
    "seeds",
    "planners",
    "model",
    "reach",
    "cutoff",
    "cost",
    "iterations",
    "optimize",
)
"""Options whose values a profile of `reproduce all` fixes."""


def run(args: argparse.Namespace) -> None:
    """Do the runs that are missing in --out, then render its tables."""
    if args.suite == ALL:
        _reproduce_all(args)
        return
    refuse_given(args, ["profile"], f"belongs to {ALL}; name the amounts, such as --problems")
    if args.suite is None:
        raise InvalidInputError(
            f"name a suite ({', '.join(SUITES)}) or a folder of problem files, one of the two"
        )
    folder = Path(args.suite)
    if args.suite.endswith(".json"):
        raise InvalidInputError(
            f"{folder} is one problem; give the folder of problem files: cvqmpt reproduce "
            f"{folder.parent}"
        )
    named = args.suite in SUITES or not (folder.exists() or len(folder.parts) > 1)
    suite = suite_named(args.suite) if named else folder_suite(folder)
    experiment = Experiment(
        suite=suite.name if named else str(folder.resolve()),
        problems=tuple(suite.problems[: args.problems]),
        planners=planners_of(suite) if args.planners is None else args.planners,
        seeds=tuple(range(args.seeds or 1)),
        budget=budget(args, suite.cost),
        backend=args.backend,
        model=args.model,
        reach=args.reach,
        optimize=optimize_budget(args),
    )
    out, jobs = args.out or Path("runs") / suite.name, args.jobs or default_jobs()
    compile_kernels(compiling())
    bar = ProgressBar(suite.name, duration_line(experiment, jobs))
    with executor_for(experiment, jobs, args.dask) as executor:
        run_experiment(experiment, out, executor, own_command(), bar)
    show_tables(out)


def duration_line(experiment: Experiment, jobs: int) -> str:
    """Return how long a suite takes, by the times of its planners in committed rows, if any.

    The times do not contain certificates, and runs that are already done are counted.
    """
    suite = Path(experiment.suite).name
    path = RESULTS / suite / RUNS_FILE
    rows = read_rows(path) if path.is_file() else []
    groups = grouped((row.planner, row) for row in rows if row.planner in experiment.planners)
    limit, seconds = experiment.budget.seconds or math.inf, 0.0
    if suite_named(experiment.suite).of_tasks:  # each phase has the limit, perhaps several times
        limit = math.inf
    for planner in experiment.planners:
        own = groups.get(planner, [])
        spent = sum(min(row.t_total_s or 0.0, limit) for row in own)
        each = spent / len({row.run_key for row in own}) if own else limit
        if math.isinf(each):
            return f"{suite}: {len(experiment.runs)} runs on {jobs} processes"
        seconds += each * len(experiment.problems) * len(experiment.seeds) / jobs
    known = "about" if len(groups) == len(experiment.planners) else "at most about"
    shown = f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
    return (
        f"{suite}: {len(experiment.runs)} runs on {jobs} processes take {known} {shown} of planning"
    )


class OverallProgress:
    """Progress bars of consecutive experiments; their notes estimate the time left for all.

    A run of a task counts as 20 runs of problems: with --profile small they take 7 s and 0.3 s.
    """

    def __init__(self, experiments: Iterable[Experiment]) -> None:
        self._left = sum(len(each.runs) * self._weight(each) for each in experiments)
        self._made, self._began = 0, time.perf_counter()

    @staticmethod
    def _weight(experiment: Experiment) -> int:
        item = suite_named(experiment.suite).item(experiment.problems[0])
        return 20 if isinstance(item, Task) else 1

    def bar(
        self, name: str, experiment: Experiment, heading: str = ""
    ) -> Callable[[int, int, str], None]:
        """Return the bar of the next experiment; runs of earlier sessions take no time."""
        bar, weight, shown = ProgressBar(name, heading), self._weight(experiment), -1

        def show(done: int, total: int, note: str) -> None:
            nonlocal shown
            self._left -= weight * (done - max(shown, 0))
            self._made += weight * (done - shown) if shown >= 0 else 0
            shown = done
            elapsed = time.perf_counter() - self._began
            left = f"{elapsed / self._made * self._left:.0f} s left" if self._made else "estimating"
            bar(done, total, f"(all: {left}) {note}")

        return show


def _reproduce_all(args: argparse.Namespace) -> None:
    """Do the missing runs of all suites, render their tables and print the verdicts."""
    refuse_given(
        args,
        FIXED_BY_PROFILE,
        "does not go with 'all', whose amounts are fixed; --profile small runs less, or name one "
        "suite",
    )
    profile, out = args.profile or PROFILES[0], args.out or Path("runs/all")
    parts = parts_of(profile)
    jobs = args.jobs or default_jobs()
    compile_kernels(compiling())
    overall = OverallProgress(part.experiment for part in parts)
    for name, experiment, command in parts:
        folder = out / name
        command += ["--jobs", str(jobs), "--out", str(folder)]
        bar = overall.bar(name, experiment, duration_line(experiment, jobs))
        with executor_for(experiment, jobs) as executor:
            run_experiment(experiment, folder, executor, command, bar, profile)
        render_directory(folder)
    figure, count = "histogram", 30
    folder = out / figure
    if not (folder / PROVENANCE_FILE).is_file():
        log(f"{figure}: {count} problems of a figure take less than a minute")
        command = ["cvqmpt", "figure", figure, "--problems", str(count), "--out", str(folder)]
        reproduce_figure(figure, folder, command, range(count))
    write_claims(out)
    write_report(out)


OPTIONS: Options = {
    "suite": option(
        f"suite to reproduce: {', '.join(SUITES)}; {ALL}; or a folder of problem files (*.json), "
        "which becomes a suite with the folder's name",
        nargs="?",
        metavar="SUITE|DIR",
    ),
    **CODE,
    "--profile": option(
        f"amounts of {ALL}, on two cores: full (five hours), paper (Tables I and II with the "
        "paper's planners, 6 minutes) or small (five problems of each suite that judges the paper, "
        "3 minutes) (full)",
    ),
    "--problems": option(
        "only the first N problems or tasks (all)", type=positive_int, metavar="N"
    ),
    "--seeds": option("seeds 0 to K-1 (1)", type=positive_int, metavar="K"),
    "--planners": option(
        f"{', '.join(PLANNERS)}, an entry point, or package.module:planner (those of the suite)",
        type=planner_list,
        metavar="A,B",
    ),
    **WEIGHTS,
    **REACH,
    **BUDGET,
    **optimize_option(),
    ONE_OF: {
        "--jobs": option("processes (one per core)", type=positive_int, metavar="J"),
        "--dask": option(
            "address of a Dask scheduler for the runs: tcp://HOST:8786", metavar="ADDRESS"
        ),
    },
    "--out": option("folder of the results (runs/SUITE)", type=Path, metavar="DIR"),
}


def figure(args: argparse.Namespace) -> None:
    """Make the figure and print a summary."""
    unused = {"concept": ["--problems"], "histogram": ["--problem"]}.get(
        args.figure, ["--problem", "--problems", "--model", "--seed"]
    )
    options = {name: FIGURE[name] for name in unused}
    refuse_changed(args, options, f"does not go with {args.figure}; leave it out")
    if args.figure not in FIGURES:
        _profile(args)
        return
    if args.folder is not None:
        raise InvalidInputError(f"{args.figure} takes no FOLDER, got {args.folder}; leave it out")
    out = args.out or Path("runs") / args.figure
    settings = UpdateSettings(seed=args.seed)
    compile_kernels(compiling())
    problems = range(args.problems) if args.figure == "histogram" else (args.problem,)
    updates, written = reproduce_figure(
        args.figure, out, own_command(), problems, args.model, settings
    )
    print("\n".join(summary(updates)))
    for path in written:
        print(f"written {path}")


def _profile(args: argparse.Namespace) -> None:
    """Write a performance profile of the rows of a results directory."""
    kind = args.figure
    if args.folder is None:
        raise InvalidInputError(
            f"{kind} needs a results directory: cvqmpt figure {kind} runs/mine --out {kind}.pdf"
        )
    groups = by_planner(directory_rows(args.folder), ())
    out = writable_file(args.out or args.folder / f"{kind}.pdf")
    form = require_choice("format of --out", out.suffix[1:], ("pdf", "svg", "png"))
    from cvqmpt_lab.paper_tables import plots  # matplotlib takes a second to import

    made = plots.profile(groups, kind)
    drawn = made.axes[0].get_legend_handles_labels()[1]
    if not drawn:
        raise InvalidInputError(
            f"no solved run of {args.folder} has the values of {kind!r}; choose another figure"
        )
    write_bytes(out, plots.figure_bytes(made, form))
    left_out = [name for name in groups if name not in drawn]
    if left_out:
        print(f"left out, without solved runs that have these values: {', '.join(left_out)}")
    print(f"written {out}")


FIGURE: Options = {
    "figure": option(
        f"one of {', '.join(FIGURES)}, figures of the paper; or solved, work or length, "
        "performance profiles of the rows of a FOLDER",
        type=one_of("figure", (*FIGURES, "solved", "work", "length")),
    ),
    "folder": option(
        "for solved, work, length: a results directory", type=Path, nargs="?", metavar="FOLDER"
    ),
    "--problem": option(
        "for concept: index of the place task's problem (0)", type=int, default=0, metavar="I"
    ),
    "--problems": option(
        "for histogram: the first N problems (30)", type=positive_int, default=30, metavar="N"
    ),
    **WEIGHTS,
    **SEED,
    "--out": option(
        "folder of the results (runs/FIGURE); for solved, work, length: a pdf, svg or png file "
        "(FOLDER/FIGURE.pdf)",
        type=Path,
        metavar="OUT",
    ),
}
COMMANDS = {"reproduce": (run, OPTIONS), "figure": (figure, FIGURE)}
