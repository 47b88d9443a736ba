"""`cvqmpt model`: report on weights, conversion of published folders, and the weights that ship."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from small_models import random_checkpoint
from test_published_checkpoint import STAGE1, published, states  # noqa: F401 (fixtures)

from cli.main import main
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.models.checkpoint import load_checkpoint, save_checkpoint
from cvqmpt_lab.models.mpnet.network import MPNet, MPNetCheckpoint, MPNetConfig, save_mpnet
from cvqmpt_lab.models.weights_folder import checkpoint_sha256
from cvqmpt_lab.prediction.configurations import robot_signature
from cvqmpt_lab.prediction.predictor import Predictor, PredictorSettings
from cvqmpt_lab.prediction.shipped import load_shipped, load_shipped_mpnet, shipped_model_folder

ROOT = Path(__file__).resolve().parents[2]


def refused(capsys, *words):
    code = main(["model", *map(str, words)])
    captured = capsys.readouterr()
    assert code == 2 and captured.out == "" and len(captured.err.splitlines()) == 1, captured
    return captured.err


def sections(text):
    """Configuration and training as printed."""
    configuration, training = text.split("\nconfiguration\n")[1].split("\ntraining\n")
    return json.loads(configuration), json.loads(training)


def test_info_tells_what_is_in_a_folder(panda, tmp_path, capsys):
    checkpoint = random_checkpoint(panda, metadata={"seed": 3, "kinematics": {"points": [1]}})
    save_checkpoint(tmp_path / "model", checkpoint)
    assert main(["model", "info", "--model", str(tmp_path / "model")]) == 0
    text = capsys.readouterr().out
    assert "architecture  vq-mpt, compact" in text and "robot         panda, joints -2.8973..2.8973, " in text
    assert checkpoint_sha256(tmp_path / "model") in text
    listed = json.loads((tmp_path / "model" / "config.json").read_text())["sha256"]
    for name, module in checkpoint.parts.items():
        (line,) = [line for line in text.splitlines() if line.startswith(f"{name}.safetensors")]
        _, size, count, digest = line.split()
        assert int(size.replace(",", "")) == (tmp_path / "model" / f"{name}.safetensors").stat().st_size
        assert int(count.replace(",", "")) == sum(p.numel() for p in module.parameters())
        assert digest == listed[name]
    configuration, training = sections(text)
    assert configuration == checkpoint.config.to_json()
    assert training == {"seed": 3, "kinematics": "..."}


def test_info_reads_mpnet_too(panda, tmp_path, capsys):
    network = MPNet(MPNetConfig(n_points=16, encoder_widths=(8,), code_dim=4, planner_widths=(8, 8)))
    save_mpnet(tmp_path, MPNetCheckpoint(robot_signature(panda), network, {"epochs": 1}))
    assert main(["model", "info", "--model", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "architecture  mpnet" in text and "mpnet.safetensors" in text
    assert sections(text)[0]["n_points"] == 16
    assert load_shipped_mpnet(panda, linked(tmp_path, "mpnet")).network.config == network.config


def linked(folder, name):
    """A folder of weights as the package has it."""
    weights = folder.parent / "weights"
    weights.mkdir()
    (weights / name).symlink_to(folder)
    return weights


def test_published_folders_are_converted_and_predict(panda, published, tmp_path, capsys):  # noqa: F811
    dictionary_dir, ar_dir = published()
    out = tmp_path / "ours"
    words = ["model", "import", "--dictionary-dir", dictionary_dir, "--ar-dir", ar_dir, "--out", out]
    assert main([str(word) for word in words]) == 0
    text = capsys.readouterr().out
    for name in ("encoder_state", "quantizer_state", "decoder_state", "context_state", "ar_model_state"):
        assert f"\n{name} " in text
    assert "epochs: dictionary 7, sequence model 7\nnot used: epoch, n_steps, optimizer" in text
    assert sections(text)[0]["dictionary"]["n_position"] == STAGE1["n_position"]
    checkpoint = load_checkpoint(out, robot_signature(panda))
    source = torch.load(ar_dir / "best_model.pkl", weights_only=False)["ar_model_state"]
    for name, tensor in checkpoint.sequence_model.autoregressive.state_dict().items():
        assert torch.equal(tensor, source[name])
    rng = np.random.default_rng(0)
    q = panda.random_configurations(rng, 2)
    predictor = Predictor(checkpoint, panda, PredictorSettings(decoding="beam", max_length=5))
    prediction = predictor.predict(rng.uniform(-0.5, 0.5, (50, 3)), q[0], q[1:], rng)
    assert len(prediction.sequences[0][0].codes) > 0
    again = refused(capsys, *words[1:])
    assert "is there and not empty; choose another --out" in again


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["show"], "unknown action 'show'; valid choices: info, import"),
        (["import", "--out", "x"], "import: give --dictionary-dir DIR"),
        (["import", "--dictionary-dir", "x", "--ar-dir", "y"], "import: give --out DIR"),
        (["import", "--dictionary-dir", "x", "--ar-dir", "y", "--out", "z"], "x/model_params.json: No such file"),
        (["info", "--model", "nowhere"], "nowhere/config.json: No such file"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert message in refused(capsys, *words)
    assert list(tmp_path.iterdir()) == []


def test_damaged_and_foreign_folders(panda, tmp_path, capsys):
    save_checkpoint(tmp_path / "model", random_checkpoint(panda))
    weights = tmp_path / "model" / "dictionary.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4] + b"\0\0\0\1")
    assert "dictionary.safetensors is damaged" in refused(capsys, "info", "--model", tmp_path / "model")
    (tmp_path / "model" / "config.json").write_text('{"architecture": "rrt"}')
    message = refused(capsys, "info", "--model", tmp_path / "model")
    assert "'rrt'; valid choices: vq-mpt, mpnet" in message


def test_shipped_weights_are_found_or_missed_kindly(panda, slider_arm, tmp_path):
    with pytest.raises(InvalidInputError, match=r"no weights of 'vq_mpt' in .*; name the folder of a model"):
        load_shipped(panda, tmp_path)
    checkpoint = random_checkpoint(panda)
    save_checkpoint(tmp_path / "vq_mpt", checkpoint)
    loaded = load_shipped(panda, tmp_path)
    assert loaded.config == checkpoint.config
    with pytest.raises(InvalidInputError, match="weights are for robot 'panda'"):
        load_shipped(slider_arm, tmp_path)
    with pytest.raises(UnknownChoiceError, match="unknown shipped model 'gnn'; valid choices: vq_mpt, mpnet"):
        shipped_model_folder("gnn")


def test_weights_folders_are_part_of_the_package(tmp_path):
    """A small tree with this project's settings, built."""
    for name in ("pyproject.toml", "README.md", "LICENSE", "cvqmpt_lab/__init__.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    files = [f"cvqmpt_lab/weights/vq_mpt/{name}" for name in ("config.json", "README.md", "x.safetensors")]
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("{}")
    command = [
        sys.executable,
        "-W",
        "ignore",
        "-c",
        "from setuptools import setup; setup()",
        "build_py",
        "-d",
        "out",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [name for name in files if not (tmp_path / "out" / name).is_file()] == []
