"""The factorial table: contrasts pair products that differ in one choice; a problem counts once."""

import csv
import io
from dataclasses import asdict
from itertools import product

import pytest
from made_rows import a_failure, a_row

from cvqmpt_lab.vqmpt.sampler_choice import SamplerChoice
from paper_tables.factorial_table import CONTRASTS, PLANNERS, factorial_table

FACTOR = {"transformer": 0.5, "random": 1.0, "algorithm-2": 0.25, "projected": 0.125}
FACTOR["other-cloud"] = 3.0


def rows_of(planners, make=a_row, problems=5):
    """Work = 1000 * product of FACTOR over a planner's words * a factor of the problem and seed."""
    for planner, problem, seed in product(planners, range(problems), (0, 1)):
        words = planner.removeprefix("cvq:").split("+")
        work = round(1000 * (problem + 1) * (seed + 2))
        for word in words:
            work *= FACTOR.get(word, 1.0)
        parts = asdict(SamplerChoice.of("+".join(words))) if planner != "birrt" else {}
        counts = {"n_projections": int(work), "n_state_checks": 0, "g_sampled": 2.0}
        how = {"suite": "factorial", "seed": seed, "t_total_s": 0.1}
        yield make(str(problem), planner, **how, **counts, **parts)


def test_contrasts_are_of_one_choice_all_else_equal():
    told = factorial_table(rows_of(PLANNERS), ())
    lines = {line[0]: line[1:] for line in told.sections["Contrasts"][1:]}
    assert lines.keys() == {c.title for c in CONTRASTS if c.other != "graph"}  # only in old rows
    expected = {"transformer / random codes, wide": "0.500", "own / other cloud, decoded": "0.333"}
    expected |= {"Algorithm 2 / none, all decoded": "0.250", "projected / none, all wide": "0.125"}
    expected |= {"wide / decoded, transformer": "1.00", "15 % uniform / none, decoded": "1.00"}
    for title, ratio in expected.items():
        assert lines[title][0] == "5" and lines[title][1].startswith(f"{ratio} ["), title
    assert max(map(len, told.brief)) <= 100 and len(told.sections["Products"]) == len(PLANNERS) + 1
    ours = {(x["metric"], x["planner"]): x["value"] for x in csv.DictReader(io.StringIO(told.csv))}
    assert float(ours["G_ratio", "cvq:random+wide+none"]) == 1.0
    alone = float(ours["work_contrast", "all beams / likeliest, transformer wide"])
    assert alone == pytest.approx(1.0)


def test_contrasts_without_a_side_are_left_out_and_failures_are_no_pair():
    some = ("birrt", "cvq:random+decoded+none", "cvq:random+decoded+projected")
    rows = [*rows_of(some[:2]), *rows_of(some[2:], problems=3)]
    rows += [row for row in rows_of(some[2:], a_failure) if row.problem in "34"]
    told = factorial_table(rows, ())
    found = [line[:2] for line in told.sections["Contrasts"][1:]]
    assert found == [["projected / none, all decoded", "3"]]
