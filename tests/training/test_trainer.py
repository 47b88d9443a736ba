"""Whole trainings on a tiny dataset; fine-tuning of the scene transformer on labels."""

import csv
import dataclasses
import json
import os
import signal
from dataclasses import replace

import pytest
import torch
from command_line import refused as command_refused
from refusals import refused
from training_data import kinematics, write_dataset

from cvqmpt_lab.base.codec import from_plain, to_plain
from cvqmpt_lab.base.errors import CvqmptError
from cvqmpt_lab.training.dataset import open_dataset
from cvqmpt_lab.training.generation import generate
from cvqmpt_lab.training.profiles import PROFILES, Profile
from cvqmpt_lab.training.roadmap_labels import RoadmapRecipe
from cvqmpt_lab.training.stage import OptimizerSettings
from cvqmpt_lab.training.trainer import Effort, run_training
from cvqmpt_lab.vqmpt.checkpoint import load_checkpoint, save_checkpoint
from cvqmpt_lab.vqmpt.weights import VQ_MPT, RobotSignature, resolve_model

SMOKE = PROFILES["smoke"]


def changed(profile, changes):
    """Return a profile with other values of fields, which are given by dotted names."""
    plain = to_plain(profile, complete=True)
    for name, value in changes.items():
        *path, last = name.split(".")
        part = plain
        for word in path:
            part = part[word]
        part[last] = {**part[last], **value} if isinstance(value, dict) else value
    return from_plain(Profile, plain, "profile")


SIZES = {"n_layers": 2, "n_heads": 2, "d_k": 8, "d_v": 8, "d_model": 16, "d_inner": 24}
STAGE1 = {"epochs": 2, "batch": 4, "row": 16, "batches_per_epoch": 6}
STAGE1 |= {"restart_every": 4, "restart_epochs": 1}
FEW = {"scenes": 2, "paths_per_scene": 3, "batches_per_epoch": None, "validation_paths": 8}
FEW |= {"cloud": {"points": 48}}
MPNET = {
    "mpnet": {"epochs": 2},
    "mpnet.batches": {**to_plain(SMOKE.mpnet.batches, complete=True), **FEW},
    "mpnet_model": {"n_points": 48, "encoder_widths": [16], "planner_widths": [32, 16]},
}
WORDS = {"model.dictionary.transformer": SIZES, "model.dictionary.n_codes": 16}
TINY = changed(PROFILES["compact"], {"name": "tiny", "stage1": STAGE1, **WORDS, **MPNET})
LEVELS = {
    "sa1": {"ratio": 0.5, "radius": 0.5, "widths": [8, 8]},
    "sa2": {"ratio": 0.5, "radius": 0.9, "widths": [8, 16]},
}
SEQUENCE = {"transformer": SIZES, "context": SIZES}
MODEL = {"point_cloud": LEVELS, "sequence": SEQUENCE}
PUBLISHED = {"model": MODEL, "published_model": MODEL, "model.dictionary.n_position": 200}
PUBLISHED |= {"published": {"batches_per_epoch": 4, "paths": 4, "cloud": {"points": 48}}}
PUBLISHED = changed(SMOKE, {"stage1": STAGE1, **WORDS, **MPNET, **PUBLISHED})


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
    effort = {key: options.pop(key) for key in Effort._fields if key in options}
    settings = {"metadata": {"command": ["test"]}, "report": report, **options}
    effort = Effort(**({"device": "cpu"} | effort))
    return run_training(stage, profile, data, out, effort=effort, **settings)


