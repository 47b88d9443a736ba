"""`cvqmpt report`: one self-contained html file about results."""

import argparse
from pathlib import Path

from cli.options import ProgressBar, writable_file
from cvqmpt_lab.files import write_text

EXAMPLES = (
    "cvqmpt report runs/place-task-small",
    "cvqmpt report paper_tables/results --out report.html",
)
NAME = "report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Of what, and where to."""
    of = "a results directory, or a folder that holds several"
    parser.add_argument("directory", type=Path, metavar="DIR", help=of)
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help=f"the file that is written (DIR/{NAME})"
    )


def run(args: argparse.Namespace) -> int:
    """Write it."""
    print(f"report, for a browser: {write_report(args.directory, args.out)}")
    return 0


def write_report(directory: Path, out: Path | None = None) -> Path:
    """Write the report of results, into their folder unless `out` is given, and return its path."""
    from experiments.stored_path import first_path
    from paper_tables.pages import evidence_of, report_html

    found = evidence_of(directory)
    text = report_html(found, ProgressBar("report"), first_path(found))
    out = writable_file(out or directory / NAME)
    write_text(out, text)
    return out
