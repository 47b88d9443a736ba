"""Prediction with small networks of random weights: features, cache, codes, mixture, refusals."""

import dataclasses

import numpy as np
import pytest
import torch
from small_models import random_checkpoint

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.search.query import Uniform
from cvqmpt_lab.vqmpt.checkpoint import stored
from cvqmpt_lab.vqmpt.codebook import Codebook
from cvqmpt_lab.vqmpt.predictor import AS_PUBLISHED, GOAL_STD, Predictor, PredictorSettings

BEAM = PredictorSettings(uniform_share=0.15, std_floor=None)


@pytest.fixture(scope="module")
def checkpoint(panda):
    return random_checkpoint(panda)


@pytest.fixture(scope="module")
def queries(panda):
    """Cloud, start and six goals."""
    rng = np.random.default_rng(3)
    q = panda.random_configurations(rng, 7)
    return rng.uniform(-0.8, 0.8, (200, 3)), q[0], q[1:]


@pytest.fixture(scope="module")
def predictor(panda, checkpoint):
    return Predictor(stored(checkpoint), panda, BEAM)


@pytest.fixture(scope="module")
def prediction(predictor, queries):
    return predictor.predict(*queries)


def test_codes_are_those_of_the_sequences_with_the_dictionary_s_gaussians(panda, checkpoint, prediction):
    assert len(prediction.sequences) == 6 and len(set(prediction.codes)) > 1
    assert set(prediction.codes) == {c for one in prediction.sequences if one.finished for c in one.codes}
    vectors = checkpoint.dictionary.quantizer.embedding.weight.detach()
    np.testing.assert_array_equal(prediction.z, vectors[prediction.codes])
    with torch.no_grad():
        expected = checkpoint.dictionary.decode(vectors[prediction.codes])
    span = panda.upper - panda.lower
    np.testing.assert_allclose((prediction.means - panda.lower) / span, expected.mean, atol=1e-5)
    scaled = prediction.covariances / np.outer(span, span)
    np.testing.assert_allclose(scaled, expected.covariance, rtol=1e-3, atol=1e-6)


def test_goals_in_one_batch_are_predicted_as_alone(predictor, prediction, queries):
    cloud, start, goals = queries
    alone = [predictor.predict(cloud, start, goals[k : k + 1]) for k in range(len(goals))]
    assert [one.sequences[0].codes for one in alone] == [found.codes for found in prediction.sequences]
    np.testing.assert_allclose(np.concatenate([one.means for one in alone]), prediction.means, atol=1e-4)


def test_the_mixture_is_the_codes_the_goals_and_a_uniform_share(panda, predictor, prediction, queries):
    mixture = predictor.mixture(prediction)
    c, span = len(prediction.codes), panda.upper - panda.lower
    assert mixture.name == "cvq-mpt" and len(mixture.weights) == c + 6
    np.testing.assert_allclose(mixture.weights, 1.0 / (c + 6))
    np.testing.assert_array_equal(mixture.means[:c], prediction.means)
    np.testing.assert_array_equal(mixture.means[c:], queries[2])
    np.testing.assert_allclose(mixture.covariances[c:], [np.diag((GOAL_STD * span) ** 2)] * 6)
    np.testing.assert_allclose(mixture.covariances[:c], prediction.covariances)
    assert mixture.uniform_share == 0.15
    np.testing.assert_array_equal(mixture.uniform.lower, panda.lower)


def test_moved_codes_have_gaussians_of_their_own_and_narrow_ones_are_widened(
    panda, checkpoint, predictor, prediction
):
    z, c = np.roll(prediction.z, 1, axis=0), len(prediction.z)
    mixture = predictor.mixture(prediction, z)
    means, covariances = Codebook(stored(checkpoint), panda).gaussians(z)
    np.testing.assert_allclose(mixture.means[:c], means)
    np.testing.assert_allclose(mixture.covariances[:c], covariances)
    with pytest.raises(InvalidInputError, match=r"codes of shape \(1, 8\); expected"):
        predictor.mixture(prediction, z[:1])
    wide = Predictor(stored(checkpoint), panda, dataclasses.replace(BEAM, std_floor=0.5)).mixture(prediction)
    before, after = (np.sqrt(np.linalg.eigvalsh(m)) for m in (prediction.covariances, wide.covariances[:c]))
    assert before.min() < 0.49 and before.max() > 0.51
    np.testing.assert_allclose(after, np.maximum(before, 0.5), rtol=1e-6)


def test_goals_that_are_never_reached_are_named(panda, queries):
    never = stored(random_checkpoint(panda, goal_bias=-1e6))
    predictor = Predictor(never, panda, BEAM)
    prediction = predictor.predict(*queries)
    assert prediction.unfinished == tuple(range(6)) and len(prediction.codes) == 0
    np.testing.assert_array_equal(predictor.mixture(prediction).means, queries[2])
    assert isinstance(Predictor(never, panda, AS_PUBLISHED).mixture(prediction), Uniform)


HOME = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
CLOUD = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cloud": np.empty((0, 3))}, "point cloud of 0 points; give at least 2"),
        ({"cloud": CLOUD[:1]}, "point cloud of 1 points"),
        ({"cloud": np.where(np.arange(50)[:, None] == 7, np.nan, CLOUD)}, "1 points with NaN"),
        ({"cloud": 1000.0 * CLOUD}, "give metres, not millimetres"),
        ({"cloud": CLOUD[:, :2]}, r"shape \(50, 2\); it must be \(n, 3\)"),
        ({"cloud": CLOUD[None]}, r"shape \(1, 50, 3\)"),
        ({"cloud": "cloud.ply"}, "point cloud must be numbers"),
        ({"start": HOME + [0, 0, 0, 3.0, 0, 0, 0]}, "start: joint 'panda_joint4' is 0.7138 outside"),
        ({"start": HOME[:6]}, r"start of shape \(6,\); the robot takes \(7,\)"),
        ({"goals": [HOME, HOME - 2.0]}, "goal 1: joint 'panda_joint4' is"),
        ({"goals": HOME}, r"goals of shape \(7,\)"),
        ({"goals": np.empty((0, 7))}, "at least one"),
        ({"goals": [HOME * np.nan]}, "goal 0: joint 'panda_joint1' is not finite"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(predictor, change, message):
    with pytest.raises(InvalidInputError, match=message) as caught:
        predictor.predict(**{"cloud": CLOUD, "start": HOME, "goals": [HOME]} | change)
    assert "\n" not in str(caught.value)


def test_a_model_of_stage_1_alone_predicts_nothing(panda, checkpoint):
    with pytest.raises(InvalidInputError, match="train stage2"):
        Predictor(stored(dataclasses.replace(checkpoint, sequence_model=None)), panda)


@pytest.mark.parametrize(("name", "value"), [("uniform_share", 1.5), ("std_floor", 0.0)])
def test_settings_are_checked(name, value):
    with pytest.raises(InvalidInputError, match=f"{name} of the predictor is {value}"):
        PredictorSettings(**{name: value})