def curves(out):
    with (out / "curves.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def weights(out):
    return {path.name: path.read_bytes() for path in sorted((out / "model").glob("*.safetensors"))}


def test_stage_1_leaves_a_dictionary_and_curves(dictionary, data):
    rows = curves(dictionary)
    assert [row["epoch"] for row in rows] == ["1", "2"] and rows[-1]["step"] == "12"
    checkpoint = load_checkpoint(dictionary / "model")
    assert [*checkpoint.modules] == ["dictionary"] and checkpoint.config.feature_dim == 12
    norms = checkpoint.modules["dictionary"].quantizer.embedding.weight.norm(dim=1)
    torch.testing.assert_close(norms, torch.ones_like(norms))
    metadata = checkpoint.metadata
    losses = metadata["losses"]
    assert metadata["data_sha256"] == open_dataset(data).sha256 and metadata["seed"] == 0
    assert metadata["kinematics"]["points"] == kinematics()["points"]
    assert losses["validation_nll"] == float(rows[losses["epoch"] - 1]["validation_nll"])
    files = {path.name for path in dictionary.iterdir()}
    assert files == {"training.json", "state.pt", "curves.csv", "model"}


def test_the_authors_network_learns_from_paths(tmp_path, data, published_dictionary):
    """Training in half precision; `test_a_stopped_training_continues` uses full precision."""
    profile = changed(PUBLISHED, {"published.precision": "bf16"})
    out = tmp_path / "out"
    go("published", data, out, profile, dictionary=published_dictionary, epochs=1)
    row = curves(out)[0]
    own = float(row["validation_cross_entropy_all"])
    assert own == float(row["validation_loss"])
    assert own != float(row["validation_wrong_cloud_cross_entropy_all"])
    words = load_checkpoint(out / "model").modules["dictionary"]
    before = load_checkpoint(published_dictionary / "model").modules["dictionary"]
    for name, tensor in before.state_dict().items():
        assert torch.equal(words.state_dict()[name], tensor)


@pytest.mark.parametrize(
    ("stage", "at"), [("stage1", 1), ("stage1", 6), ("published", 6), ("mpnet", 1)]
)
def test_a_stopped_training_continues(tmp_path, data, published_dictionary, stage, at):
    words = {"dictionary": published_dictionary, "profile": PUBLISHED}
    options = words if stage == "published" else {}
    whole = go(stage, data, tmp_path / "whole", **options)
    # within the first epoch, or at its end
    at = min(at, whole.step // 2)

    def stop(done, total, note):
        if done == at:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        go(stage, data, tmp_path / "parts", report=stop, **options)
    assert not (tmp_path / "parts" / "curves.csv").exists()
    go(stage, data, tmp_path / "parts", **options)
    assert curves(tmp_path / "parts") == curves(tmp_path / "whole")
    assert weights(tmp_path / "parts") == weights(tmp_path / "whole")


def test_the_model_does_not_depend_on_where_the_time_limit_stopped_a_training(tmp_path, data):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    go("stage1", data, whole)
    first = None
    for step in range(1, 12):  # each call takes one step; an epoch has 6
        assert not go("stage1", data, parts, minutes=1e-9).finished
        if step == 6:
            first = weights(parts)
    # in the second epoch the model is better after each step, but no epoch of it is whole
    assert weights(parts) == first
    go("stage1", data, parts)
    assert curves(parts) == curves(whole) and weights(parts) == weights(whole)


def test_a_seed_repeats_and_another_differs(tmp_path, data, dictionary):
    # processes that prepare batches change nothing
    go("stage1", data, tmp_path / "same", workers=1)
    assert curves(tmp_path / "same") == curves(dictionary)
    go("stage1", data, tmp_path / "other", seed=1)
    assert curves(tmp_path / "other") != curves(dictionary)


def test_what_does_not_fit_is_refused_first(tmp_path, data, dictionary, published_dictionary):
    words = load_checkpoint(published_dictionary / "model")
    iiwa = RobotSignature("iiwa", words.robot.lower, words.robot.upper)
    save_checkpoint(tmp_path / "iiwa", dataclasses.replace(words, robot=iiwa))
    bare = write_dataset(tmp_path / "bare", kinematics=None)
    iiwa = tmp_path / "iiwa"
    for message, stage, source, profile, words in (
        ("no weights in", "published", data, PUBLISHED, tmp_path / "nowhere"),
        ("weights are for robot 'iiwa', not 'panda'", "published", data, PUBLISHED, iiwa),
        ("holds paths, not labels on a roadmap; make", "transformer", data, TINY, dictionary),
        ("stage1 takes no dictionary", "stage1", data, TINY, dictionary),
        ("mpnet takes no dictionary", "mpnet", data, TINY, dictionary),
        ("unknown stage 'stage3'", "stage3", data, TINY, None),
        ("takes link positions", "stage1", bare, TINY, None),
    ):
        out = tmp_path / "out"
        refused(message, go, stage, source, out, profile, dictionary=words, error=CvqmptError)
    assert not (tmp_path / "out").exists()


def test_folders_that_cannot_be_continued(tmp_path, data, dictionary):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    other, profile = write_dataset(tmp_path / "d", seed=9), changed(TINY, {"stage1.batch": 5})
    for message, stage, source, out, options in (
        ("holds no training", "stage1", data, tmp_path / "full", {}),
        ("seed was 0, now 3", "stage1", data, dictionary, {"seed": 3}),
        ('stage was "stage1"', "mpnet", data, dictionary, {}),
        ("data_sha256 was", "stage1", other, dictionary, {}),
        ("batch was 4, now 5", "stage1", data, dictionary, {"profile": profile}),
    ):
        refused(message, go, stage, source, out, **options)


def test_damaged_states_and_losses_that_are_not_finite_are_named(tmp_path, data):
    with pytest.raises(KeyboardInterrupt):
        go("stage1", data, tmp_path / "s1", report=lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    state = tmp_path / "s1" / "state.pt"
    state.write_bytes(state.read_bytes()[:200])
    refused(r"state.pt is damaged", go, "stage1", data, tmp_path / "s1")
    wild = {"rate": 1e30, "warmup": 0, "schedule": "constant"}
    told, wild = r"loss is .* in epoch 1, .*lower optimizer.rate", {"mpnet.optimizer": wild}
    refused(told, go, "mpnet", data, tmp_path / "a", changed(TINY, wild))


def test_one_training_at_a_time_gets_back_a_model_that_was_being_replaced(tmp_path, data):
    def second(*progress):
        refused("s1 is in use by another run", go, "stage1", data, whole, epochs=1)

    whole = tmp_path / "s1"
    assert go("stage1", data, whole, report=second, epochs=1).finished
    before = weights(whole)
    (whole / "model").rename(whole / ".model.earlier")
    go("stage1", data, whole, epochs=1)
    assert weights(whole) == before


def test_profiles_survive_json_and_give_rates():
    for profile in PROFILES.values():
        assert from_plain(Profile, json.loads(json.dumps(to_plain(profile)))) == profile
    refused("speed is unknown", changed, SMOKE, {"mpnet.batches.speed": 1})
    refused("must equal", changed, SMOKE, {"mpnet_model.n_points": 7})
    published = PROFILES["published"].published.optimizer
    for step, factor in ((600, 600 * 2400**-1.5), (2400, 2400**-0.5), (9600, 9600**-0.5)):
        assert published.rate_at(step, 1) == pytest.approx(0.15 * 512**-0.5 * factor)
    assert PROFILES["published"].stage1.optimizer.rate == 0.2 * 512**-0.5 * 20000**-0.5
    cosine = OptimizerSettings(rate=1.0, warmup=10, schedule="cosine", final=0.1)
    found = [cosine.rate_at(step, 110) for step in (5, 10, 60, 110)]
    assert found == pytest.approx([0.5, 1.0, 0.55, 0.1])


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("stage1.validation_paths", 0),
        ("stage1.trivial_share", -1.0),
        ("stage1.epochs", 0),
        ("stage1.optimizer.rate", -1.0),
        ("stage1.optimizer.betas", (2.0, 0.9)),
        ("mpnet.batches.trivial_share", 1.5),
        ("mpnet.batches.cloud.noise", -0.1),
        ("published.cloud.occlusion", 2.0),
    ],
)
def test_settings_with_which_no_training_can_run_are_named(field, value):
    refused(rf"{field}.* is .*; it must be", changed, TINY, {field: value})


def test_the_command_line(tmp_path, cvqmpt, capsys, data):
    config, out = tmp_path / "mine.json", str(tmp_path / "x")
    config.write_text(json.dumps(to_plain(TINY)))
    dense = tmp_path / "dense.json"
    plain = to_plain(PROFILES["published"], complete=True)
    plain["published_model"]["dense"] = True
    dense.write_text(json.dumps(plain))
    told = cvqmpt("train stage1 --profile smoke --print-config")
    assert from_plain(Profile, json.loads(told)) == SMOKE
    given = ["--config", config, "--data", data, "--out", out]
    for message, words in {
        "no dataset in": ["stage1", *given[:2], "--data", tmp_path, "--out", out],
        "unknown device 'tpu'": ["stage1", *given, "--device", "tpu"],
        "'sequences'; valid choices: stage1, mpnet": ["sequences", *given],
        "published_model.dense is unknown": ["stage1", "--config", dense],
    }.items():
        assert message in command_refused(capsys, "train", *words)
    assert not (tmp_path / "x").exists()


CPU = torch.device("cpu")
LABELLED = {"scenes": 2, "paths": 8, "goals": 2, "precision": "float32", "validation_scenes": 2}


@pytest.fixture(scope="module")
def labels(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    generate(RoadmapRecipe(4, 40, ("table", "shelves")), folder, ["test"])
    return folder


def stage_of(labels, profile, **settings):
    """Return a stage and its first batch."""
    profile = PROFILES[profile]
    profile = replace(profile, transformer=replace(profile.transformer, **LABELLED, **settings))
    stage = profile.stage("transformer", labels, None, 0, CPU)
    stage.prepare()
    return stage, {name: torch.from_numpy(array) for name, array in stage.batches(0)[0].items()}


def test_fine_tuning_begins_with_the_shipped_weights_and_learns_motions(labels):
    stage, batch = stage_of(labels, "compact", fine_tune=True)
    shipped = load_checkpoint(resolve_model(None, VQ_MPT)).modules["transformer"]
    for name, value in stage.model.state_dict().items():
        assert torch.equal(value, shipped.state_dict()[name]), name
    optimizer, found = torch.optim.AdamW(stage.parameters(), 3e-4), []
    for _ in range(4):
        losses = stage(batch)
        found.append(losses["link"].item())
        optimizer.zero_grad()
        losses["loss"].backward()
        optimizer.step()
    assert found[-1] < 0.9 * found[0]
    refused("fine_tune needs a --dictionary", stage_of, labels, "smoke", fine_tune=True)


@pytest.mark.parametrize("stage", ["transformer", "published"])
def test_labels_of_another_dictionary_of_the_same_robot_are_refused(labels, tmp_path, stage):
    words = load_checkpoint(resolve_model(None, VQ_MPT))
    codes = words.modules["dictionary"].quantizer.embedding.weight.data
    codes[[0, 1]] = codes[[1, 0]]  # as after a training with another seed, in the least case
    save_checkpoint(tmp_path / "other", words)
    prepare = replace(SMOKE, transformer=replace(SMOKE.transformer, **LABELLED)).stage
    told = "labels the roadmap of another dictionary.* give --dictionary"
    refused(told, prepare, stage, labels, tmp_path / "other", 0, CPU)
