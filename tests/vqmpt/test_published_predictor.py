"""Prediction with small networks of random weights: cache, codes, refusals."""

import dataclasses

import numpy as np
import pytest
from small_models import random_checkpoint

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.checkpoint import stored
from cvqmpt_lab.vqmpt.published_predictor import Predictor


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
    return Predictor(stored(checkpoint), panda)


@pytest.fixture(scope="module")
def prediction(predictor, queries):
    return predictor.predict(*queries)


def test_codes_are_those_of_the_sequences_that_reach_a_goal(prediction):
    assert len(prediction.sequences) == 6 and len(set(prediction.codes)) > 1
    reached = [one.codes for one in prediction.sequences if one.finished]
    assert prediction.codes.tolist() == [code for codes in reached for code in codes]


def test_goals_in_one_batch_are_predicted_as_alone(predictor, prediction, queries):
    cloud, start, goals = queries
    alone = [predictor.predict(cloud, start, goals[k : k + 1]) for k in range(len(goals))]
    assert [one.sequences[0].codes for one in alone] == [
        found.codes for found in prediction.sequences
    ]


def test_goals_that_are_never_reached_are_named(panda, queries):
    predictor = Predictor(stored(random_checkpoint(panda, goal_bias=-1e6)), panda)
    prediction = predictor.predict(*queries)
    assert prediction.unfinished == tuple(range(6)) and len(prediction.codes) == 0


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
        ({"start": HOME + [0, 0, 0, 3.0, 0, 0, 0]}, "start: joint 'panda_joint4' is 0.7138 "
                                                    "outside"),
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
    alone = {"dictionary": checkpoint.modules["dictionary"]}
    with pytest.raises(InvalidInputError, match="train published"):
        Predictor(stored(dataclasses.replace(checkpoint, modules=alone)), panda)
