"""The report: one html file of verdicts, tables, plots, rows and provenance;
the template escapes text from rows.
"""

import base64
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.provenance import digests_in, sessions
from cvqmpt_lab.results.row import ResultRow
from paper_tables.claims import Evidence, banner, evidence_below, judged_claims, read_evidence
from paper_tables.claims_page import TERMS, summary_lines, wall_clock
from paper_tables.judging import Ruling
from paper_tables.measures import REFERENCE, VALUES, Rows, work
from paper_tables.paper_numbers import read_published
from paper_tables.report import plots
from paper_tables.suite_tables import SuiteTable, table_of
from paper_tables.table_engine import by_planner
from paper_tables.writers import Sections

TEMPLATE = "page.html.j2"
STYLES = {Ruling.HOLDS: "holds", Ruling.TOO_FEW: "part", Ruling.FAILS: "not"}  # of verdicts
PICTURES = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml"}
SHOWN_FACTS = (  # of a session
    *(
        "command",
        "git_commit",
        "git_dirty",
        "date_utc",
        "cpu_model",
        "cpu_count",
        "platform",
        "python",
    ),
    *("weights", "versions"),
)
ROW_COLUMNS = ("problem", "seed", "solved", "time [s]", "work", "vertices", "length [rad]", "what")
MOST_BYTES = 2_000_000  # of a picture that is taken into the page


class PathPage(NamedTuple):
    """One path of a results directory to turn: what it is of, and a page of its own."""

    title: str
    html: str


def report_html(
    found: Mapping[str, Evidence],
    report: Callable[[int, int], None] = lambda done, total: None,
    paths: Mapping[str, PathPage] | None = None,
) -> str:
    """One self-contained file about results directories, see `evidence_of`.

    report: is called with how many of them are done. paths: by the name of the directory that each
        is of.
    """
    claims = [item for item in judged_claims(found) if item.verdicts]
    sections: list[dict[str, Any]] = []
    for evidence in found.values():
        report(len(sections), len(found))
        sections.append({**section_of(evidence), "path": (paths or {}).get(evidence.folder.name)})
    report(len(found), len(found))
    environment = Environment(
        loader=PackageLoader("paper_tables", "report"), autoescape=True, undefined=StrictUndefined
    )
    data = [{key: section[key] for key in ("name", "rows", "again")} for section in sections]
    return environment.get_template(TEMPLATE).render(
        title="CVQ-MPT, reproduced",
        banner=banner(found),
        claims=summary_lines(claims) if claims else [],
        styles=STYLES,
        terms=TERMS,
        sections=sections,
        data={"columns": ROW_COLUMNS, "sections": data},  # what the page's script reads
    )


def evidence_of(directory: Path) -> dict[str, Evidence]:
    """A results directory by its suite, or those below a folder by their names, the place task
    first.
    """
    single = read_evidence(directory)
    if single is not None:
        return {single.rows[0].suite if single.rows else directory.name: single}
    found = evidence_below(directory)
    if not found:
        raise InvalidInputError(
            f"{directory} is no results directory and holds none; make one with: "
            f"cvqmpt reproduce place-task --out {directory}"
        )
    return dict(sorted(found.items(), key=lambda item: (item[0] != "place-task", item[0])))


def section_of(evidence: Evidence) -> dict[str, Any]:
    """Everything that the page says of a results directory."""
    rows, name = evidence.rows, evidence.folder.name
    suite = rows[0].suite if rows else name
    table = table_of(suite) if rows else SuiteTable(f"Figure {name}")
    published = read_published(*table.paper) if table.paper else ()
    groups = by_planner(rows, published)
    return {
        "name": name,
        "title": table.title if name == suite else f"{name}: {table.title}",
        "blocks": _blocks(table.render(rows, published).sections) if rows else [],
        "planners": list(groups),
        "plots": _plots(groups) if rows else {},
        "rows": {planner: [_row(row) for row in own] for planner, own in groups.items()},
        "again": _again(suite, evidence),
        "provenance": _provenance(evidence),
        "pictures": _pictures(evidence.folder),
    }


def _again(suite: str, evidence: Evidence) -> str:
    """The command that repeats a row."""
    filed = digests_in(evidence.record, "problem_files")
    problem = "--problem-file FILE" if filed else f"{suite} --problem PROBLEM"
    return f"cvqmpt plan {problem} --planner PLANNER --seed SEED --picture plan.png"


def _blocks(sections: Sections) -> list[dict[str, Any]]:
    """Titles with tables (the header first) and texts."""
    found = []
    for title, part in sections.items():
        texts = [text for text in part if isinstance(text, str)]
        lines = [line for line in part if not isinstance(line, str)]
        if len(lines) == 1:  # a header alone
            texts, lines = ["None."], []
        if texts or lines:
            found.append({"title": title, "texts": texts, "lines": lines})
    return found


def _plots(groups: Mapping[str, Rows]) -> dict[str, str]:
    length = VALUES["path_length"]
    drawn = {
        "Solved against time": plots.solved_curve(groups),
        "Path length, solved runs": plots.distribution(groups, length, "length [rad]", log=False),
        "Work, solved runs": plots.distribution(groups, work, "projections and state checks"),
        "Where time goes": plots.stage_times(groups),
    }
    if REFERENCE in groups and len(groups) > 1:
        for name, value, label in (("Work", work, "work"), ("Length", length, "length [rad]")):
            title = f"{name}, problem by problem, against {REFERENCE}"
            drawn[title] = plots.scatter(groups, REFERENCE, value, label)
    return drawn


def _row(row: ResultRow) -> list[object]:
    """In `ROW_COLUMNS`."""
    what = (
        row.fallback or row.detail or "" if row.solved else f"{row.fail_reason}: {row.detail or ''}"
    )
    time, effort, length = (
        None if number is None else round(number, 4)
        for number in (row.t_total_s, work(row), row.path_length_rad)
    )
    return [row.problem, row.seed, row.solved, time, effort, row.vertices, length, what]


def _provenance(evidence: Evidence) -> dict[str, str]:
    """Every fact of every session."""
    facts: dict[str, list[str]] = {}
    for session in sessions(evidence.record):
        for name, fact in session.items():
            if name in SHOWN_FACTS and fact:
                facts.setdefault(name.replace("_", " "), []).append(_fact(fact))
    joined = {name: " and ".join(dict.fromkeys(found)) for name, found in facts.items()}
    return {**joined, "time": wall_clock(evidence)}


def _fact(fact: object) -> str:
    if isinstance(fact, Mapping):
        return ", ".join(f"{name} {value}" for name, value in sorted(fact.items()) if value)
    return shlex.join(fact) if isinstance(fact, list) else str(fact)


def _pictures(folder: Path) -> dict[str, str]:
    """Data addresses of pictures beside the rows, by file name;
    of one that is there in two forms, the first.
    """
    found: dict[str, str] = {}
    for kind, mime in PICTURES.items():
        for path in sorted(folder.glob(f"*{kind}")):
            known = path.stem in {Path(name).stem for name in found}
            if not known and path.stat().st_size < MOST_BYTES:
                data = base64.b64encode(path.read_bytes()).decode("ascii")
                found[path.name] = f"data:{mime};base64,{data}"
    return found
