"""The update's figures: numbers of the codes that it moves, the Markov bound, the command."""

import csv
import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from small_models import random_checkpoint

from cli.main import main
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.checkpoint import save_checkpoint
from cvqmpt_lab.vqmpt.stages import codebook_of
from cvqmpt_lab.vqmpt.weights import weights_digest
from experiments.figures import scene_pictures
from experiments.figures.code_update import (
    FAR,
    NEAR,
    THRESHOLDS,
    Histogram,
    MarkovTail,
    UpdateSettings,
    code_changes,
    histogram_figure,
    update_codes,
)
from experiments.figures.drawing import figure_bytes
from experiments.figures.scene_pictures import HandPoses, hands_of_code

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


def test_markov_bound_by_hand_and_where_it_is_reached():
    """With all of the mean at k itself the inequality is an equality."""
    markov = MarkovTail.of(np.array([0.0, 1.0, 2.0, 5.0]), (0.5, 1.0, 2.0, 4.0, 8.0))
    np.testing.assert_array_equal(markov.tail, (0.75, 0.75, 0.5, 0.25, 0.0))
    np.testing.assert_array_equal(markov.bound, (4.0, 2.0, 1.0, 0.5, 0.25))
    markov = MarkovTail.of(np.array([0.0, 0.0, 0.0, 4.0]), (4.0,))
    assert markov.tail == markov.bound == 0.25


def test_histogram_by_hand():
    before, after = np.array([0.0, 0.4, 1.0, 1.9, 100.0]), np.array([0.0, 0.1] + [2.0] * 600)
    histogram = Histogram.of(before, after, bins=4)
    np.testing.assert_allclose(histogram.edges, (0.0, 0.5, 1.0, 1.5, 2.0, 100.0))
    np.testing.assert_array_equal(histogram.before, (2, 0, 1, 1, 1))
    np.testing.assert_array_equal(histogram.after, (2, 0, 0, 0, 600))
    assert histogram.beyond == 1


@pytest.mark.parametrize(
    ("make", "given", "said"),
    [
        *((lambda v: Histogram.of(v, v), [v], "finite values from 0") for v in ([], [-1.0], [np.nan], [np.inf])),
        (MarkovTail.of, [[], (1.0,)], "Markov bound"),
        (MarkovTail.of, [[1.0], (0.0,)], "Markov bound"),
        (MarkovTail.of, [[1.0], (-1.0, 2.0)], "Markov bound"),
        (lambda samples: UpdateSettings(samples=samples), [0], "samples of the update 0: give"),
        (lambda seed: UpdateSettings(seed=seed), [-1], "seed of the update -1: give"),
    ],
)  # fmt: skip
def test_bad_numbers_are_refused(make, given, said):
    with pytest.raises(InvalidInputError, match=said):
        make(*given)


def test_the_update_is_algorithm_2_from_the_dictionarys_own_gaussians(problem, update):
    codebook = codebook_of("vq_mpt", problem.robot)
    means, covariances = codebook.gaussians(codebook.vectors[update.codes])
    np.testing.assert_array_equal(update.before.means, means)
    scales = update.before.scales
    np.testing.assert_allclose(scales @ scales.swapaxes(1, 2), covariances, atol=1e-6)
    assert (~update.kept).any() and update.g_after.mean() < 0.8 * update.g_before.mean()
    assert update.centre_after.mean() < 0.5 * update.centre_before.mean()


def test_hands_by_another_kinematics(update, problem):
    after = hands_of_code(update, 1, count=20)[1].hands
    for i, q in enumerate(after.q):
        T = problem.robot.pose(q)
        np.testing.assert_allclose(after.positions[i], T[:3, 3], atol=1e-9)
        assert np.cos(after.tilt[i]) == pytest.approx(T[2, 0], abs=1e-9)
    upright = HandPoses.of(problem.robot, problem.start[None])
    assert upright.tilt[0] < 1e-4


def test_figures_repeat_byte_for_byte(update):
    first, again = (figure_bytes(histogram_figure(code_changes(update)), "svg") for _ in range(2))
    assert first == again and b"<svg" in first


@pytest.fixture
def small_pictures(monkeypatch):
    monkeypatch.setattr(scene_pictures, "PICTURE", (180, 138))


def test_no_codes_is_said(problem, panda, tmp_path):
    save_checkpoint(tmp_path / "silent", random_checkpoint(panda, goal_bias=-1e6))
    with pytest.raises(InvalidInputError, match="predicted 0 codes"):
        update_codes(problem.with_goals(problem.goals[:1]), str(tmp_path / "silent"), SETTINGS)


def rows_of(path):
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))


def test_the_command_writes_the_histogram(tmp_path, model, capsys):
    out = tmp_path / "histogram"
    words = ["figure", "histogram", "--problem", "1", "--model", str(model), "--out", str(out)]
    assert main(words) == 0
    pictures, tables = ("histogram.png", "histogram.svg"), ("histogram.csv", "values.csv", "markov.csv")
    assert {path.name for path in out.iterdir()} == {*pictures, *tables, "provenance.json"}
    assert ET.parse(out / "histogram.svg").getroot().tag.endswith("svg")
    for role in (FAR, NEAR):
        bins = [row for row in rows_of(out / "histogram.csv") if row["role"] == role]
        assert sum(int(row["before"]) for row in bins) == sum(int(row["after"]) for row in bins) == 2000
    tails = rows_of(out / "markov.csv")
    assert len(tails) == 4 * len(THRESHOLDS)
    assert all(float(row["tail"]) <= float(row["bound"]) * (1.0 + 1e-5) for row in tails)
    record = json.loads((out / "provenance.json").read_text())
    assert record["weights"] == {"vq_mpt": weights_digest(model)} and record["seeds"] == [0]
    assert main([*words, "--seed", "1"]) == 2  # another configuration
    assert "update.seed was 0, now 1" in capsys.readouterr().err


def test_the_command_writes_the_concept_figure(tmp_path, model, small_pictures):
    out = tmp_path / "concept"
    assert main(["figure", "concept", "--model", str(model), "--out", str(out)]) == 0
    rows = rows_of(out / "concept.csv")
    assert [row["when"] for row in rows] == ["before"] * 120 + ["after"] * 120
    for row in rows:
        assert np.cos(float(row["tilt_rad"])) == pytest.approx(float(row["up_z"]), abs=1e-4)


def test_files_of_others_are_left_alone(tmp_path, model, capsys):
    (tmp_path / "thesis.tex").write_text("mine")
    assert main(["figure", "histogram", "--model", str(model), "--out", str(tmp_path)]) == 2
    assert "holds files without provenance.json" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["histogram", "--planners", "birrt"], "unknown arguments: --planners birrt"),
        (["pie"], "unknown figure 'pie'; valid choices: histogram, concept"),
        (["histogram", "--seed", "-1"], "seed of the update -1: give"),
        (["histogram", "--problem", "150"], "unknown problem 150"),
        (["histogram", "--model", "/nowhere"], "/nowhere"),
    ],
)
def test_wrong_options_are_one_line(tmp_path, capsys, words, said):
    assert main(["figure", *words, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]
