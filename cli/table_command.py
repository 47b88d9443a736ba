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
    """Render and print the markdown table."""
    written = render_directory(args.directory)
    for path in written:
        if path.suffix == ".md":
            print(path.read_text())
    for path in written:
        print(f"wrote {path}")
    return 0
