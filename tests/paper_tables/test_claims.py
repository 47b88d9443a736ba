"""Whether the paper holds: verdicts from rows, and the pages that tell them."""

import pytest
from made_rows import a_results_folder

from cvqmpt_lab.errors import InvalidInputError
from paper_tables.claims import evidence_below, judged_claims
from paper_tables.claims_page import (
    committed_pages,
    stale_pages,
    with_summary,
)

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


def test_a_readme_without_the_marks_of_the_summary_is_refused():
    with pytest.raises(InvalidInputError, match="put them where"):
        with_summary("a README without the marks of the summary", "")
