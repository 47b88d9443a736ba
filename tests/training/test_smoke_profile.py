"""Data, training and prediction by the command line; training needs only torch and numpy."""

import json

import numpy as np
import pytest
from command_line import python

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.training.profiles import PROFILES
from cvqmpt_lab.vqmpt.checkpoint import load_checkpoint, stored
from cvqmpt_lab.vqmpt.codebook import Codebook
from cvqmpt_lab.vqmpt.sequence_predictor import PublishedPredictor
from cvqmpt_lab.vqmpt.weights import robot_signature


@pytest.mark.parametrize("robot", [None, "tiago-no-hand"])
def test_from_scenes_to_a_prediction(tmp_path, cvqmpt, robot):
    """The Panda, and an arm of eight joints whose first joint is prismatic."""
    data, stage1, out = tmp_path / "data", tmp_path / "stage1", tmp_path / "model"
    robot_options = ""
    if robot is not None:
        robot_options = f"--robot {tmp_path / 'robot.json'}"
        cvqmpt(f"robot {robot} --base 0,0,-0.6 --out {tmp_path / 'robot.json'}")
    # the first scene of each family is for validation
    few = f"--scenes 4 --paths-per-scene 4 --seed 9 --family kitchen-like,shelves {robot_options}"
    common = f"--profile smoke --data {data} --device cpu --epochs 1"
    for command in (
        f"data generate {few} --jobs 2 --out {data}",
        f"train stage1 {common} --out {stage1}",
        f"train published {common} --dictionary {stage1} --out {out}",
    ):
        cvqmpt(command)
    robot = robot_from_source(json.loads((data / "dataset.json").read_text())["recipe"]["robot"])
    model = stored(load_checkpoint(out / "model", robot_signature(robot)))
    assert len(predicted(PublishedPredictor(model, robot), robot, 1)[0][0].codes) > 0
    codebook = Codebook(model, robot)
    assert all(np.isfinite(part).all() for part in codebook.gaussians(codebook.vectors[:5]))


def predicted(predictor, robot, goals):
    """Predict hypotheses in a random cloud."""
    rng = np.random.default_rng(0)
    scene = predictor.encode(rng.uniform(-0.8, 0.8, (400, 3)))
    start, *goals = robot.random_configurations(rng, 1 + goals)
    return predictor.hypotheses(scene, start, np.array(goals))


def test_the_published_architecture_learns_from_roadmap_labels_and_plans(tmp_path, cvqmpt):
    """The shipped dictionary is used, whose width differs from that of the network."""
    labels, out, config = tmp_path / "labels", tmp_path / "out", tmp_path / "tiny.json"
    scenes = ["--labels", "roadmap", "--family", "table,shelves", "--scenes", "4", "--jobs", "1"]
    cvqmpt("data generate", *scenes, "--out", labels)
    profile = to_plain(PROFILES["smoke"], complete=True)
    profile["published"] |= {"batches_per_epoch": 2, "validation_scenes": 2}
    config.write_text(json.dumps(profile))
    train = f"train published --config {config} --data {labels} --out {out}"
    said = cvqmpt(f"{train} --epochs 1 --device cpu")
    for metric in ("no_cloud_cross_entropy_ways", "wrong_cloud_cross_entropy_all"):
        assert f"validation_{metric}" in said
    assert "solved" in cvqmpt("plan place-task --planner cvq-published --model", out)


BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in "scipy pinocchio coal ompl numba rerun cvxpy matplotlib".split():
            raise ImportError(f"{name} is not on a bare machine")
sys.meta_path.insert(0, Blocked())
from cvqmpt_lab.cli.main import main
sys.exit(main(["train", "stage1", "--profile", "smoke", "--print-config"]))
"""


def test_the_train_command_starts_with_only_torch_and_numpy():
    assert '"name": "smoke"' in python(BLOCKED)
