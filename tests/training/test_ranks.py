"""Two processes under torchrun train one model: a step of theirs is a step on the mean of their gradients."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import torch
from training_data import write_dataset

from cvqmpt_lab.codec.plain import to_plain
from cvqmpt_lab.training.batches import batch_seed
from cvqmpt_lab.training.dataset import open_dataset
from cvqmpt_lab.training.mpnet_stage import MPNetStage
from cvqmpt_lab.training.profiles import PROFILES
from cvqmpt_lab.training.stage_base import OptimizerSettings
from cvqmpt_lab.training.training_clouds import CloudSettings

ROOT = Path(__file__).resolve().parents[2]
SMOKE = PROFILES["smoke"]
TINY = dataclasses.replace(
    SMOKE,
    name="tiny",
    mpnet_model=dataclasses.replace(
        SMOKE.mpnet_model, n_points=32, encoder_widths=(16,), planner_widths=(16,), dropout=0.0
    ),
    mpnet=dataclasses.replace(
        SMOKE.mpnet,
        epochs=1,
        batches=dataclasses.replace(
            SMOKE.mpnet.batches,
            scenes=1,
            paths_per_scene=3,
            batches_per_epoch=2,
            cloud=CloudSettings(points=32),
        ),
        optimizer=OptimizerSettings(rate=1e-2, warmup=0, schedule="constant", epsilon=1e-8),
    ),
)


def together(folder, stage, data, *words):
    """`torchrun` of two processes; what they left and said."""
    config = folder / "tiny.json"
    config.write_text(json.dumps(to_plain(TINY)))
    torchrun = ("-m", "torch.distributed.run", "--nproc-per-node", "2", "--rdzv-endpoint", "localhost:0")
    command = (
        "--rdzv-backend",
        "c10d",
        "-m",
        "cli.main",
        "train",
        stage,
        "--config",
        config,
        "--device",
        "cpu",
    )
    words = (sys.executable, *torchrun, *command, "--data", data, "--out", folder / "out", *words)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run([str(word) for word in words], capture_output=True, text=True, env=environment)


def test_a_step_of_two_processes_is_one_on_the_mean_of_their_gradients(tmp_path):
    data = write_dataset(tmp_path / "d")
    done = together(tmp_path, "mpnet", data)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("model in") == 1, "both processes reported"
    settings = json.loads((tmp_path / "out" / "training.json").read_text())
    assert settings["processes"] == 2 and not list((tmp_path / "out").glob(".*"))
    dataset = open_dataset(data)
    stage = MPNetStage(dataset, TINY.mpnet_model_for(dataset), TINY.mpnet, 0, torch.device("cpu"))
    batches, steps = stage.batches(0), 1
    assert len(batches) // 2 == steps
    torch.manual_seed(0)
    optimizer = stage.optimizer.build(stage.module)
    for number in range(2):
        seed = batch_seed(0, 0, number).spawn(1)[0]
        torch.manual_seed(int(seed.generate_state(1, np.uint64)[0]) >> 1)
        batch = {name: torch.from_numpy(part) for name, part in batches[number].items()}
        (stage.losses(batch)["loss"] / 2).backward()
    optimizer.step()
    found = safetensors.numpy.load((tmp_path / "out" / "model" / "mpnet.safetensors").read_bytes())
    for name, tensor in stage.module.state_dict().items():
        np.testing.assert_allclose(found[name], tensor.numpy(), atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_what_shares_more_than_gradients_is_refused_in_one_line(tmp_path):
    done = together(tmp_path, "stage1", write_dataset(tmp_path / "d"))
    assert done.returncode != 0
    assert "cvqmpt: stage1 is trained by one process, not 2; leave torchrun out" in done.stderr
    assert not (tmp_path / "out").exists()
