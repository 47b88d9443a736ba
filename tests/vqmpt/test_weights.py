"""Weights: round trips, every kind of damage named, comparison with the given robot."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_models import METADATA, compact_config, random_checkpoint
from training_data import LOWER, UPPER

from cvqmpt_lab.codec import from_plain, to_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt import weights
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, stored
from cvqmpt_lab.vqmpt.codebook import Codebook
from cvqmpt_lab.vqmpt.config import DictionaryConfig, ModelConfig, TransformerConfig
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.weights import OtherRobotError, RobotSignature, weights_digest

ROBOT = RobotSignature("arm", (-1.0,) * 7, (2.0,) * 7)
SIZES = TransformerConfig(n_layers=1, n_heads=1, d_k=4, d_v=4, d_model=8, d_inner=8)
WORDS = DictionaryConfig(transformer=SIZES, n_position=5, n_codes=6)
CONFIG = ModelConfig(kind="compact", dictionary=WORDS, point_cloud=None, sequence=None)


@pytest.fixture
def folder(tmp_path):
    modules = {"dictionary": Dictionary(CONFIG)}
    save_checkpoint(tmp_path / "model", Checkpoint(CONFIG, ROBOT, modules, {"note": 1}))
    return tmp_path / "model"


def test_round_trip(folder):
    loaded = load_checkpoint(folder, ROBOT)
    assert (loaded.config, loaded.robot, loaded.metadata) == (CONFIG, ROBOT, {"note": 1})
    assert [*loaded.modules] == ["dictionary"] and not loaded.modules["dictionary"].training
    other, first = Dictionary(CONFIG), weights_digest(folder)
    save_checkpoint(folder, Checkpoint(CONFIG, ROBOT, {"dictionary": other}))  # replaces
    for name, tensor in load_checkpoint(folder).modules["dictionary"].state_dict().items():
        assert torch.equal(tensor, other.state_dict()[name])
    assert weights_digest(folder) != first
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


def test_a_full_disk_leaves_the_earlier_checkpoint(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    before = weights_digest(folder)
    monkeypatch.setattr(weights, "write_bytes", full)
    with pytest.raises(InvalidInputError, match="No space left"):
        save_checkpoint(folder, Checkpoint(CONFIG, ROBOT, {"dictionary": Dictionary(CONFIG)}))
    assert weights_digest(folder) == before
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


def test_weights_that_are_not_finite_are_not_written(tmp_path):
    dictionary = Dictionary(CONFIG)
    with torch.no_grad():
        dictionary.decoder.mu[0].bias[0] = torch.nan
    with pytest.raises(InvalidInputError, match=r"decoder\.mu\.0\.bias has NaN"):
        save_checkpoint(tmp_path / "m", Checkpoint(CONFIG, ROBOT, {"dictionary": dictionary}))
    assert list(tmp_path.iterdir()) == []


def test_damage_is_named(folder):
    file = folder / "dictionary.safetensors"
    data = file.read_bytes()
    file.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(InvalidInputError, match=r"dictionary\.safetensors is damaged: sha256"):
        load_checkpoint(folder)
    file.unlink()
    with pytest.raises(InvalidInputError, match=r"dictionary\.safetensors: No such file"):
        load_checkpoint(folder)
    with pytest.raises(InvalidInputError, match=r"config\.json: No such file"):
        load_checkpoint(folder.parent)
    os.mkfifo(file)  # not waited for
    with pytest.raises(
        InvalidInputError, match=r"dictionary\.safetensors: it is not a regular file"
    ):
        load_checkpoint(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["model"]["dictionary"].update(n_codes=9), r"embedding.weight is \(6, 8\), "
                                                               r"expected \(9, 8\)"),
        # not made: 14 GB
        (lambda d: d["model"]["dictionary"].update(n_codes=60_000, code_dim=60_000), "60000"),
        (lambda d: d["model"]["dictionary"]["transformer"].update(n_layers=2), "layer_stack.1.*is "
                                                                               "missing"),
        (lambda d: d["model"]["dictionary"]["transformer"].update(n_layers=0), "n_layers is 0; "
                                                                               "it must be 1"),
        (lambda d: d["model"]["dictionary"].update(encoder="mlp"), "and [0-9]+ more"),
        (lambda d: d.update(format="2"), "format is '2'"),
        (lambda d: d.pop("metadata"), "metadata is None"),
        (lambda d: d["sha256"].clear(), "sha256 lists nothing; it must list dictionary"),
        (lambda d: d.update(architecture="mpnet"), "architecture is 'mpnet'; expected 'vq-mpt'"),
        (lambda d: d["robot"].pop("lower"), "robot.lower is missing"),
        (lambda d: d["robot"].update(lower=[0.0], upper=[1.0]), "limits of 1 joints"),
    ],
)  # fmt: skip
def test_config_and_tensors_must_agree(folder, change, message):
    description = json.loads((folder / "config.json").read_text())
    change(description)
    (folder / "config.json").write_text(json.dumps(description))
    with pytest.raises(InvalidInputError, match=message):
        load_checkpoint(folder)


ARM = RobotSignature("arm", (-1.0, -1.0), (2.0, 2.0), ("shoulder", "elbow"), "0123456789")
OLD = RobotSignature("arm", ARM.lower, ARM.upper)


def test_the_same_robot_may_have_another_name_or_less_on_record():
    ARM.require_same(replace(ARM, name="my arm", upper=(2.0, 2.00001)))
    ARM.require_same(OLD)
    OLD.require_same(ARM)
    assert from_plain(RobotSignature, json.loads(json.dumps(to_plain(ARM)))) == ARM
    assert from_plain(RobotSignature, {"name": "arm", "lower": [-1, -1], "upper": [2, 2]}) == OLD


@pytest.mark.parametrize(
    ("weights", "robot", "message"),
    [
        (ARM, replace(ARM, lower=(0.0,), upper=(1.0,), joints=()), "not this one: 2 joints, not 1"),
        (ARM, replace(ARM, joints=("shoulder", "wrist")), "joint 'elbow', not 'wrist'"),
        (ARM, replace(ARM, upper=(2.0, 2.5)), "upper limit of joint 1 2, not 2.5"),
        (ARM, replace(ARM, kinematics="fedcba9876"), r"placed otherwise \(kinematics 01234567, "
                                                     r"not fedcba98\)"),
        (OLD, replace(ARM, name="leg"), "not 'leg': another name, and no digest to compare"),
    ],
)  # fmt: skip
def test_another_robot_is_refused_with_the_difference(weights, robot, message):
    with pytest.raises(OtherRobotError, match=f"for robot 'arm', .*{message}"):
        weights.require_same(robot)


@pytest.mark.parametrize(
    "change",
    [
        *({"lower": ["-1", "-1"]}, {"lower": [3, 3]}, {"lower": [], "upper": []}),
        *({"upper": [float("nan"), 2]}, {"joints": ["elbow"]}),
    ],
)
def test_what_is_no_signature_is_refused(change):
    with pytest.raises(InvalidInputError, match=r"^config: robot"):
        from_plain(RobotSignature, to_plain(ARM) | change, "config: robot")


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"metadata": {}}, "its metadata has no kinematics"),
        ({"points": [1, 2]}, "points and offsets describe 7, 7, 2 and 4"),
        ({"robot": replace(ROBOT, name="ur5", lower=LOWER, upper=UPPER)}, "for robot 'ur5'"),
    ],
)
def test_models_of_other_robots_are_refused(checkpoint, panda, change, message):
    if not change.keys() & {"metadata", "robot"}:
        change = {"metadata": {"kinematics": METADATA["kinematics"] | change}}
    with pytest.raises(InvalidInputError, match=message):
        Codebook(stored(replace(checkpoint, **change)), panda)
