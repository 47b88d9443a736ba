"""`cvqmpt compare`: what changed between two runs of the same problems."""

import argparse
from pathlib import Path

from paper_tables.compare_runs import clear, compared, comparison_lines
from paper_tables.suite_tables import directory_rows
from paper_tables.writers import text_lines

EXAMPLES = ("cvqmpt compare runs/before runs/after",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Two results directories."""
    parser.add_argument("before", type=Path, metavar="A", help="a results directory")
    parser.add_argument(
        "after",
        type=Path,
        metavar="B",
        help="another, of the same suite; the runs that both have are compared",
    )


def run(args: argparse.Namespace) -> int:
    """Pair runs, compare them and print what changed."""
    found = compared(directory_rows(args.before), directory_rows(args.after))
    print(
        f"from A, {args.before}, to B, {args.after}; runs of both; changes over those that both "
        f"solved, 95 % intervals"
    )
    print("\n".join(text_lines(comparison_lines(found))))
    print("\n".join(clear(found) or ["no clear change"]))
    return 0
