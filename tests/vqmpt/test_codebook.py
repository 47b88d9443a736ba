"""The dictionary in numpy computes what the torch modules compute that were trained;
what does not fit is refused.
"""

from dataclasses import replace

import numpy as np
import pytest
from small_models import METADATA, compact_config, random_checkpoint
from training_data import LOWER, UPPER

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.checkpoint import stored
from cvqmpt_lab.vqmpt.codebook import Codebook
from cvqmpt_lab.vqmpt.weights import RobotSignature


@pytest.fixture(scope="module")
def checkpoint(panda):
    return random_checkpoint(panda, compact_config())


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
        (
            {"robot": RobotSignature("ur5", tuple(LOWER), tuple(UPPER))},
            "for robot 'ur5', not 'panda'",
        ),
    ],
)
def test_models_of_other_robots_are_refused(checkpoint, panda, change, message):
    with pytest.raises(InvalidInputError, match=message):
        Codebook(stored(replace(checkpoint, **change)), panda)
