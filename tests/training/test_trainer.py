"""Whole trainings on a tiny dataset: learning, continuing, repeating, refusing."""

import csv
import dataclasses
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from training_data import kinematics, write_dataset

from cli.main import main
from cvqmpt_lab.codec.plain import from_plain, to_plain
from cvqmpt_lab.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.training.dataset import open_dataset
from cvqmpt_lab.training.profiles import PROFILES, Profile, profile_named
from cvqmpt_lab.training.stage_base import OptimizerSettings
from cvqmpt_lab.training.trainer import open_folder, run_training
from cvqmpt_lab.training.training_clouds import CloudSettings
from cvqmpt_lab.vqmpt.beam_search import beam_search
from cvqmpt_lab.vqmpt.checkpoint import load_checkpoint, save_checkpoint
from cvqmpt_lab.vqmpt.config import PointCloudConfig, SetAbstractionConfig, TransformerConfig
from cvqmpt_lab.vqmpt.mpnet_numpy import MPNetNetwork
from cvqmpt_lab.vqmpt.weights import RobotSignature, read_model

SIZES = TransformerConfig(n_layers=2, n_heads=2, d_k=8, d_v=8, d_model=16, d_inner=24)
CLOUD = CloudSettings(points=48)
SMOKE, COMPACT = PROFILES["smoke"], PROFILES["compact"]
FEW = dataclasses.replace(
    SMOKE.stage2.batches, scenes=2, paths_per_scene=3, batches_per_epoch=None, cloud=CLOUD, validation_paths=8
)
TINY = dataclasses.replace(
    COMPACT,
    name="tiny",
    model=dataclasses.replace(
        COMPACT.model,
        dictionary=dataclasses.replace(COMPACT.model.dictionary, transformer=SIZES, n_codes=16),
    ),
    mpnet_model=dataclasses.replace(
        SMOKE.mpnet_model, n_points=48, encoder_widths=(16,), planner_widths=(32, 16)
    ),
    stage1=dataclasses.replace(
        COMPACT.stage1, epochs=2, batch=4, row=16, batches_per_epoch=6, restart_every=4, restart_epochs=1
    ),
    mpnet=dataclasses.replace(SMOKE.mpnet, epochs=2, batches=FEW),
)
"""A dictionary, and MPNet."""
PUBLISHED = dataclasses.replace(
    TINY,
    name="tiny-published",
    link_features=False,
    model=dataclasses.replace(
        SMOKE.model,
        dictionary=dataclasses.replace(SMOKE.model.dictionary, transformer=SIZES, n_codes=16, n_position=200),
        point_cloud=PointCloudConfig(
            sa1=SetAbstractionConfig(ratio=0.5, radius=0.5, widths=(8, 8)),
            sa2=SetAbstractionConfig(ratio=0.5, radius=0.9, widths=(8, 16)),
        ),
        sequence=dataclasses.replace(SMOKE.model.sequence, transformer=SIZES, context=SIZES),
    ),
    stage2=dataclasses.replace(SMOKE.stage2, epochs=2, batches=FEW),
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data") / "d")


@pytest.fixture(scope="module")
def dictionary(tmp_path_factory, data):
    out = tmp_path_factory.mktemp("stage1") / "s1"
    assert go("stage1", data, out).finished
    return out


@pytest.fixture(scope="module")
def published_dictionary(tmp_path_factory, data):
    out = tmp_path_factory.mktemp("stage1") / "published"
    assert go("stage1", data, out, PUBLISHED, epochs=1).finished
    return out


def go(stage, data, out, profile=TINY, report=lambda *progress: None, **options):
    settings = {"device": "cpu", "metadata": {"command": ["test"]}, "report": report, **options}
    return run_training(stage, profile, data, out, **settings)


def curves(out):
    with (out / "curves.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def weights(out):
    return {path.name: path.read_bytes() for path in sorted((out / "model").glob("*.safetensors"))}


# ---------------------------------------------------------------- what comes out


def test_stage_1_leaves_a_dictionary_and_curves(dictionary, data):
    rows = curves(dictionary)
    assert [row["epoch"] for row in rows] == ["1", "2"] and rows[-1]["step"] == "12"
    assert {"train_loss", "validation_nll", "validation_codes_in_use", "validation_mean_std_rad"} <= set(
        rows[0]
    )
    checkpoint = load_checkpoint(dictionary / "model")
    assert checkpoint.sequence_model is None and checkpoint.config.feature_dim == 12
    norms = checkpoint.dictionary.quantizer.embedding.weight.norm(dim=1)
    torch.testing.assert_close(norms, torch.ones_like(norms))
    metadata = checkpoint.metadata
    assert metadata["data_sha256"] == open_dataset(data).sha256 and metadata["seed"] == 0
    assert metadata["command"] == ["test"] and metadata["kinematics"]["points"] == kinematics()["points"]
    assert metadata["losses"]["validation_nll"] == float(
        rows[metadata["losses"]["epoch"] - 1]["validation_nll"]
    )
    assert {p.name for p in dictionary.iterdir()} == {"training.json", "state.pt", "curves.csv", "model"}


def test_stage_2_leaves_a_model_that_predicts(tmp_path, data, published_dictionary):
    assert go("stage2", data, tmp_path / "s2", PUBLISHED, dictionary=published_dictionary).finished
    rows = curves(tmp_path / "s2")
    for name in ("cross_entropy", "cross_entropy_cubes"):
        assert float(rows[0][f"validation_{name}"]) != float(rows[0][f"validation_wrong_cloud_{name}"])
    checkpoint = load_checkpoint(tmp_path / "s2" / "model")
    assert checkpoint.config.kind == "published" and checkpoint.config.feature_dim == 0
    model, words = checkpoint.sequence_model, checkpoint.dictionary
    for name, tensor in load_checkpoint(published_dictionary / "model").dictionary.state_dict().items():
        assert torch.equal(words.state_dict()[name], tensor)
    scene = model.encode_scene(torch.rand(1, 48, 3))
    assert len(beam_search(model.decoder(words, scene, torch.rand(1, 7), torch.rand(1, 7)))) == 1


def test_stage_2_of_a_kind_without_one_is_refused(tmp_path, data, dictionary):
    with pytest.raises(InvalidInputError, match=r"'tiny' has no stage2; profiles with one: smoke, published"):
        go("stage2", data, tmp_path / "s2", dictionary=dictionary)
    assert not (tmp_path / "s2").exists()


def test_mpnet_leaves_a_network(tmp_path, data):
    go("mpnet", data, tmp_path / "m", epochs=1)
    row = curves(tmp_path / "m")[0]
    assert float(row["validation_squared_error"]) != float(row["validation_wrong_cloud_squared_error"])
    network = MPNetNetwork(read_model(tmp_path / "m" / "model"))
    assert network.encode(np.zeros((48, 3))).shape == (28,)


def test_half_precision(tmp_path, data, published_dictionary):
    half = dataclasses.replace(PUBLISHED, stage2=dataclasses.replace(PUBLISHED.stage2, precision="bf16"))
    go("stage2", data, tmp_path / "half", half, dictionary=published_dictionary, epochs=1)
    assert np.isfinite(float(curves(tmp_path / "half")[0]["train_loss"]))


def test_losses_fall(tmp_path, data):
    settings = dataclasses.replace(
        TINY.stage1,
        batches_per_epoch=None,
        optimizer=OptimizerSettings(rate=5e-3, warmup=5, schedule="constant"),
    )
    go("stage1", data, tmp_path / "s1", dataclasses.replace(TINY, stage1=settings), epochs=4)
    nll = [float(row["validation_nll"]) for row in curves(tmp_path / "s1")]
    assert nll[-1] < nll[0] - 1.0


# ---------------------------------------------------------------- continue and repeat


@pytest.mark.parametrize("stage", ["stage1", "stage2", "mpnet"])
def test_a_stopped_training_continues_on_the_same_curve(tmp_path, data, published_dictionary, stage):
    options = {"dictionary": published_dictionary, "profile": PUBLISHED} if stage == "stage2" else {}
    go(stage, data, tmp_path / "whole", **options)

    def stop(done, total, note):
        if done == 1:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        go(stage, data, tmp_path / "parts", report=stop, **options)
    assert not (tmp_path / "parts" / "curves.csv").exists()
    go(stage, data, tmp_path / "parts", **options)
    assert curves(tmp_path / "parts") == curves(tmp_path / "whole")
    assert weights(tmp_path / "parts") == weights(tmp_path / "whole")


def test_more_epochs_continue_where_fewer_ended(tmp_path, data):
    optimizer = dataclasses.replace(TINY.stage1.optimizer, schedule="inverse-sqrt")
    profile = dataclasses.replace(TINY, stage1=dataclasses.replace(TINY.stage1, optimizer=optimizer))
    go("stage1", data, tmp_path / "whole", profile, epochs=2)
    go("stage1", data, tmp_path / "parts", profile, epochs=1)
    assert len(curves(tmp_path / "parts")) == 1
    go("stage1", data, tmp_path / "parts", profile, epochs=2)
    assert curves(tmp_path / "parts") == curves(tmp_path / "whole")
    assert go("stage1", data, tmp_path / "parts", profile, epochs=2).finished  # nothing left to do


def test_a_seed_repeats_and_another_differs(tmp_path, data, dictionary):
    go("stage1", data, tmp_path / "same", workers=1)  # processes that prepare batches change nothing
    assert curves(tmp_path / "same") == curves(dictionary)
    go("stage1", data, tmp_path / "other", seed=1)
    assert curves(tmp_path / "other") != curves(dictionary)


def test_minutes_stop_a_training_and_leave_a_model(tmp_path, data):
    progress = go("stage1", data, tmp_path / "s1", minutes=1e-6)
    assert not progress.finished and progress.step == 1
    assert load_checkpoint(tmp_path / "s1" / "model").metadata["losses"]["step"] == 1
    assert go("stage1", data, tmp_path / "s1").finished
    go("stage1", data, tmp_path / "whole")
    assert curves(tmp_path / "s1") == curves(tmp_path / "whole")


# ---------------------------------------------------------------- what is refused


def test_folders_that_cannot_be_continued(tmp_path, data, dictionary):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    with pytest.raises(InvalidInputError, match="not empty and holds no training"):
        go("stage1", data, tmp_path / "full")
    with pytest.raises(InvalidInputError, match=r"another training \(seed was 0, now 3\)"):
        go("stage1", data, dictionary, seed=3)
    with pytest.raises(InvalidInputError, match=r'another training \(stage was "stage1", now "mpnet"\)'):
        go("mpnet", data, dictionary)
    other = write_dataset(tmp_path / "d", seed=9)
    with pytest.raises(InvalidInputError, match="data_sha256 was"):
        go("stage1", other, dictionary)
    profile = dataclasses.replace(TINY, stage1=dataclasses.replace(TINY.stage1, batch=5))
    with pytest.raises(InvalidInputError, match=r"profile.stage1.batch was 4, now 5"):
        go("stage1", data, dictionary, profile)


def test_damaged_states_are_named(tmp_path, data):
    go("stage1", data, tmp_path / "s1", epochs=1)
    state = tmp_path / "s1" / "state.pt"
    state.write_bytes(state.read_bytes()[:200])
    with pytest.raises(InvalidInputError, match=r"state.pt is damaged"):
        go("stage1", data, tmp_path / "s1")


def test_dictionaries_that_do_not_fit(tmp_path, data, dictionary, published_dictionary):
    out = tmp_path / "s2"
    with pytest.raises(InvalidInputError, match="stage2 needs the dictionary"):
        go("stage2", data, out, PUBLISHED)
    with pytest.raises(InvalidInputError, match="cannot read weights"):
        go("stage2", data, out, PUBLISHED, dictionary=tmp_path / "nowhere")
    with pytest.raises(InvalidInputError, match="stage1 takes no dictionary"):
        go("stage1", data, out, dictionary=dictionary)
    checkpoint = load_checkpoint(published_dictionary / "model")
    robot = RobotSignature("iiwa", checkpoint.robot.lower, checkpoint.robot.upper)
    save_checkpoint(tmp_path / "iiwa", dataclasses.replace(checkpoint, robot=robot))
    with pytest.raises(InvalidInputError, match="weights are for robot 'iiwa', not 'panda'"):
        go("stage2", data, out, PUBLISHED, dictionary=tmp_path / "iiwa")
    with pytest.raises(InvalidInputError, match="kind 'compact', the configuration of kind 'published'"):
        go("stage2", data, out, PUBLISHED, dictionary=dictionary)
    assert not out.exists()


def test_data_and_losses_that_do_not_work(tmp_path, data):
    bare = write_dataset(tmp_path / "bare", kinematics=None)
    with pytest.raises(InvalidInputError, match="takes link positions"):
        go("stage1", bare, tmp_path / "a")
    with pytest.raises(CvqmptError, match="unknown stage 'stage3'"):
        go("stage3", data, tmp_path / "a")
    wild = OptimizerSettings(rate=1e30, warmup=0, schedule="constant")
    profile = dataclasses.replace(TINY, mpnet=dataclasses.replace(TINY.mpnet, optimizer=wild))
    with pytest.raises(InvalidInputError, match=r"loss is .* in epoch 1, batch .*lower optimizer.rate"):
        go("mpnet", data, tmp_path / "a", profile)


def test_a_full_disk_is_one_line_and_leaves_nothing_behind(tmp_path, monkeypatch):
    (tmp_path / "r").mkdir()

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InvalidInputError, match="No space left on device"):
        open_folder(tmp_path / "r", {"a": 1})
    assert not list((tmp_path / "r").iterdir())


def test_a_second_training_in_the_folder_is_refused(tmp_path, data):
    def second(*progress):
        with pytest.raises(InvalidInputError, match=r"s1 is in use by another run"):
            go("stage1", data, tmp_path / "s1", epochs=1)

    assert go("stage1", data, tmp_path / "s1", report=second, epochs=1).finished


def test_a_training_killed_while_it_replaces_its_model_gets_it_back(tmp_path, data):
    whole = tmp_path / "s1"
    go("stage1", data, whole, epochs=1)
    before = weights(whole)
    (whole / "model").rename(whole / ".model.previous-123")
    (whole / ".model.partial-123").mkdir()
    go("stage1", data, whole, epochs=1)
    assert weights(whole) == before
    assert not list(whole.glob(".*"))


# ---------------------------------------------------------------- profiles, command line, small parts


def test_profiles_survive_json():
    for profile in PROFILES.values():
        assert from_plain(Profile, json.loads(json.dumps(to_plain(profile)))) == profile
    with pytest.raises(CvqmptError, match="unknown profile 'big'; valid choices: smoke, compact, published"):
        profile_named("big")
    data = to_plain(SMOKE, complete=True)
    data["stage2"]["batches"]["speed"] = 1
    with pytest.raises(InvalidInputError, match=r"profile.stage2.batches.speed is unknown"):
        from_plain(Profile, data, "profile")
    with pytest.raises(InvalidInputError, match="null to one without"):
        dataclasses.replace(SMOKE, stage2=None)
    data = to_plain(SMOKE, complete=True)
    data["mpnet_model"]["n_points"] = 7
    with pytest.raises(InvalidInputError, match=r"profile: .* must equal mpnet_model\.n_points"):
        from_plain(Profile, data, "profile")


def test_rates():
    published = PROFILES["published"].stage2.optimizer
    assert published.rate_at(2400, 1) == pytest.approx(0.15 * 512**-0.5 * 2400**-0.5)
    assert published.rate_at(9600, 1) == pytest.approx(0.15 * 512**-0.5 * 9600**-0.5)
    assert published.rate_at(600, 1) == pytest.approx(0.15 * 512**-0.5 * 600 * 2400**-1.5)
    cosine = OptimizerSettings(rate=1.0, warmup=10, schedule="cosine", final=0.1)
    assert [cosine.rate_at(s, 110) for s in (5, 10, 60, 110)] == pytest.approx([0.5, 1.0, 0.55, 0.1])


def test_the_command_line(tmp_path, capsys, data):
    config = tmp_path / "mine.json"
    config.write_text(json.dumps(to_plain(TINY)))
    common = ["train", "stage1", "--config", str(config), "--data", str(data), "--device", "cpu"]
    assert main([*common, "--out", str(tmp_path / "s1"), "--epochs", "1"]) == 0
    captured = capsys.readouterr()
    assert "validation_nll" in captured.out and f"model in {tmp_path / 's1' / 'model'}" in captured.out
    assert "stage1 6/6, 0 s left  epoch 1, loss " in captured.err
    assert main(["train", "stage1", "--profile", "smoke", "--print-config"]) == 0
    assert from_plain(Profile, json.loads(capsys.readouterr().out)) == SMOKE
    refusals = {
        "give --out DIR": common,
        "no dataset in": [*common[:4], "--data", str(tmp_path), "--out", str(tmp_path / "x")],
        "unknown device 'tpu'": [*common[:6], "--device", "tpu", "--out", str(tmp_path / "x")],
        "train sequences was removed": ["train", "sequences"],
        "unknown profile 'big'": ["train", "stage1", "--profile", "big"],
        "cannot read": ["train", "stage1", "--config", str(tmp_path / "nowhere.json")],
    }
    for message, words in refusals.items():
        assert main(words) == 2
        error = capsys.readouterr().err
        assert error.startswith("cvqmpt: ") and message in error and error.count("\n") == 1
    assert not Path(tmp_path / "x").exists()
