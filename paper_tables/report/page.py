"""The report's html, from sections by a template; whatever comes from rows is escaped there."""

from collections.abc import Callable, Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from cvqmpt_lab.errors import InvalidInputError
from paper_tables.claims import Evidence, evidence_below, judged_claims, read_evidence
from paper_tables.claims_page import TERMS, box_lines
from paper_tables.report.sections import ROW_COLUMNS, Section, section_of

TEMPLATE = "page.html.j2"
STYLES = {"holds": "holds", "holds in part": "part", "does not hold here": "not"}
"""Of verdicts."""


def report_html(directory: Path, report: Callable[[int, int], None] = lambda done, total: None) -> str:
    """One self-contained file about a results directory, or all that are below a folder.

    report: is told how many of them are done.

    Raises
    ------
    InvalidInputError
        When there are none, or they cannot be read.
    """
    found = evidence_of(Path(directory))
    claims = [item for item in judged_claims(found) if item.verdicts or not item.claim.judges]
    sections: list[Section] = []
    for evidence in found.values():
        report(len(sections), len(found))
        sections.append(section_of(evidence))
    report(len(found), len(found))
    environment = Environment(
        loader=PackageLoader("paper_tables", "report"), autoescape=True, undefined=StrictUndefined
    )
    return environment.get_template(TEMPLATE).render(
        title="CVQ-MPT, reproduced",
        claims=box_lines(claims) if any(item.verdicts for item in claims) else [],
        styles=STYLES,
        terms=TERMS,
        sections=sections,
        data=_data(sections),
    )


def evidence_of(directory: Path) -> dict[str, Evidence]:
    """A results directory by its suite, or those below a folder by their names, the place task first."""
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


def _data(sections: Sequence[Section]) -> dict[str, object]:
    """What the page's script reads."""
    return {
        "columns": ROW_COLUMNS,
        "sections": [
            {
                "name": section.name,
                "rows": section.rows,
                "again": section.again,
                "repricing": section.repricing
                and {k: v for k, v in section.repricing.items() if k != "plot"},
            }
            for section in sections
        ],
    }
