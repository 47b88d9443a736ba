"""A path of a finished run as a page to turn, made of its row and its stored states."""

from collections.abc import Mapping

from cvqmpt_lab.benchmarks.suite import SUITES
from cvqmpt_lab.errors import CvqmptError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.row import ResultRow
from cvqmpt_lab.results.store import StoredPaths
from paper_tables.claims import Evidence


def first_path(found: Mapping[str, Evidence]) -> dict[str, dict[str, str]]:
    """The first certified path of a suite's problem, by its results directory's name; or none."""
    for evidence in found.values():
        kept = StoredPaths(evidence.folder)
        for row in evidence.rows:
            if (
                row.solved
                and row.path_sha256 in kept
                and row.problem.isdecimal()
                and row.suite in SUITES
            ):
                page = _page(row, kept)
                return {} if page is None else {evidence.folder.name: page}
    return {}


def _page(row: ResultRow, kept: StoredPaths) -> dict[str, str] | None:
    """Problem and path of a row; None if the suite has other problems now."""
    # rendering takes a quarter of a second to import
    from cvqmpt_lab.show.web_page import path_html

    suite = SUITES[row.suite]
    try:
        problem = suite.solvable(int(row.problem))
    except CvqmptError:
        return None
    if not isinstance(problem, PlanningProblem):
        return None
    assert row.path_sha256 is not None
    title = f"problem {row.problem}, {row.planner}, seed {row.seed}"
    html = path_html(
        problem, kept[row.path_sha256], f"certified path of {row.planner}", suite.carried
    )
    return {"title": title, "html": html}
