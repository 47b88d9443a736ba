"""The dictionary in numpy computes what the torch modules compute that were trained; what does not fit is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_models import METADATA, compact_config, random_checkpoint
from training_data import LOWER, UPPER, kinematics

from cvqmpt_lab.codec.plain import from_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.training.stage1 import LinkPositions
from cvqmpt_lab.vqmpt.checkpoint import stored
from cvqmpt_lab.vqmpt.codebook import Codebook, ModelConfigurations, dictionary_gaussians, waypoint_codes
from cvqmpt_lab.vqmpt.inputs import SerialChain
from cvqmpt_lab.vqmpt.weights import RobotSignature


@pytest.fixture(scope="module")
def checkpoint(panda):
    return random_checkpoint(panda, compact_config())


@torch.inference_mode()
def test_configurations_codes_and_gaussians_are_those_of_torch(checkpoint, panda):
    model, words, span = stored(checkpoint), checkpoint.dictionary, panda.upper - panda.lower
    q = panda.random_configurations(np.random.default_rng(2), 200)
    links = LinkPositions(tuple(LOWER), tuple(UPPER), from_plain(SerialChain, kinematics()))
    configurations = ModelConfigurations(model, panda).of(q)
    u = torch.from_numpy((q - panda.lower) / span).float()
    np.testing.assert_allclose(configurations, links.configurations(u), atol=1e-6)
    codes = waypoint_codes(model, configurations)
    np.testing.assert_array_equal(codes, words.encode(torch.from_numpy(configurations[None]))[0])
    assert len(np.unique(codes)) > 3
    expected, book = words.decode(words.quantizer.embedding.weight), Codebook(model, panda)
    for means, covariances in (dictionary_gaussians(model, panda), book.gaussians(book.vectors)):
        np.testing.assert_allclose((means - panda.lower) / span, expected.mean, atol=1e-5)
        np.testing.assert_allclose(covariances / np.outer(span, span), expected.covariance, atol=1e-5)


BIAS, VECTORS = "decoder.mu.0.bias", "quantizer.embedding.weight"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (BIAS, lambda a: None, r"decoder\.mu\.0\.bias is missing"),
        (BIAS, lambda a: a[:3], r"decoder\.mu\.0\.bias is \(3,\), expected \(7,\)"),
        (BIAS, lambda a: a.astype(int), r"decoder\.mu\.0\.bias is int64, expected float32"),
        (BIAS, lambda a: a * np.nan, r"decoder\.mu\.0\.bias has NaN"),
        (VECTORS, lambda a: 2.0 * a, "not of unit length"),
    ],
)
def test_weights_that_do_not_fit_are_named(checkpoint, panda, name, change, message):
    model = stored(checkpoint)
    arrays = dict(model.parts["dictionary"])
    arrays[name] = change(arrays[name])
    arrays = {key: array for key, array in arrays.items() if array is not None}
    with pytest.raises(InvalidInputError, match=message):
        Codebook(replace(model, parts={"dictionary": arrays}), panda)


def changed_kinematics(**changes):
    return {"metadata": {"kinematics": METADATA["kinematics"] | changes}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"metadata": {}}, "its metadata has no kinematics"),
        (changed_kinematics(points=[1, 2]), "points and offsets describe 7, 7, 2 and 4"),
        (
            changed_kinematics(translation=np.full((7, 3), 0.01).tolist()),
            "another translation of joint 'panda_joint5' .difference 0.374",
        ),
        ({"robot": RobotSignature("ur5", tuple(LOWER), tuple(UPPER))}, "for robot 'ur5', not 'panda'"),
    ],
)
def test_models_of_other_robots_are_refused(checkpoint, panda, change, message):
    with pytest.raises(InvalidInputError, match=message):
        Codebook(stored(replace(checkpoint, **change)), panda)
