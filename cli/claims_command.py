"""`cvqmpt claims`: judge every claim of the paper by rows, and write the page that says so."""

import argparse
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import write_text
from paper_tables.claims import Evidence, banner, evidence_below, judged_claims
from paper_tables.committed import RESULTS, committed_directories, require_checkout
from paper_tables.pages import (
    PAGE,
    committed_pages,
    decomposition_lines,
    page_text,
    summary_lines,
)
from paper_tables.writers import text_lines

PAGE_NAME = "claims.md"
EXAMPLES = ("cvqmpt claims", "cvqmpt claims runs/all --write")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Whose rows."""
    where = (
        f"folder of results directories, where {PAGE_NAME} goes (the committed ones, with "
        f"page and README)"
    )
    parser.add_argument("results", type=Path, nargs="?", metavar="DIR", help=where)
    parser.add_argument(
        "--write", action="store_true", help="write the page; without, verdicts are printed"
    )


def run(args: argparse.Namespace) -> int:
    """Judge, say the verdicts, and write the page when asked to."""
    if args.results is None:
        require_checkout("cvqmpt claims", "a folder of results directories")
    print("\n".join(verdict_lines(args.results or RESULTS)))
    page = PAGE if args.results is None else args.results / PAGE_NAME
    if not args.write:
        print(f"nothing written; --write writes {page}")
        return 0
    pages = committed_pages() if args.results is None else pages_of(args.results)
    for path, text in pages.items():
        write_text(path, text)
    print(f"written {page}")
    return 0


def pages_of(results: Path) -> dict[Path, str]:
    """The page of a folder of results directories."""
    found = _found(results)
    return {results / PAGE_NAME: page_text(found, judged_claims(found), results)}


def verdict_lines(results: Path) -> list[str]:
    """A line a claim that rows judge, and what each step brings."""
    found = _found(results)
    claims = judged_claims(found)
    judged = [item for item in claims if item.verdicts]
    lines = [banner(found), *(text_lines(summary_lines(judged)) if judged else [])]
    if len(judged) < len(claims):
        lines.append(f"no rows yet for {len(claims) - len(judged)} of {len(claims)} claims")
    steps = decomposition_lines(found["place-task"]) if "place-task" in found else []
    lines += ["", *text_lines(steps)] if len(steps) > 1 else []
    return lines if lines[0] else lines[1:]


def _found(results: Path) -> dict[str, Evidence]:
    if not committed_directories(results):
        raise InvalidInputError(
            f"{results} holds no results directories; name a folder that does: runs/all"
        )
    return evidence_below(results)
