"""Committed results: tables and pages equal a fresh rendering, and rows can be traced."""

import csv
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, in_checkout
from cvqmpt_lab.base.files import read_text
from cvqmpt_lab.benchmarks.results.provenance import (
    PROVENANCE_FILE,
    ProvenanceFile,
    digests_in,
    sessions,
)
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.paper_tables import pages
from cvqmpt_lab.paper_tables.answer import answer_parts, whole_word
from cvqmpt_lab.paper_tables.citation import citation
from cvqmpt_lab.paper_tables.claims import JudgedClaim
from cvqmpt_lab.paper_tables.evidence import Evidence
from cvqmpt_lab.paper_tables.quoted import Quoted, what_to_use
from cvqmpt_lab.paper_tables.rendering import rendered_tables
from cvqmpt_lab.paper_tables.statements import PUBLISHED
from cvqmpt_lab.paper_tables.table_engine import by_planner
from cvqmpt_lab.planning.by_name import declared

RESULTS = PUBLISHED.parent / "results"
README = PUBLISHED.parent.parent / "README.md"
DOCS = README.parent / "docs"


def require_checkout(command: str, instead: str) -> None:
    """Refuse a command that writes files of the checkout if there is none; instead: the cure."""
    if not in_checkout():
        raise InvalidInputError(
            f"{command} writes committed files, so it needs a checkout of the project, not the "
            f"installed package: run it in a clone or an unpacked copy of its sources, or {instead}"
        )


def committed_directories(results: Path = RESULTS) -> list[Path]:
    """Return the directories below `results` with rows or figures."""
    return sorted(path.parent for path in results.glob(f"*/{PROVENANCE_FILE}"))


def untraceable(directory: Path, models_of: Callable[[str], Collection[str]]) -> list[str]:
    """Return a line for each reason why rows cannot be traced to a commit and to weights.

    models_of: names of the models that a planner needs.
    """
    try:
        record = ProvenanceFile(directory).read()
        rows = read_rows(directory / RUNS_FILE) if (directory / RUNS_FILE).is_file() else []
    except CvqmptError as error:
        return [str(error)]
    needed = {model for planner in {row.planner for row in rows} for model in models_of(planner)}
    if "figure" in record["configuration"]:
        needed.add("vq_mpt")
    missing = sorted(needed - digests_in(record, "weights").keys())
    found = [
        f"{directory}: no digest of the weights {name!r} that it was made with" for name in missing
    ]
    for session in sessions(record):
        commit = session.get("git_commit")
        state = f"from {commit[:12]} with uncommitted changes" if commit else "without a commit"
        if commit is None or session.get("git_dirty"):
            found.append(f"{directory}: made {state}; make it again from a clean commit")
    return found


def differing_cells(directory: Path) -> list[str]:
    """Return a line for every table that is missing or differs: file, row, cell."""
    if not (directory / RUNS_FILE).is_file():
        return []
    try:
        texts = rendered_tables(directory).texts
    except CvqmptError as error:
        return [f"{directory}: cannot be rendered: {error}"]
    found = []
    for name, text in texts.items():
        path, cure = directory / name, f"cvqmpt table {directory}"
        if not path.is_file():
            found.append(f"{path}: missing; render it with: {cure}")
        elif where := _first_difference(path.read_bytes(), text, path.suffix):
            found.append(f"{path}, {where}; render it again with: {cure}")
    return found


def _first_difference(committed: bytes, fresh: str, suffix: str) -> str | None:
    """Return the first line and cell in which two texts differ by more than rounding."""
    old_lines = committed.decode("utf-8", "replace").split("\n")
    lines = zip_longest(old_lines, fresh.split("\n"), fillvalue="")
    for number, (old, new) in enumerate(lines, start=1):
        if old == new:
            continue
        cells = list(zip_longest(_cells(old, suffix), _cells(new, suffix), fillvalue=""))
        different = [k for k, (was, now) in enumerate(cells) if was != now]
        if not different:
            return f"line {number}: spaces differ"
        if suffix != ".csv" or not all(_close(*cells[k]) for k in different):
            row = next((now for _, now in cells if now), "")
            was, now = cells[different[0]]
            place = f"line {number}, row {row!r}, cell {different[0] + 1}"
            return f"{place}: committed {was!r}, rendered {now!r}"
    return None


