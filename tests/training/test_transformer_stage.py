"""What the scene transformer learns from labels of motions, and where fine-tuning begins."""

from dataclasses import replace

import pytest
import torch
from refusals import refused
from torch.nn import functional as F

from cvqmpt_lab.labels.generation import generate
from cvqmpt_lab.labels.roadmap_labels import RoadmapRecipe
from cvqmpt_lab.training.profiles import PROFILES
from cvqmpt_lab.vqmpt.checkpoint import load_checkpoint
from cvqmpt_lab.vqmpt.weights import VQ_MPT, resolve_model

CPU = torch.device("cpu")
FEW = {"scenes": 2, "paths": 8, "goals": 2, "precision": "float32", "validation_scenes": 2}


@pytest.fixture(scope="module")
def labels(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    generate(RoadmapRecipe(4, 40, ("table", "shelves")), folder, ["test"])
    return folder


def stage_of(labels, profile, **settings):
    profile = PROFILES[profile]
    profile = replace(profile, transformer=replace(profile.transformer, **FEW, **settings))
    stage = profile.stage("transformer", labels, None, 0, CPU)
    stage.prepare()
    return stage


def batch_of(stage):
    return {name: torch.from_numpy(array) for name, array in stage.batches(0)[0].items()}


def test_the_loss_counts_motions_to_codes_as_labelled(labels):
    stage = stage_of(labels, "smoke")
    batch, settings = batch_of(stage), stage.settings
    assert batch["link_free"].shape == batch["link_code"].shape == (2, settings.link_ends, 20)
    losses = stage(batch)
    scenes = stage.model.encode(batch["centres"], batch["offsets"])
    odds = stage.model.link_odds(scenes, batch["link_end"], batch["link_code"])
    expected = F.binary_cross_entropy_with_logits(odds, batch["link_free"].float())
    assert losses["link"].item() == pytest.approx(expected.item(), abs=1e-5)
    parts = losses["code"] + losses["node"] + 2.0 * losses["edge"] + 2.0 * losses["link"]
    assert losses["loss"].item() == pytest.approx(parts.item(), abs=1e-5)


def test_fine_tuning_begins_with_the_shipped_weights_and_learns_motions(labels):
    stage = stage_of(labels, "compact", fine_tune=True)
    shipped = load_checkpoint(resolve_model(None, VQ_MPT)).modules["transformer"]
    for name, value in stage.model.state_dict().items():
        assert torch.equal(value, shipped.state_dict()[name]), name
    batch, optimizer = batch_of(stage), torch.optim.AdamW(stage.parameters(), 3e-4)
    found = []
    for _ in range(4):
        losses = stage(batch)
        found.append(losses["link"].item())
        optimizer.zero_grad()
        losses["loss"].backward()
        optimizer.step()
    assert found[-1] < 0.9 * found[0]


def test_fine_tuning_with_other_sizes_is_refused(labels):
    refused("fine_tune needs a --dictionary", stage_of, labels, "smoke", fine_tune=True)
