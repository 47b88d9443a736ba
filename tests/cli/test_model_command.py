"""`cvqmpt model`: report on weights, conversion of published folders, and the weights that ship."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
import torch
from command_line import refused
from published_files import STAGE1
from small_models import random_checkpoint

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.vqmpt.checkpoint import save_checkpoint
from cvqmpt_lab.vqmpt.sequence_predictor import PublishedPredictor
from cvqmpt_lab.vqmpt.weights import (
    WEIGHTS_FOLDER,
    OtherRobotError,
    load_vq_mpt,
    read_model,
    resolve_model,
    robot_signature,
    write_model,
)


def test_published_folders_are_converted_and_predict(
    panda, published, published_states, tmp_path, cvqmpt, capsys
):
    huge = {"mu.0.bias": torch.full((7,), 1e300, dtype=torch.float64)}
    dictionary_dir, ar_dir = published(decoder_state=published_states["decoder_state"] | huge)
    ours = tmp_path / "ours"
    words = f"model import --dictionary-dir {dictionary_dir} --ar-dir {ar_dir} --out {ours}"
    assert "mu.0.bias has NaN or infinite values" in refused(capsys, *words.split())
    assert {path.name for path in tmp_path.iterdir()} == {"dictionary", "ar"}
    published()
    assert "published checkpoint" in cvqmpt(words)
    told = json.loads(cvqmpt("model info --json --model", ours))
    assert told["model"]["dictionary"]["n_position"] == STAGE1["n_position"]
    rng = np.random.default_rng(0)
    q = panda.random_configurations(rng, 2)
    predictor = PublishedPredictor(load_vq_mpt(panda, ours), panda)
    scene = predictor.encode(rng.uniform(-0.5, 0.5, (50, 3)))
    assert len(predictor.hypotheses(scene, q[0], q[1:])[0][0].codes) > 0
    assert "exists and is not empty; choose another --out" in refused(capsys, *words.split())


def test_options_of_the_other_action_are_refused(capsys, tmp_path):
    for words, told in (
        (["info", "--out", tmp_path], "--out is for import; leave it out"),
        (["info", "--ar-dir", tmp_path], "--ar-dir is for import; leave it out"),
        (["import", "--model", "mpnet"], "--model is for info; give --out"),
    ):
        assert told in refused(capsys, "model", *words)


def test_weights_of_a_training_need_no_import(panda, capsys, tmp_path):
    trained = tmp_path / "stage1" / "model"
    save_checkpoint(trained, random_checkpoint(panda))
    for folders in ((trained.parent, tmp_path), (tmp_path, trained.parent), (trained, tmp_path)):
        words = ("--dictionary-dir", folders[0], "--ar-dir", folders[1], "--out", tmp_path / "out")
        told = refused(capsys, "model", "import", *words)
        assert f"{trained} has weights of this toolkit, which need no import" in told


def test_models_are_found_by_name_or_folder_for_one_robot(panda, slider_arm, tmp_path):
    assert resolve_model() == resolve_model("vq_mpt") == WEIGHTS_FOLDER / "vq_mpt"
    found = resolve_model(architecture="mpnet", robot=robot_signature(panda))
    assert found == resolve_model("mpnet") == WEIGHTS_FOLDER / "mpnet"
    checkpoint = random_checkpoint(panda)
    save_checkpoint(tmp_path / "run" / "model", checkpoint)
    assert resolve_model(tmp_path / "run") == tmp_path / "run" / "model"
    assert load_vq_mpt(panda, tmp_path / "run" / "model").config == checkpoint.config
    with pytest.raises(InvalidInputError, match="architecture is 'vq-mpt'; expected 'mpnet'"):
        resolve_model(tmp_path / "run", "mpnet")
    with pytest.raises(OtherRobotError, match=r"for robot 'panda', not .*: 7 joints, not 4"):
        load_vq_mpt(slider_arm, tmp_path / "run")
    with pytest.raises(InvalidInputError, match="no weights in gnn; give one of vq_mpt, or the"):
        load_vq_mpt(panda, "gnn")


def test_weights_that_no_planner_can_use_are_refused(tmp_path, capsys):
    model = read_model(WEIGHTS_FOLDER / "mpnet")
    arrays = dict(model.parts["mpnet"])
    bias = arrays.pop("out.bias")
    write_model(tmp_path / "short", replace(model, parts={"mpnet": arrays}))
    told = refused(capsys, "model", "info", "--model", tmp_path / "short")
    assert "mpnet does not fit its configuration: out.bias is missing" in told

    write_model(tmp_path / "nan", model)
    data = safetensors.numpy.save(arrays | {"out.bias": np.full_like(bias, np.nan)})
    (tmp_path / "nan" / "mpnet.safetensors").write_bytes(data)
    config = tmp_path / "nan" / "config.json"
    fields = json.loads(config.read_text())
    fields["sha256"]["mpnet"] = hashlib.sha256(data).hexdigest()
    config.write_text(json.dumps(fields))
    told = refused(capsys, "model", "info", "--model", tmp_path / "nan")
    assert "mpnet.safetensors: out.bias has NaN or infinite values" in told


def test_a_transformer_beside_another_dictionary_is_refused(panda, tmp_path, capsys):
    model, name = load_vq_mpt(panda), "quantizer.embedding.weight"
    dictionary = dict(model.parts["dictionary"])
    dictionary[name] = np.roll(dictionary[name], 1, axis=0)
    write_model(tmp_path / "mixed", replace(model, parts={**model.parts, "dictionary": dictionary}))
    said = refused(capsys, "model", "info", "--model", tmp_path / "mixed")
    assert "trained on the codes of another dictionary; train one: cvqmpt train transformer" in said
