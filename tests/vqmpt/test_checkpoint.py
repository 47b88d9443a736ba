"""Weights on disk: round trips, and every kind of damage named."""

import json
import os

import pytest
import torch

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.vqmpt import weights as weights_folder
from cvqmpt_lab.vqmpt.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from cvqmpt_lab.vqmpt.config import DictionaryConfig, ModelConfig, TransformerConfig
from cvqmpt_lab.vqmpt.dictionary import Dictionary
from cvqmpt_lab.vqmpt.weights import RobotSignature, weights_digest

ROBOT = RobotSignature("arm", (-1.0,) * 7, (2.0,) * 7)
SIZES = TransformerConfig(n_layers=1, n_heads=1, d_k=4, d_v=4, d_model=8, d_inner=8)
CONFIG = ModelConfig(
    kind="compact",
    dictionary=DictionaryConfig(transformer=SIZES, n_position=5, n_codes=6),
    point_cloud=None,
    sequence=None,
)


@pytest.fixture
def folder(tmp_path):
    save_checkpoint(tmp_path / "model", Checkpoint(CONFIG, ROBOT, Dictionary(CONFIG), metadata={"note": 1}))
    return tmp_path / "model"


def test_round_trip(folder):
    loaded = load_checkpoint(folder, ROBOT)
    assert (loaded.config, loaded.robot, loaded.metadata) == (CONFIG, ROBOT, {"note": 1})
    assert loaded.sequence_model is None and not loaded.dictionary.training
    other = Dictionary(CONFIG)
    first = weights_digest(folder)
    save_checkpoint(folder, Checkpoint(CONFIG, ROBOT, other))  # replaces
    for name, tensor in load_checkpoint(folder).dictionary.state_dict().items():
        assert torch.equal(tensor, other.state_dict()[name])
    assert weights_digest(folder) != first
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


def test_a_full_disk_leaves_the_earlier_checkpoint(folder, monkeypatch):
    before = weights_digest(folder)

    def full(*_):
        raise OSError(28, "No space left on device")

    for name in ("write_bytes", "_move_into_place"):
        with monkeypatch.context() as patch:
            patch.setattr(weights_folder, name, full)
            with pytest.raises(InvalidInputError, match="No space left"):
                save_checkpoint(folder, Checkpoint(CONFIG, ROBOT, Dictionary(CONFIG)))
    assert weights_digest(folder) == before
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


def test_damage_is_named(folder):
    weights = folder / "dictionary.safetensors"
    data = weights.read_bytes()
    weights.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(InvalidInputError, match=r"dictionary\.safetensors is damaged: sha256"):
        load_checkpoint(folder)
    weights.unlink()
    with pytest.raises(InvalidInputError, match=r"dictionary\.safetensors: No such file"):
        load_checkpoint(folder)
    with pytest.raises(InvalidInputError, match=r"config\.json: No such file"):
        load_checkpoint(folder.parent)


def edit(folder, change):
    path = folder / "config.json"
    description = json.loads(path.read_text())
    change(description)
    path.write_text(json.dumps(description))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda d: d["model"]["dictionary"].update(n_codes=9),
            r"embedding.weight is \(6, 8\), expected \(9, 8\)",
        ),
        (lambda d: d["model"]["dictionary"]["transformer"].update(n_layers=2), "layer_stack.1.*is missing"),
        (lambda d: d["model"]["dictionary"]["transformer"].update(n_layers=0), "n_layers is 0; give 1 to 64"),
        (lambda d: d["model"]["dictionary"].update(encoder="mlp"), "and [0-9]+ more"),
        (lambda d: d.update(format="2"), "format is '2'"),
        (lambda d: d.pop("metadata"), "metadata is None"),
        (lambda d: d["sha256"].clear(), "sha256 lists nothing; it must list dictionary"),
        (lambda d: d.update(architecture="mpnet"), "architecture is 'mpnet'; expected 'vq-mpt'"),
        (lambda d: d["robot"].pop("lower"), "robot.lower is missing"),
        (lambda d: d["robot"].update(lower=[0.0], upper=[1.0]), "limits of 1 joints"),
    ],
)
def test_config_and_tensors_must_agree(folder, change, message):
    edit(folder, change)
    with pytest.raises(InvalidInputError, match=message):
        load_checkpoint(folder)


def test_config_that_is_not_json(folder):
    (folder / "config.json").write_text("{")
    with pytest.raises(InvalidInputError, match="is not json"):
        load_checkpoint(folder)


def test_weights_that_are_not_finite_are_not_written(tmp_path):
    dictionary = Dictionary(CONFIG)
    with torch.no_grad():
        dictionary.decoder.mu[0].bias[0] = torch.nan
    with pytest.raises(InvalidInputError, match=r"decoder\.mu\.0\.bias has NaN"):
        save_checkpoint(tmp_path / "m", Checkpoint(CONFIG, ROBOT, dictionary))
    assert list(tmp_path.iterdir()) == []


def test_sizes_without_weights_to_bear_them_out_cost_nothing(folder):
    """60 000 codes of width 60 000 would be 14 GB."""
    edit(folder, lambda d: d["model"]["dictionary"].update(n_codes=60_000, code_dim=60_000))
    with pytest.raises(InvalidInputError, match=r"embedding.weight is \(6, 8\), expected \(60000, 60000\)"):
        load_checkpoint(folder)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param('{"a": ' * 100_000, id="nested"),
        pytest.param('{"a": 1, "a": 2}', id="key twice"),
        "[]",
        "",
    ],
)
def test_configs_that_are_no_objects_are_one_line(folder, text):
    (folder / "config.json").write_text(text)
    with pytest.raises(InvalidInputError) as caught:
        load_checkpoint(folder)
    assert "config.json" in str(caught.value) and "\n" not in str(caught.value)


def test_pipes_are_not_waited_for(folder):
    for name in ("config.json", "dictionary.safetensors"):
        whole = (folder / name).read_bytes()
        (folder / name).unlink()
        os.mkfifo(folder / name)
        with pytest.raises(InvalidInputError, match=f"{name}: it is not a regular file"):
            load_checkpoint(folder)
        (folder / name).unlink()
        (folder / name).write_bytes(whole)
