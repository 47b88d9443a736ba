"""Training a model's eyes on a dataset of roadmap labels."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.codec.plain import to_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.models.stored import VQ_MPT, read_model
from cvqmpt_lab.models.weights_folder import TRAINED_FOLDER, write_weights
from cvqmpt_lab.planning.sight import Eyes, SightNetwork
from cvqmpt_lab.prediction.weights import resolve_model
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.training.roadmap_shards import read_roadmap_shards
from cvqmpt_lab.training.shards import DESCRIPTION_FILE
from cvqmpt_lab.training.sight import train_sight
from experiments.labels.sight_examples import training_examples

ENOUGH = 400  # scenes; more won nothing


def train_eyes(
    data: Path,
    out: Path,
    model: str | None,
    seed: int,
    metadata: dict[str, Any],
    on_progress: Callable[[int, int], None],
    scenes: int = ENOUGH,
) -> int:
    """Write `model` with eyes into out/model; returns the number of motions that they learned from.

    Raises
    ------
    InvalidInputError
        When the dataset holds no scene to train on, or its robot is not the model's.
    """
    robot = robot_from_source(read_json_object(data / DESCRIPTION_FILE).get("recipe", {}).get("robot"))
    trained = read_model(resolve_model(model, VQ_MPT, robot))
    eyes = Eyes(SightNetwork.untrained(robot.dof), robot)
    features, free = [], []
    for examples in training_examples(eyes, read_roadmap_shards(data), scenes, np.random.default_rng(seed)):
        features.append(examples.features)
        free.append(examples.free)
        on_progress(len(free), scenes)
    if not free:
        raise InvalidInputError(f"{data} holds no scene to train on; generate more of them")
    sight = train_sight(np.concatenate(features), np.concatenate(free), seed)
    told = {**trained.metadata, "sight": {**metadata, "scenes": len(free), "seed": seed}}
    parts = {**trained.parts, "sight": sight}
    model_as_plain = to_plain(trained.config, complete=True)
    write_weights(out / TRAINED_FOLDER, VQ_MPT, model_as_plain, trained.robot, told, parts)
    return sum(map(len, free))
