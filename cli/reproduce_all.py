"""`cvqmpt reproduce all`: every suite, the controls and the histogram, then tables, verdicts and the report."""

import argparse
import sys
from pathlib import Path

from cli.claims_command import PAGE_NAME, pages_of, verdict_lines
from cli.options import ProgressBar
from cli.report_command import write_report
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.results.provenance import PROVENANCE_FILE
from cvqmpt_lab.warm_up import compile_kernels
from experiments.everything import Part, parts
from experiments.figures.run_figure import FigureRequest, reproduce_figure
from experiments.run import default_jobs, executor_for, run_experiment
from paper_tables.suite_tables import render_directory

OUT = Path("runs/all")
HISTOGRAM = ("histogram", 7)
"""The figure, and the problem that it is of."""
FIXED = ("problems", "seeds", "planners", "model", "cutoff", "iterations", "optimize")


def reproduce_all(args: argparse.Namespace) -> int:
    """Run what is missing, render everything and print the verdicts."""
    given = [f"--{name}" for name in FIXED if getattr(args, name) is not None]
    if given:
        raise InvalidInputError(
            f"{given[0]} does not go with 'all', whose amounts are fixed; --profile hour or small runs "
            "less, or name one suite"
        )
    chosen, out, jobs = parts(args.profile), args.out or OUT, args.jobs or default_jobs()
    compile_kernels(lambda text: print(text, file=sys.stderr, flush=True))
    for part in chosen:
        _run(part, out / part.folder, jobs)
    _figure(out / HISTOGRAM[0])
    for path, text in pages_of(out).items():
        write_text(path, text)
    print("\n".join(verdict_lines(out)))
    print(f"every claim, its numbers and commands: {out / PAGE_NAME}")
    print(f"report, for a browser: {write_report(out)}")
    return 0


def _run(part: Part, folder: Path, jobs: int) -> None:
    command = [*part.command, "--jobs", str(jobs), "--out", str(folder)]
    with executor_for(part.experiment, jobs) as executor:
        run_experiment(part.experiment, folder, executor, command, ProgressBar(part.folder))
    render_directory(folder)


def _figure(folder: Path) -> None:
    if (folder / PROVENANCE_FILE).is_file():
        return
    figure, problem = HISTOGRAM
    command = ["cvqmpt", "figure", figure, "--problem", str(problem), "--out", str(folder)]
    reproduce_figure(FigureRequest(figure=figure, out=folder, problem=problem), command)
