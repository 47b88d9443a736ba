"""Whether the paper holds: verdicts from rows, and the pages that tell them."""

import json

import pytest
from made_rows import a_results_folder

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.results.provenance import PROVENANCE_FILE
from cvqmpt_lab.results.statistics import Interval
from paper_tables.claims import evidence_below, judged_claims
from paper_tables.claims_page import committed_pages, page_text, stale_pages, with_summary
from paper_tables.judging import Ruling, ruling
from paper_tables.report.page import evidence_of, report_html

FASTER, SHORTER, SOLVES, PLANNING, *_, COMPLETE = range(9)


def test_the_committed_page_and_the_readme_are_what_the_command_writes_from_the_rows():
    assert stale_pages(committed_pages()) == []


@pytest.mark.parametrize(("uniform", "verdict"), [(3.0, "holds"), (1.0, "holds in part"), (None, "holds")])
def test_a_claim_holds_where_all_its_statements_stand(tmp_path, uniform, verdict):
    results = a_results_folder(tmp_path, cvq_mpt=1.0, opt_cvq_mpt=1.0, ompl_projected=3.0, birrt=uniform)
    if uniform is None:  # nothing that both solved: not judged, so it does not stand
        verdict = "holds in part"
    assert judged_claims(evidence_below(results))[FASTER].verdict == verdict


def test_a_claim_does_not_hold_where_none_stands_and_is_not_judged_without_rows(tmp_path):
    results = a_results_folder(tmp_path, cvq_mpt=3.0, opt_cvq_mpt=None, ompl_projected=1.0, birrt=1.0)
    claims = judged_claims(evidence_below(results))
    assert claims[FASTER].verdict == claims[SHORTER].verdict == "does not hold here"
    assert claims[SOLVES].verdict == "holds in part"  # one planner of two
    assert claims[PLANNING].verdict == "no rows yet" and claims[COMPLETE].verdict == "cannot be tested here"


def test_wide_intervals_are_too_few_runs_and_the_profile_is_named(tmp_path):
    """Nine runs, 17.6 to 50.7 % shorter, made "35 to 40 % shorter" hold."""
    assert ruling(Interval(0.36, 0.176, 0.507, 9), 0.35) is Ruling.TOO_FEW
    assert ruling(Interval(0.36, 0.30, 0.42, 300), 0.35) is Ruling.COMPATIBLE
    assert ruling(Interval(0.5, 0.4, 0.7, 9), 0.35) is Ruling.CONFIRMED and not Ruling.TOO_FEW.holds
    assert ruling(Interval(0.0, -0.3, 0.3, 9), 0.35) is Ruling.TOO_FEW
    results = a_results_folder(tmp_path, cvq_mpt=1.0, opt_cvq_mpt=1.0, birrt=3.0)
    path = next(results.glob(f"*/{PROVENANCE_FILE}"))
    record = json.loads(path.read_text())
    for profile, warned in (("small", True), ("hour", False)):
        command = ["cvqmpt", "reproduce", "all", "--profile", profile]
        path.write_text(json.dumps({**record, "command": command}))
        found = evidence_below(results)
        assert ("--profile small" in page_text(found, judged_claims(found), results)) is warned
        assert ("--profile small" in report_html(evidence_of(results))) is warned


def test_a_readme_without_the_marks_of_the_summary_is_refused():
    with pytest.raises(InvalidInputError, match="put them where"):
        with_summary("a README without the marks of the summary", "")
