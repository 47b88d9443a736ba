"""The table of constraints: a line for each kind and planner, ratios to uniform samples within the kind."""

import csv
import io

import pytest

from paper_tables.constraints_render import render_constraints
from tests.made_rows import a_failure, a_row

ROWS = [
    a_row(
        f"{8 * k + kind}/{kind + 1}-{name}",
        planner,
        suite="constraints",
        n_projections=work,
        n_state_checks=0,
    )
    for kind, name, half in ((0, "upright", 2), (2, "plane", 4))
    for k in range(6)
    for planner, work in (("birrt", 800), ("roadmap-cvq", 800 // half))
]


def test_ratios_are_taken_within_a_kind_and_over_all():
    failed = a_failure("48/1-upright", "roadmap-cvq", suite="constraints")
    made = render_constraints([*ROWS, failed], ())
    found = {(line["metric"], line["planner"]): line for line in csv.DictReader(io.StringIO(made.csv))}
    assert float(found["work_ratio_under_upright", "roadmap-cvq"]["value"]) == pytest.approx(0.5)
    assert float(found["work_ratio_under_plane", "roadmap-cvq"]["value"]) == pytest.approx(0.25)
    assert float(found["work_ratio_under_all kinds", "roadmap-cvq"]["value"]) == pytest.approx(8**-0.5)
    assert float(found["solved_under_upright", "roadmap-cvq"]["value"]) == pytest.approx(600 / 7)
    assert "| upright" in made.markdown and "timeout" in made.markdown and made.size == "13 problems, 2 kinds"
