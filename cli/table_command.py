"""`cvqmpt table`: render the tables of a results directory."""

import argparse
from pathlib import Path

from cli.options import writable_file
from paper_tables.ompl_log import write_ompl_log
from paper_tables.suite_tables import render_directory

EXAMPLES = (
    "cvqmpt table runs/place-task",
    "cvqmpt table paper_tables/results/place-task",
    "cvqmpt table runs/place-task --ompl-log place.log && ompl_benchmark_statistics place.log -d "
    "place.db",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The directory."""
    kept = "a directory with runs.csv and provenance.json"
    parser.add_argument("directory", type=Path, metavar="DIR", help=kept)
    log = "write OMPL's benchmark log instead, for ompl_benchmark_statistics and Planner Arena"
    parser.add_argument("--ompl-log", type=Path, metavar="FILE", help=log)


def run(args: argparse.Namespace) -> int:
    """Render the tables and print the short one, or write the log."""
    if args.ompl_log:
        write_ompl_log(args.directory, writable_file(args.ompl_log))
        print(
            f"{args.ompl_log} written; read it with: ompl_benchmark_statistics {args.ompl_log} -d "
            f"FILE.db"
        )
    else:
        show_tables(args.directory)
    return 0


def show_tables(directory: Path) -> None:
    """Render a directory, print a line a planner, and say where the rest lies."""
    written = render_directory(directory)
    title, *lines = written.brief
    print("\n".join([f"{title}; all numbers: {written.paths[0]}", *lines]))
