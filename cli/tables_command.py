"""`cvqmpt table`, `report`, `compare`, `claims` and `check-tables`: evaluate finished rows."""

import argparse
import time
from pathlib import Path
from typing import Any

from cli.options import FLAG, REPEATED, Options, ProgressBar, option, writable_file
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import write_text
from experiments import regression
from experiments.regression import EXPECTED
from paper_tables import pages
from paper_tables.claims import Evidence, banner, evidence_below, judged_claims
from paper_tables.committed import (
    RESULTS,
    committed_directories,
    differing_cells,
    require_checkout,
    untraceable,
)
from paper_tables.suites import render_directory
from paper_tables.writers import text_lines


def table(args: argparse.Namespace) -> int:
    """Render the tables of a results directory and print the short one."""
    show_tables(args.directory)
    return 0


def show_tables(directory: Path) -> None:
    """Render a directory, print a line for each planner, and where the files are."""
    written = render_directory(directory)
    title, *lines = written.brief
    print("\n".join([f"{title}; all numbers: {directory / 'table.md'}", *lines]))


def report(args: argparse.Namespace) -> int:
    """Write one self-contained html file about results."""
    print(f"report, for a browser: {write_report(args.directory, args.out)}")
    return 0


def write_report(directory: Path, out: Path | None = None) -> Path:
    """Write the report of results, into their folder unless `out` is given, and return its path."""
    from experiments.replay import first_path

    found = pages.evidence_of(directory)
    text = pages.report_html(found, ProgressBar("report"), first_path(found))
    out = writable_file(out or directory / "report.html")
    write_text(out, text)
    return out


def compare(args: argparse.Namespace) -> int:
    """Pair two runs of the same problems and print what changed."""
    from paper_tables.compare_runs import clear, compared, comparison_lines
    from paper_tables.suites import directory_rows

    found = compared(directory_rows(args.before), directory_rows(args.after))
    print(
        f"from A, {args.before}, to B, {args.after}; runs of both; changes over those that both "
        "solved, 95 % intervals"
    )
    print("\n".join(text_lines(comparison_lines(found))))
    print("\n".join(clear(found) or ["no clear change"]))
    broken = [line for rule in args.fail_if for line in rule.broken(found)]
    for line in broken:
        print(f"fails: {line}")
    return 1 if broken else 0


def _rule(text: str) -> Any:
    """The type of --fail-if."""
    from paper_tables.compare_runs import Rule

    return Rule.read(text)


def claims(args: argparse.Namespace) -> int:
    """Judge every claim of the paper, print the verdicts, and write the page if asked to."""
    if args.results is None:
        require_checkout("cvqmpt claims", "a folder of results directories")
    print("\n".join(verdict_lines(args.results or RESULTS)))
    page = pages.PAGE if args.results is None else args.results / "claims.md"
    if not args.write:
        print(f"nothing written; --write writes {page}")
        return 0
    texts = pages.committed_pages() if args.results is None else {page: page_of(args.results)}
    for path, text in texts.items():
        write_text(path, text)
    print(f"written {page}")
    return 0


def page_of(results: Path) -> str:
    """The page of claims of a folder of results directories."""
    found = _found(results)
    return pages.page_text(found, judged_claims(found), results)


def verdict_lines(results: Path) -> list[str]:
    """A line for each claim that rows judge, and the effect of each step."""
    found = _found(results)
    every = judged_claims(found)
    judged = [item for item in every if item.verdicts]
    lines = [banner(found), *(text_lines(pages.summary_lines(judged)) if judged else [])]
    if len(judged) < len(every):
        lines.append(f"no rows yet for {len(every) - len(judged)} of {len(every)} claims")
    steps = pages.decomposition_lines(found["place-task"]) if "place-task" in found else []
    lines += ["", *text_lines(steps)] if len(steps) > 1 else []
    return lines if lines[0] else lines[1:]


def _found(results: Path) -> dict[str, Evidence]:
    if not committed_directories(results):
        raise InvalidInputError(
            f"{results} holds no results directories; name a folder that does: runs/all"
        )
    return evidence_below(results)


def check_tables(args: argparse.Namespace) -> int:
    """Re-run a tiny profile; compare it and all tables with those committed; 1 if they differ."""
    from experiments.experiment import models_of

    if args.expected == EXPECTED or args.results == RESULTS:
        require_checkout("cvqmpt check-tables", "--expected F.json and --results DIR")
    expected = None
    if args.update:
        writable_file(args.expected)
    else:
        expected = regression.Expectations.load(args.expected)
    began = time.perf_counter()
    outcomes = regression.measure(regression.CASES, ProgressBar("check-tables"))
    print(f"{len(outcomes)} runs in {time.perf_counter() - began:.0f} s")
    made_with = regression.made_with()
    if expected is None:
        regression.Expectations(made_with, outcomes).save(args.expected)
        print(f"expectations written to {args.expected}")
        return 0
    mode, runs = regression.compare(expected, outcomes, made_with)
    directories = committed_directories(args.results)
    stale = pages.stale_pages(pages.committed_pages()) if args.results == RESULTS else []
    found = {
        f"runs compared {mode}": runs,
        f"tables of {len(directories)} results directories rendered again": [
            line for folder in directories for line in differing_cells(folder)
        ],
        "commits and weights of their rows": [
            line for folder in directories for line in untraceable(folder, models_of)
        ],
        "the page of claims and the README's verdicts": stale,
    }
    for what, lines in found.items():
        print(f"{what}: {f'{len(lines)} differences' if lines else 'no difference'}")
    for line in (line for lines in found.values() for line in lines):
        print(f"  differs: {line}")
    return 1 if any(found.values()) else 0


TABLE: Options = {
    "directory": option("a directory with runs.csv and provenance.json", type=Path, metavar="DIR"),
}
REPORT: Options = {
    "directory": option(
        "a results directory, or a folder that holds several", type=Path, metavar="DIR"
    ),
    "--out": option("the file that is written (DIR/report.html)", type=Path, metavar="FILE"),
}
COMPARE: Options = {
    "before": option("a results directory", type=Path, metavar="A"),
    "after": option(
        "another, of the same suite; the runs that both have are compared", type=Path, metavar="B"
    ),
    "--fail-if": option(
        "exit with 1 if a planner's number is so: COLUMN OP NUMBER, where COLUMN is the ratio B/A "
        "of time, work, checks, projections or length, or solved, B - A in points; OP is <, <=, "
        "> or >=; repeatable",
        type=_rule,
        metavar="RULE",
        **REPEATED,
    ),
}
CLAIMS: Options = {
    "results": option(
        "folder of results directories, where claims.md goes (the committed ones, with page and "
        "README)",
        type=Path,
        nargs="?",
        metavar="DIR",
    ),
    "--write": option("write the page; without, verdicts are printed", **FLAG),
}
CHECK_TABLES: Options = {
    "--update": option("write the expectations instead of comparing", **FLAG),
    "--expected": option(
        "expectations (the committed ones)", type=Path, default=EXPECTED, metavar="F.json"
    ),
    "--results": option("folder of results directories", type=Path, default=RESULTS, metavar="DIR"),
}
COMMANDS = {
    "table": (table, TABLE),
    "report": (report, REPORT),
    "compare": (compare, COMPARE),
    "claims": (claims, CLAIMS),
    "check-tables": (check_tables, CHECK_TABLES),
}
