"""Conversion of folders laid out like the published ones."""

import os
import pickle

import pytest
import torch
from published_files import CONTEXT, SEQUENCE, STAGE1

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt.checkpoint import (
    import_published,
    load_checkpoint,
    read_tensors,
    save_checkpoint,
)
from cvqmpt_lab.vqmpt.weights import RobotSignature

ROBOT = RobotSignature("arm", (-1.0,) * 7, (2.0,) * 7)


def test_published_folders_become_a_model_that_runs(published, published_states, tmp_path):
    imported = import_published(*published(), ROBOT)
    modules = imported.modules
    network, dictionary = modules["sequence_model"], modules["dictionary"]
    assert imported.metadata["epochs"] == [7, 7]
    for name, tensor in published_states["context_state"].items():
        assert torch.equal(network.context.state_dict()[name], tensor)
    codes = dictionary.encode(torch.rand(1, 4, 7))
    scene = network.encode_scene([torch.rand(30, 3)])
    context = network.encode_context(scene, torch.rand(1, 7), torch.rand(1, 7))
    logits = network.prefix_logits(context, codes, dictionary.quantizer)
    assert logits.shape == (1, 2050) and torch.isfinite(logits).all()
    save_checkpoint(tmp_path / "ours", imported)
    after = load_checkpoint(tmp_path / "ours", ROBOT).modules["sequence_model"]
    assert after.state_dict().keys() == network.state_dict().keys()
    for name, tensor in network.state_dict().items():
        assert torch.equal(after.state_dict()[name], tensor)


def without(state, name):
    return {key: tensor for key, tensor in state.items() if key != name}


def with_bias(bias):
    return lambda state: state | {"mu.0.bias": bias}


def scaled(state):
    return state | {"embedding.weight": 2 * state["embedding.weight"]}


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("encoder_state", lambda s: without(s, "layer_norm.bias"), "norm.bias is missing"),
        (
            "quantizer_state",
            lambda s: s | {"ema": torch.zeros(3)},
            r"ema \(3,\) is left over",
        ),
        ("decoder_state", with_bias(torch.zeros(6)), r"mu.0.bias is \(6,\), expected \(7,\)"),
        ("decoder_state", with_bias(torch.zeros(7).long()), "bias is torch.int64"),
        ("context_state", lambda s: None, "context_state is missing.*the file has ar_model_state"),
        ("context_state", lambda s: {"a": 1}, "not made of tensors"),
        ("decoder_state", with_bias(1e300 * torch.ones(7).double()), "bias has NaN or inf"),
        ("decoder_state", with_bias(torch.zeros(7).to_sparse()), "mu.0.bias is sparse"),
        ("decoder_state", with_bias(torch.zeros(7, device="meta")), "bias is .*without data"),
        ("decoder_state", lambda s: s | {"l_index": s["l_index"].flip(1)}, "l_index is not that"),
        (
            "encoder_state",
            lambda s: s | {"position_enc.pos_table": torch.zeros(1, 40, 512)},
            "pos_table is not that of this model",
        ),
        ("quantizer_state", scaled, "not of unit length"),
        (
            "quantizer_state",
            lambda s: s | {"batch_norm.running_var": -torch.ones(8)},
            "negative variances",
        ),
    ],
)
def test_tensors_that_do_not_fit_are_listed(published, published_states, name, change, message):
    with pytest.raises(InvalidInputError, match=message):
        import_published(*published(**{name: change(published_states[name])}), ROBOT)


@pytest.mark.parametrize(
    ("file", "base", "changes", "message"),
    [
        ("model_params", without(STAGE1, "d_v"), {}, r"model_params.json: d_v is missing"),
        ("cross_attn", CONTEXT, {"size": 1}, r"cross_attn.json: size is unknown"),
        ("ar_params", SEQUENCE, {"n_heads": "3"}, r"ar_params.json: n_heads is '3'"),
        ("cross_attn", CONTEXT, {"d_context": 6}, "6 is not the dictionary's c_space_dim 7"),
        ("ar_params", SEQUENCE, {"num_keys": 2}, "num_keys 2 has no codes"),
        ("model_params", STAGE1, {"n_position": 10**12}, "is 1000000000000; it must be 1 to 65536"),
        (
            "model_params",
            STAGE1,
            {"dropout": 1.5},
            "ar: dictionary.transformer.dropout is 1.5",
        ),
        ("cross_attn", CONTEXT, {"n_layers": 10**6}, r"n_layers is 1000000; it must be 1 to 64"),
        ("ar_params", SEQUENCE, {"d_model": 256}, "one latent width"),
        ("ar_params", SEQUENCE, {"num_keys": 1026}, r"is \(2048, 8\), expected \(1024, 8\)"),
    ],
)
def test_json_files_are_checked(published, file, base, changes, message):
    with pytest.raises(InvalidInputError, match=message):
        import_published(*published(**{file: base | changes}), ROBOT)


class Malicious:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def legacy(content, path):
    torch.save(content, path, _use_new_zipfile_serialization=False)


@pytest.mark.parametrize("save", [torch.save, legacy])
def test_a_pickle_that_wants_to_run_code_is_refused(published, tmp_path, save):
    folders = published()
    save({"encoder_state": Malicious(tmp_path / "ran")}, folders[0] / "best_model.pkl")
    with pytest.raises(
        InvalidInputError, match=r"is refused: it holds posix.mkdir, .* run code"
    ) as caught:
        import_published(*folders, ROBOT)
    assert "\n" not in str(caught.value) and not (tmp_path / "ran").exists()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"PK\x03\x04 broken", "is no torch checkpoint, or cut short"),
        (b"", "is empty"),
        (b"\n<!DOCTYPE html><html><title>Google Drive", "is a web page"),
        (pickle.dumps({"a": Malicious("ran")}), "is no torch checkpoint"),
    ],
)
def test_files_that_are_something_else_are_called_what_they_are(tmp_path, content, message):
    (tmp_path / "x.pkl").write_bytes(content)
    with pytest.raises(InvalidInputError, match=rf"x\.pkl {message}") as caught:
        read_tensors(tmp_path / "x.pkl")
    assert "\n" not in str(caught.value)


def test_files_that_hold_no_states_are_refused(tmp_path):
    torch.save([1], tmp_path / "list.pkl")
    os.mkfifo(tmp_path / "fifo.pkl")
    for name, message in (("list", "holds a list"), ("fifo", "regular"), ("none", "No such file")):
        with pytest.raises(InvalidInputError, match=message):
            read_tensors(tmp_path / f"{name}.pkl")
