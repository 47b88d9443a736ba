"""`cvqmpt table`: render the tables of a results directory."""

import argparse
from pathlib import Path

from paper_tables.render import render_directory

EXAMPLES = ("cvqmpt table runs/place-task", "cvqmpt table paper_tables/results/place-task")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The directory."""
    parser.add_argument(
        "directory", type=Path, metavar="DIR", help="a directory with runs.csv and provenance.json"
    )


def run(args: argparse.Namespace) -> int:
    """Render the tables and print the short one."""
    show_tables(args.directory)
    return 0


def show_tables(directory: Path) -> None:
    """Render a directory, print a line a planner, and say where the rest lies."""
    written = render_directory(directory)
    print("\n".join(written.brief))
    print(f"intervals, work, failures and notes: {written.paths[0]}")
    print(f"also: {', '.join(path.name for path in (*written.paths[1:], directory / 'runs.csv'))}")
