"""Training a model's eyes on a dataset of roadmap labels."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.methods.loaded import EYES
from cvqmpt_lab.planning.sight import Eyes
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.training.shards import DESCRIPTION_FILE, read_roadmap_shards
from cvqmpt_lab.training.small_network import train_sight
from cvqmpt_lab.vqmpt.codebook import robot_signature
from cvqmpt_lab.vqmpt.weights import (
    TRAINED_FOLDER,
    VQ_MPT,
    StoredModel,
    read_model,
    resolve_model,
    write_model,
)
from experiments.labels.sight_examples import training_examples

Part = TypeVar("Part")


@dataclass(frozen=True)
class PartRequest:
    """What a part is trained on and for whom."""

    data: Path
    """Folder of roadmap labels."""
    out: Path
    """The model goes to out/model."""
    model: str | None
    """Whose part it is, see `vqmpt.weights.resolve_model`."""
    seed: int
    scenes: int
    """At most."""
    metadata: dict[str, Any]
    """Kept with the weights."""


def train_eyes(request: PartRequest, on_progress: Callable[[int, int], None]) -> int:
    """Write the model with eyes; returns the number of motions that they learned from.

    Raises
    ------
    InvalidInputError
        When the dataset holds no scene to train on, or its robot is not the model's.
    """
    robot, model = _whose(request)
    eyes = Eyes(SmallNetwork.untrained(robot.dof + 1), robot)
    shards, rng = read_roadmap_shards(request.data), np.random.default_rng(request.seed)
    parts = training_examples(eyes, shards, request.scenes, rng)
    examples = list(_counted(parts, request, request.scenes, on_progress))
    features = np.concatenate([one.features for one in examples])
    free = np.concatenate([one.free for one in examples])
    _write(request, model, EYES, train_sight(features, free, request.seed), {"scenes": len(examples)})
    return len(free)


def _whose(request: PartRequest) -> tuple[Robot, StoredModel]:
    """The dataset's robot and the model that gets the part."""
    robot = robot_from_source(
        read_json_object(request.data / DESCRIPTION_FILE).get("recipe", {}).get("robot")
    )
    return robot, read_model(resolve_model(request.model, VQ_MPT, robot_signature(robot)))


def _counted(
    parts: Iterator[Part],
    request: PartRequest,
    total: int,
    on_progress: Callable[[int, int], None],
    before: int = 0,
) -> Iterator[Part]:
    done = before
    for done, part in enumerate(parts, start=before + 1):
        on_progress(done, total)
        yield part
    if done == before:
        raise InvalidInputError(f"{request.data} holds no scene to train on; generate more of them")


def _write(
    request: PartRequest, model: StoredModel, name: str, arrays: dict[str, np.ndarray], counts: dict[str, int]
) -> None:
    told = {**model.metadata, name: {**request.metadata, **counts, "seed": request.seed}}
    parts = {**model.parts, name: arrays}
    write_model(request.out / TRAINED_FOLDER, replace(model, parts=parts, metadata=told))
