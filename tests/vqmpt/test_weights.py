"""Weights are written, read, compared with the robot, and refused if damaged; published files."""

import json
import os
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from published_files import CONTEXT, SEQUENCE, STAGE1
from refusals import refused
from small_models import METADATA, compact_config, random_checkpoint
from training_data import LOWER, UPPER

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.vqmpt import weights
from cvqmpt_lab.vqmpt.checkpoint import (
    Checkpoint,
    import_published,
    load_checkpoint,
    read_tensors,
    save_checkpoint,
    stored,
)
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


def test_after_a_failed_write_the_earlier_checkpoint_is_left(folder, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    before, checkpoint = weights_digest(folder), Checkpoint(CONFIG, ROBOT, {})
    checkpoint.modules["dictionary"] = Dictionary(CONFIG)
    with monkeypatch.context() as patch:
        patch.setattr(weights, "write_bytes", full)
        refused("No space left", save_checkpoint, folder, checkpoint)
    checkpoint.modules["dictionary"].decoder.mu[0].bias.data[0] = torch.nan
    refused(r"decoder\.mu\.0\.bias has NaN", save_checkpoint, folder, checkpoint)
    assert weights_digest(folder) == before
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


def test_damage_is_named(folder):
    file = folder / "dictionary.safetensors"
    data = file.read_bytes()
    file.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    refused(r"dictionary\.safetensors is damaged: sha256", load_checkpoint, folder)
    file.unlink()
    refused(r"dictionary\.safetensors: No such file", load_checkpoint, folder)
    refused(r"config\.json: No such file", load_checkpoint, folder.parent)
    os.mkfifo(file)  # not waited for
    refused(r"dictionary\.safetensors: it is not a regular file", load_checkpoint, folder)


def words(**changes):
    return lambda description: description["model"]["dictionary"].update(changes)


def layers(count):
    return lambda d: d["model"]["dictionary"]["transformer"].update(n_layers=count)


def test_config_and_tensors_must_agree(folder):
    good = (folder / "config.json").read_text()
    for change, message in (
        (words(n_codes=9), r"embedding.weight is \(6, 8\), expected \(9, 8\)"),
        (words(n_codes=60_000, code_dim=60_000), "60000"),  # not made: 14 GB
        (layers(2), "layer_stack.1.*is missing"),
        (layers(0), "n_layers is 0; it must be 1"),
        (words(encoder="mlp"), "and [0-9]+ more"),
        (lambda d: d.update(format="2"), "format is '2'"),
        (lambda d: d.pop("metadata"), "metadata is None"),
        (lambda d: d["sha256"].clear(), "sha256 lists nothing; it must list dictionary"),
        (lambda d: d.update(architecture="mpnet"), "is 'mpnet'; expected 'vq-mpt'"),
        (lambda d: d["robot"].pop("lower"), "robot.lower is missing"),
        (lambda d: d["robot"].update(lower=[0.0], upper=[1.0]), "limits of 1 joints"),
    ):
        description = json.loads(good)
        change(description)
        (folder / "config.json").write_text(json.dumps(description))
        with pytest.raises(InvalidInputError, match=message):  # a line for each tensor
            load_checkpoint(folder)


ARM = RobotSignature("arm", (-1.0, -1.0), (2.0, 2.0), ("shoulder", "elbow"), "0123456789")
OLD = RobotSignature("arm", ARM.lower, ARM.upper)


def test_the_same_robot_may_have_another_name_or_fewer_records():
    ARM.require_same(replace(ARM, name="my arm", upper=(2.0, 2.00001)))
    ARM.require_same(OLD)
    OLD.require_same(ARM)
    assert from_plain(RobotSignature, json.loads(json.dumps(to_plain(ARM)))) == ARM
    assert from_plain(RobotSignature, {"name": "arm", "lower": [-1, -1], "upper": [2, 2]}) == OLD


def test_another_robot_is_refused_with_the_difference_and_a_bad_signature_with_the_field():
    for ours, robot, message in (
        (ARM, replace(ARM, lower=(0.0,), upper=(1.0,), joints=()), "not this one: 2 joints, not 1"),
        (ARM, replace(ARM, joints=("shoulder", "wrist")), "joint 'elbow', not 'wrist'"),
        (ARM, replace(ARM, upper=(2.0, 2.5)), "upper limit of joint 1 2, not 2.5"),
        (ARM, replace(ARM, kinematics="fedcba9876"), r"\(kinematics 01234567, not fedcba98\)"),
        (OLD, replace(ARM, name="leg"), "not 'leg': another name, and no digest to compare"),
    ):
        told = f"for robot 'arm', .*{message}"
        refused(told, ours.require_same, robot, error=OtherRobotError)
    changes = [{"lower": ["-1", "-1"]}, {"lower": [3, 3]}, {"lower": [], "upper": []}]
    for change in (*changes, {"upper": [float("nan"), 2]}, {"joints": ["elbow"]}):
        data = to_plain(ARM) | change
        refused("^config: robot", from_plain, RobotSignature, data, "config: robot")


BIAS, VECTORS = "decoder.mu.0.bias", "quantizer.embedding.weight"


def test_weights_and_models_that_do_not_fit_are_named(panda):
    checkpoint = random_checkpoint(panda, compact_config())
    model, kinematics = stored(checkpoint), METADATA["kinematics"] | {"points": [1, 2]}
    for name, change, message in (
        (BIAS, lambda a: None, r"decoder\.mu\.0\.bias is missing"),
        (BIAS, lambda a: a[:3], r"decoder\.mu\.0\.bias is \(3,\), expected \(7,\)"),
        (BIAS, lambda a: a.astype(int), r"decoder\.mu\.0\.bias is int64, expected float32"),
        (BIAS, lambda a: a * np.nan, r"decoder\.mu\.0\.bias has NaN"),
        (VECTORS, lambda a: 2.0 * a, "not of unit length"),
    ):
        part = model.parts["dictionary"]
        arrays = part | {name: change(part[name])}
        arrays = {key: array for key, array in arrays.items() if array is not None}
        refused(message, Codebook, replace(model, parts={"dictionary": arrays}), panda)
    for change, message in (
        ({"metadata": {}}, "its metadata has no kinematics"),
        ({"metadata": {"kinematics": kinematics}}, "and offsets describe 7, 7, 2 and 4"),
        ({"robot": replace(ROBOT, name="ur5", lower=LOWER, upper=UPPER)}, "for robot 'ur5'"),
    ):
        refused(message, Codebook, stored(replace(checkpoint, **change)), panda)


def without(state, name):
    return {key: tensor for key, tensor in state.items() if key != name}


CODES, POSITIONS = "embedding.weight", "position_enc.pos_table"
VARIANCES = "batch_norm.running_var"


def with_bias(bias):
    return lambda state: state | {"mu.0.bias": bias}


def test_tensors_that_do_not_fit_are_listed(published, published_states):
    for name, change, message in (
        ("encoder_state", lambda s: without(s, "layer_norm.bias"), "norm.bias is missing"),
        ("quantizer_state", lambda s: s | {"ema": torch.zeros(3)}, r"ema \(3,\) is not part of"),
        ("decoder_state", with_bias(torch.zeros(6)), r"mu.0.bias is \(6,\), expected \(7,\)"),
        ("decoder_state", with_bias(torch.zeros(7).long()), "bias is torch.int64"),
        ("context_state", lambda s: None, "context_state is missing.*the file has ar_model_state"),
        ("context_state", lambda s: {"a": 1}, "does not consist of tensors"),
        ("decoder_state", with_bias(1e300 * torch.ones(7).double()), "bias has NaN or inf"),
        ("decoder_state", with_bias(torch.zeros(7).to_sparse()), "mu.0.bias is sparse"),
        ("decoder_state", with_bias(torch.zeros(7, device="meta")), "bias is .*without data"),
        ("decoder_state", lambda s: s | {"l_index": s["l_index"].flip(1)}, "l_index is not the"),
        ("encoder_state", lambda s: s | {POSITIONS: torch.zeros(1, 40, 512)}, "pos_table is not"),
        ("quantizer_state", lambda s: s | {CODES: 2 * s[CODES]}, "not of unit length"),
        ("quantizer_state", lambda s: s | {VARIANCES: -torch.ones(8)}, "negative variances"),
    ):
        changed = published(**{name: change(published_states[name])})
        with pytest.raises(InvalidInputError, match=message):  # a line for each tensor
            import_published(*changed, ROBOT)


def test_json_files_are_checked(published):
    for file, base, changes, message in (
        ("model_params", without(STAGE1, "d_v"), {}, r"model_params.json: d_v is missing"),
        ("cross_attn", CONTEXT, {"size": 1}, r"cross_attn.json: size is unknown"),
        ("ar_params", SEQUENCE, {"n_heads": "3"}, r"ar_params.json: n_heads is '3'"),
        ("cross_attn", CONTEXT, {"d_context": 6}, "6 is not c_space_dim 7 of the dictionary"),
        ("ar_params", SEQUENCE, {"num_keys": 2}, "num_keys 2 has no codes"),
        ("model_params", STAGE1, {"dropout": 1.5}, "ar: dictionary.transformer.dropout is 1.5"),
        ("ar_params", SEQUENCE, {"d_model": 256}, "one latent width"),
        ("ar_params", SEQUENCE, {"num_keys": 1026}, r"is \(2048, 8\), expected \(1024, 8\)"),
    ):
        refused(message, import_published, *published(**{file: base | changes}), ROBOT)


class Malicious:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def legacy(content, path):
    torch.save(content, path, _use_new_zipfile_serialization=False)


@pytest.mark.parametrize("save", [torch.save, legacy])
def test_a_pickle_that_would_run_code_is_refused(published, tmp_path, save):
    folders = published()
    save({"encoder_state": Malicious(tmp_path / "ran")}, folders[0] / "best_model.pkl")
    refused("is refused: it contains posix.mkdir, .* run code", import_published, *folders, ROBOT)
    assert not (tmp_path / "ran").exists()


@pytest.mark.filterwarnings("error")
def test_files_that_are_no_checkpoint_are_refused_with_their_kind(tmp_path):
    torch.save([1], tmp_path / "list")
    os.mkfifo(tmp_path / "fifo")
    with zipfile.ZipFile(tmp_path / "packed", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(10**6))
    for name, content, message in (
        ("tar", b"\0" * 1024, "tar is a tar archive, not a torch checkpoint; download it again"),
        ("zip", b"PK\x03\x04 broken", "zip is not a torch checkpoint, or is truncated"),
        ("nothing", b"", "nothing is empty"),
        ("page", b"\n<!DOCTYPE html><html><title>Google Drive", "page is a web page"),
        ("pickle", pickle.dumps({"a": Malicious("ran")}), "pickle is not a torch checkpoint"),
        ("list", None, "contains a list"),
        ("fifo", None, "regular"),
        ("packed", None, "packed has compressed records, .*: 'archive/data/0' of 1000000 bytes"),
        ("none", None, "No such file"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        refused(message, read_tensors, tmp_path / name)