def _close(was: str, now: str) -> bool:
    """Return whether numbers are equal up to rounding, which depends on the processor."""
    try:
        return math.isclose(float(was), float(now), rel_tol=1e-12)
    except ValueError:
        return False


def _cells(line: str, suffix: str) -> list[str]:
    """Return the cells of one line of a table."""
    delimiter = {".csv": ",", ".md": "|", ".tex": "&"}[suffix]
    quoting: Any = csv.QUOTE_MINIMAL if suffix == ".csv" else csv.QUOTE_NONE
    cells = next(csv.reader([line], delimiter=delimiter, quoting=quoting), [])
    return [cell.strip() for cell in cells]


# ---------------------------------------------------------------- pages and pictures of all of them


def with_part(text: str, part: str, table: str) -> str:
    """Replace the text between the marks of a part of a page; refuse a page without them."""
    begin, end = f"<!-- {part}: written by cvqmpt claims -->", f"<!-- end of {part} -->"
    found = re.compile(f"{re.escape(begin)}\n.*?{re.escape(end)}", re.DOTALL)
    if not found.search(text):
        raise InvalidInputError(
            f"the page has no lines {begin!r} and {end!r}: add both where the table must be"
        )
    return found.sub(lambda _: f"{begin}\n{table}{end}", text)


def planner_table() -> str:
    """Return the table of all declared planners but controls."""
    known = declared() | declared("unshipped")
    rows = [f"| `{name}` | {planner.description} |\n" for name, planner in known.items()]
    return "".join(["| planner | description |\n|---|---|\n", *rows])


def committed_pages(
    found: Mapping[str, Evidence], claims: Sequence[JudgedClaim]
) -> dict[Path, str]:
    """Return the page of claims and, in a checkout, README, docs and CITATION.cff, by path."""
    texts = {pages.PAGE: pages.page_text(found, claims, pages.PAGE.parent)}
    if in_checkout():
        quoted = Quoted(found)
        texts[DOCS / "results.md"] = pages.rendered("results.md.j2", quoted=quoted)
        parts_of_answer = answer_parts(claims)
        texts[DOCS / "paper.md"] = pages.rendered(
            "paper.md.j2",
            quoted=quoted,
            answer=parts_of_answer,
            whole=whole_word(parts_of_answer),
            summary=pages.summary_lines(claims),
            claims=claims,
        )
        parts = {
            README: {
                "answer": pages.answer_text(found, claims, "docs/", "paper_tables/README.md"),
                "planners": pages.rendered("readme.md.j2", quoted=quoted),
                "table": pages.rendered("peers.md.j2", quoted=quoted),
            },
            DOCS / "method.md": {"planners": planner_table()},
        }
        for path, written in parts.items():
            texts[path] = read_text(path)
            for part, text in written.items():
                texts[path] = with_part(texts[path], part, text)
        texts[README.parent / "CITATION.cff"] = citation(README.parent)
    return texts


def committed_pictures(
    found: Mapping[str, Evidence], claims: Sequence[JudgedClaim]
) -> dict[Path, bytes]:
    """Return pictures of committed rows: what to use, comparisons of claims, cost of a check."""
    from cvqmpt_lab.paper_tables import plots  # matplotlib takes a second to import

    timed = next(item.claim for item in claims if item.claim.answers == "Time")
    drawn = {
        "use.png": plots.advice(what_to_use(Quoted(found))),
        "forest.png": plots.forest(claims),
        "curves.png": plots.curves(by_planner(found[pages.TABLE_I].rows, ()), timed.limit),
        "cost.png": plots.cost_curves(by_planner(found["place-task-seconds"].rows, ())),
    }
    return {DOCS / name: picture for name, picture in drawn.items()}


def stale_pages(texts: Mapping[Path, str]) -> list[str]:
    """Return a line for each page that differs from its rendering."""
    return [
        f"{path} differs from a rendering of the rows; write it with: cvqmpt claims --write"
        for path, text in texts.items()
        if not path.is_file() or read_text(path) != text
    ]
