"""Data, both stages of training and a prediction, through the command line, on the smoke profile."""

import json

import numpy as np
import pytest

from cli.main import main
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.vqmpt.checkpoint import load_checkpoint, stored
from cvqmpt_lab.vqmpt.predictor import Predictor, PredictorSettings
from cvqmpt_lab.vqmpt.weights import robot_signature

ROBOTS = ["--family kitchen-like", "--robot tiago-no-hand --base 0,0,-0.6 --family shelves"]


@pytest.mark.parametrize("robot_options", ROBOTS)
def test_from_scenes_to_a_prediction(tmp_path, robot_options):
    """For the Panda and an arm of eight joints whose first one slides."""
    data, stage1, stage2 = tmp_path / "data", tmp_path / "stage1", tmp_path / "stage2"
    few = ["--scenes", "4", "--paths-per-scene", "4", "--seed", "9"]  # the first of each family validates
    assert main(["data", "generate", *few, "--jobs", "2", "--out", str(data), *robot_options.split()]) == 0
    common = ["--profile", "smoke", "--data", str(data), "--device", "cpu", "--epochs", "1"]
    assert main(["train", "stage1", *common, "--out", str(stage1)]) == 0
    assert main(["train", "stage2", *common, "--dictionary", str(stage1), "--out", str(stage2)]) == 0

    robot = robot_from_source(json.loads((data / "dataset.json").read_text())["recipe"]["robot"])
    checkpoint = load_checkpoint(stage2 / "model", robot_signature(robot))
    predictor = Predictor(stored(checkpoint), robot, PredictorSettings(uniform_share=0.2))
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-0.8, 0.8, (400, 3))
    start, goal = robot.random_configurations(rng, 2)
    prediction = predictor.predict(cloud, start, goal[None])
    mixture = predictor.mixture(prediction)
    assert len(prediction.sequences[0].codes) > 0
    assert np.isfinite(mixture.sample(rng, 100)).all()
