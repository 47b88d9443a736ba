"""Figures: the update of codes as the planners sample."""

import csv
import json
import xml.etree.ElementTree as ET
from itertools import product

import numpy as np
import pytest
from command_line import refused as command_refused
from refusals import refused
from small_models import random_checkpoint

from cvqmpt_lab.experiments.figures import paper
from cvqmpt_lab.experiments.figures.code_update import (
    UpdateSettings,
    histogram_rows,
    squared_residual,
    update_codes,
)
from cvqmpt_lab.experiments.figures.paper import figure_bytes, histogram_figure
from cvqmpt_lab.paper_tables.claims import updated_codes
from cvqmpt_lab.planning.planners import planner_named
from cvqmpt_lab.search.planner_interface import Observation, Query
from cvqmpt_lab.search.result import Budget
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.vqmpt.checkpoint import save_checkpoint
from cvqmpt_lab.vqmpt.weights import weights_digest

SETTINGS = UpdateSettings(samples=300)


@pytest.fixture(scope="module")
def model(tmp_path_factory, panda):
    """A small model of the authors' architecture with random weights."""
    folder = tmp_path_factory.mktemp("weights") / "model"
    save_checkpoint(folder, random_checkpoint(panda))
    return folder


@pytest.fixture(scope="module")
def update(problem):
    return update_codes(problem, None, SETTINGS)


@pytest.mark.parametrize(("when", "planner"), [("before", "cvq-mpt"), ("after", "opt-cvq-mpt")])
def test_the_mixtures_are_those_that_the_planners_sample(update, when, planner):
    stages = planner_named(planner).stages(update.problem)
    rng = np.random.default_rng(np.random.SeedSequence(0).spawn(1)[0])
    problem, budget = update.problem, Budget(seconds=60.0)
    space = ConstrainedSpace.of(problem)
    query = Query.of(space, problem.start, problem.goals, budget, rng)
    proposal = stages.predict(query, Observation(update.cloud))
    if stages.update is not None:
        proposal = stages.update(query, proposal)
    drawn_from, sampled_from = getattr(update, when), proposal.distribution
    np.testing.assert_array_equal(drawn_from.means, sampled_from.means)
    np.testing.assert_array_equal(drawn_from.covariances, sampled_from.covariances)
    sampled = proposal.distribution.sample(np.random.default_rng(1), 20_000)
    drawn = np.concatenate([update.draws(when, i) for i in range(len(update.before.means))])
    g = [squared_residual(update.problem.manifold, q).mean() for q in (sampled, drawn)]
    assert g[1] == pytest.approx(g[0], rel=0.1)


def test_rows_and_bins_count_every_draw_and_figures_repeat_byte_for_byte(update):
    rows, bins = update.rows(), histogram_rows([update, update])
    codes = len(update.codes)
    assert [row["code"] for row in rows] == [*update.codes, *["goal"] * (len(rows) - codes)]
    for what, when in product(("codes", "all"), ("before", "after")):
        gaussians = codes if what == "codes" else len(rows)
        counted = sum(row[when] for row in bins if row["of"] == what)
        assert counted == 2 * gaussians * SETTINGS.samples
    first, again = (figure_bytes(histogram_figure([update]), "svg") for _ in range(2))
    assert first == again and b"<svg" in first
    near = [np.sqrt(update.g("after")) < row["to"] for row in bins[:1]]
    assert bins[len(bins) // 2]["after"] == 2 * near[0].sum()


def test_a_problem_counts_once_in_the_mechanism(tmp_path):
    lines = ["problem,code,g_before,g_after", "a,1,4,1", "a,2,4,4", "a,goal,1,100", "b,3,1,0.5"]
    (tmp_path / "values.csv").write_text("\n".join(lines))
    pairs = updated_codes(tmp_path)
    assert [pair.ratio for pair in pairs] == pytest.approx([0.5, 0.5])


def test_no_codes_and_no_samples_are_refused(problem, panda, tmp_path):
    refused("samples of the update 0", UpdateSettings, samples=0)
    save_checkpoint(tmp_path / "silent", random_checkpoint(panda, goal_bias=-1e6))
    one = problem.changed(goals=problem.goals[:1])
    refused("predicted no codes", update_codes, one, str(tmp_path / "silent"), SETTINGS)


def rows_of(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def test_the_command_writes_the_histogram_and_leaves_files_of_others_alone(
    tmp_path, model, cvqmpt, capsys
):
    out, mine = tmp_path / "histogram", tmp_path / "mine"
    words = f"figure histogram --problems 2 --model {model} --out"
    cvqmpt(words, out)
    files = {f"histogram.{ending}" for ending in ("png", "svg", "csv")}
    files |= {"values.csv", "exceedance.csv", "provenance.json"}
    assert {path.name for path in out.iterdir()} == files
    assert ET.parse(out / "histogram.svg").getroot().tag.endswith("svg")
    assert {row["problem"] for row in rows_of(out / "values.csv")} == {"0", "1"}
    record = json.loads((out / "provenance.json").read_text())
    assert record["weights"] == {"vq_mpt": weights_digest(model)} and record["seeds"] == [0]
    other = command_refused(capsys, *words.split(), out, "--seed", 1)
    assert "update.seed was 0, now 1" in other
    mine.mkdir()
    (mine / "thesis.tex").write_text("mine")
    told = command_refused(capsys, *words.split(), mine)
    assert "has files but no provenance.json" in told
    assert [path.name for path in mine.iterdir()] == ["thesis.tex"]


def test_the_command_writes_the_concept_figure(tmp_path, model, monkeypatch, cvqmpt):
    monkeypatch.setattr(paper, "PICTURE", (180, 138))
    out = tmp_path / "concept"
    cvqmpt(f"figure concept --model {model} --out", out)
    rows = rows_of(out / "concept.csv")
    assert {row["when"] for row in rows} == {"before", "after"} and rows[-1]["code"] == "goal"
    for row in rows:
        assert np.cos(float(row["tilt_rad"])) == pytest.approx(float(row["up_z"]), abs=1e-4)
