"""`cvqmpt check-tables`: a tiny profile and the committed tables against what is committed."""

import argparse
import time
from pathlib import Path

from cli.options import ProgressBar, writable_file
from experiments import regression
from experiments.regression import EXPECTED, Expectations, compare, made_with, measure
from experiments.run import models_of
from paper_tables.committed import (
    RESULTS,
    committed_directories,
    differing_cells,
    require_checkout,
    untraceable,
)
from paper_tables.pages import committed_pages, stale_pages

EXAMPLES = ("cvqmpt check-tables", "cvqmpt check-tables --update")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to compare with, or to write it."""
    add = parser.add_argument
    add("--update", action="store_true", help="write the expectations instead of comparing")
    add(
        "--expected",
        type=Path,
        default=EXPECTED,
        metavar="F.json",
        help="expectations (the committed ones)",
    )
    add(
        "--results", type=Path, default=RESULTS, metavar="DIR", help="folder of results directories"
    )


def run(args: argparse.Namespace) -> int:
    """Compare, or update; exit code 1 when something differs."""
    if args.expected == EXPECTED or args.results == RESULTS:
        require_checkout("cvqmpt check-tables", "--expected F.json and --results DIR")
    expected = None
    if args.update:
        writable_file(args.expected)
    else:
        expected = Expectations.load(args.expected)
    began = time.perf_counter()
    bar = ProgressBar("check-tables")
    outcomes = measure(regression.CASES, bar)
    print(f"{len(outcomes)} runs in {time.perf_counter() - began:.0f} s")
    if expected is None:
        Expectations(made_with(), outcomes).save(args.expected)
        print(f"expectations written to {args.expected}")
        return 0
    mode, runs = compare(expected, outcomes, made_with())
    directories = committed_directories(args.results)
    found = {
        f"runs compared {mode}": runs,
        f"tables of {len(directories)} results directories rendered again": [
            line for folder in directories for line in differing_cells(folder)
        ],
        "commits and weights of their rows": [
            line for folder in directories for line in untraceable(folder, models_of)
        ],
        "the page of claims and the README's verdicts": (
            stale_pages(committed_pages()) if args.results == RESULTS else []
        ),
    }
    for what, lines in found.items():
        print(f"{what}: {f'{len(lines)} differences' if lines else 'no difference'}")
    for line in (line for lines in found.values() for line in lines):
        print(f"  differs: {line}")
    return 1 if any(found.values()) else 0
