"""The paper's claims: verdicts from rows, and the pages with them."""

import json
from collections import Counter

import pytest
from made_rows import a_results_folder
from refusals import refused

from cvqmpt_lab.results.provenance import PROVENANCE_FILE
from paper_tables.claims import evidence_below, judged_claims
from paper_tables.judging import Ruling
from paper_tables.pages import (
    README,
    committed_pages,
    decomposition_lines,
    evidence_of,
    page_text,
    report_html,
    stale_pages,
    with_part,
)


def by_title(results):
    return {item.claim.title: item for item in judged_claims(evidence_below(results))}


def test_the_committed_page_and_the_readme_are_what_the_command_writes_from_the_rows():
    assert stale_pages(committed_pages()) == []


def test_the_readme_counts_its_verdicts():
    text = README.read_text()
    part = text.partition("<!-- verdicts: written by cvqmpt claims -->")[2]
    rows = part.partition("<!-- end of verdicts -->")[0].strip().splitlines()[2:]
    count = Counter(row.strip("|").split("|")[-1].strip() for row in rows)
    counted = (
        f"of {len(rows)}, {count[Ruling.HOLDS]} hold, {count[Ruling.FAILS]} do not, "
        f"{count[Ruling.INCOMPARABLE]} cannot be compared, {count[Ruling.TOO_FEW]} are not decided"
    )
    assert counted in text


@pytest.mark.parametrize(
    ("ompl", "mpnet", "expected", "decided"),
    [
        (3.0, 3.0, Ruling.HOLDS, "ompl-projected"),
        (3.0, 1.0, Ruling.FAILS, "mpnet"),
        (1.0, 3.0, Ruling.FAILS, "ompl-projected"),
        (3.0, None, Ruling.TOO_FEW, "mpnet"),
    ],
)
def test_a_claim_holds_against_all_planners_named(tmp_path, ompl, mpnet, expected, decided):
    """A third of the time of all planners; of all but one; no problem that both solved."""
    others = {"atlas_rrt": 3.0, "tb_rrt": 3.0, "mpnet": mpnet, "birrt": 0.1}
    results = a_results_folder(tmp_path, opt_cvq_mpt=1.0, ompl_projected=ompl, **others)
    found = by_title(results)["twice as fast"]
    assert found.ruling is expected and found.deciding.baseline == decided
    assert "birrt" not in {verdict.baseline for verdict in found.verdicts}


def test_claims_without_rows_say_so_and_what_cannot_be_compared_too(tmp_path):
    found = by_title(a_results_folder(tmp_path, opt_cvq_mpt=1.0, ompl_projected=3.0))
    for title in ("tasks: plans −45 %", "lower G of codes"):
        assert found[title].ruling is Ruling.NO_ROWS
    assert found["fewer vertices"].ruling is found["complete"].ruling is Ruling.INCOMPARABLE
    assert found["paths 35 % shorter"].ruling is Ruling.FAILS, "all paths are 6 rad"


def test_every_step_is_against_the_one_before(tmp_path):
    """Times 3, 1, 4; in these rows work is proportional to time."""
    results = a_results_folder(tmp_path, ompl_projected=3.0, birrt=1.0, cvq_mpt=4.0)
    lines = decomposition_lines(evidence_below(results)["place-task"])
    assert [line[:4] for line in lines[1:]] == [
        ["our search", "birrt", "ompl-projected", "−66.7 [−66.7, −66.7]"],
        ["+ transformer", "cvq-mpt", "birrt", "+300 [300, 300]"],
    ]
    assert lines[1][5] == "0 [0, 0]", "paths are as long"


def test_a_small_profile_is_named(tmp_path):
    others = dict.fromkeys(("ompl_projected", "atlas_rrt", "tb_rrt", "mpnet"), 3.0)
    results = a_results_folder(tmp_path, opt_cvq_mpt=1.0, **others)
    path = next(results.glob(f"*/{PROVENANCE_FILE}"))
    record = json.loads(path.read_text())
    for profile, ruling in (("small", Ruling.TOO_FEW), ("full", Ruling.HOLDS)):
        command = ["cvqmpt", "reproduce", "all", "--profile", profile]
        path.write_text(json.dumps({**record, "command": command}))
        found = evidence_below(results)
        assert by_title(results)["twice as fast"].ruling is ruling
        pages = page_text(found, judged_claims(found), results), report_html(evidence_of(results))
        assert all(("--profile small" in page) is (profile == "small") for page in pages)


def test_a_readme_without_the_marks_of_the_summary_is_refused():
    refused("put them where", with_part, "a README without marks", "verdicts", "")
