"""Training paths: random scenes, near-shortest unconstrained motions in them, in shards that can be resumed.

The folder's format is described in `cvqmpt_lab.training.shards`, which reads it. A shard depends on the
recipe and its own number alone, so a dataset is the same however often it was interrupted. Scene numbers
start at FIRST_SCENE: the scenes of evaluation suites have smaller ones.
"""

import json
from collections.abc import Callable, Mapping
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.codec.plain import to_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import locked, make_folder, read_json_object, write_text
from cvqmpt_lab.models.serial_chain import SerialChain
from cvqmpt_lab.planning.near_shortest import NearShortestSettings
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    SCHEMA,
    SHARDS_FOLDER,
    Shard,
    finished_shards,
    write_shard,
)
from experiments.dataset_card import dataset_card
from experiments.labelled_scenes import labelled_scene, shard_arrays
from experiments.workers import worker_pool

FIRST_SCENE = 10_000_000
SCENES_PER_SEED = 1_000_000
SCENES_PER_SHARD = 16
PANDA = {"name": "panda"}
TWIN_EVERY = 8  # scenes of each family: their first non-trivial paths get a second, independent label


@dataclass(frozen=True)
class Recipe:
    """What a dataset is made of."""

    scenes: int
    """Number of scenes, families taking turns."""
    paths_per_scene: int
    """Pairs tried in each; some give no label."""
    families: tuple[str, ...] = tuple(FAMILIES)
    seed: int = 0
    labels: NearShortestSettings = field(default_factory=NearShortestSettings)
    robot: Mapping[str, Any] = field(default_factory=PANDA.copy)
    """As field 'robot' of a problem file."""

    def __post_init__(self) -> None:
        for family in self.families:
            if family not in FAMILIES:
                family_scene(family, 0)
        if not 0 <= self.seed < 4000 or not 1 <= self.scenes <= SCENES_PER_SEED:
            raise InvalidInputError(
                f"seed {self.seed} and {self.scenes} scenes: give a seed from 0 to 3999 and at most "
                f"{SCENES_PER_SEED} scenes"
            )

    def scene_of(self, index: int) -> tuple[int, int]:
        """Family index and scene number of scene `index` of this dataset."""
        return index % len(self.families), FIRST_SCENE + self.seed * SCENES_PER_SEED + index


def generate(
    recipe: Recipe, out: Path, jobs: int, command: list[str], on_progress: Callable[[int, int], None]
) -> int:
    """Write the shards that `out` does not have yet; returns the number of paths in all.

    Raises
    ------
    InvalidInputError
        If `out` holds a dataset of another recipe, is being written by another run, or cannot be written.
    """
    make_folder(out / SHARDS_FOLDER)
    with locked(out):
        _describe(recipe, out, command)
        count = -(-recipe.scenes // SCENES_PER_SHARD)
        done = {row.shard: row for row in finished_shards(out)}
        on_progress(len(done), count)
        with worker_pool(jobs) as pool:
            futures = {pool.submit(_shard, recipe, k): k for k in range(count) if k not in done}
            try:
                for future in as_completed(futures):
                    shard = future.result()
                    done[shard.row.shard] = shard.row
                    write_shard(out, shard, done.values())
                    on_progress(len(done), count)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        write_text(out / "README.md", dataset_card(out))
    return sum(row.paths for row in done.values())


def _describe(recipe: Recipe, out: Path, command: list[str]) -> None:
    """Write dataset.json, or check that it says the same."""
    robot = robot_from_source(recipe.robot)
    settings = json.loads(json.dumps(asdict(recipe)))
    path = out / DESCRIPTION_FILE
    if path.exists():
        existing = read_json_object(path).get("recipe", {})
        if {"robot": PANDA, **existing} != settings:  # datasets of the Panda alone do not name it
            raise InvalidInputError(
                f"{out} holds a dataset of another recipe, {existing}; choose another --out"
            )
        return
    description = {
        "schema": SCHEMA,
        "robot": robot.name,
        "lower": robot.lower.tolist(),
        "upper": robot.upper.tolist(),
        "joints": list(robot.joint_names),
        "kinematics_digest": robot.kinematics_digest,
        "families": list(recipe.families),
        "kinematics": to_plain(_chain(robot)),
        "recipe": settings,
        "provenance": provenance(command, [recipe.seed]),
    }
    write_text(path, json.dumps(description, indent=1) + "\n")


def _chain(robot: Robot) -> SerialChain:
    """Kinematics with a point on each joint but the first, and the hand."""
    kinematics, (hand, T) = robot.kinematics, robot.end_effector_link
    offsets = np.zeros((robot.dof, 3))
    offsets[-1] = T[:3, 3]
    return SerialChain(
        rotation=kinematics.rotation,
        translation=kinematics.translation,
        points=(*range(1, robot.dof), hand - 1),
        offsets=offsets,
        sliders=tuple(np.flatnonzero(kinematics.prismatic).tolist()),
    )


def _shard(recipe: Recipe, number: int) -> Shard:
    """One shard; scenes of each family in turn have twins."""
    first = number * SCENES_PER_SHARD
    robot, scenes = robot_from_source(recipe.robot), []
    for index in range(first, min(first + SCENES_PER_SHARD, recipe.scenes)):
        family, scene_number = recipe.scene_of(index)
        scene = family_scene(recipe.families[family], scene_number)
        with_twins = index // len(recipe.families) % TWIN_EVERY == 0
        seed = (recipe.seed, index)
        draw = labelled_scene(
            robot, scene, recipe.paths_per_scene, recipe.labels, seed, with_twins=with_twins
        )
        scenes.append((family, scene_number, draw))
    return Shard.of(number, shard_arrays(scenes))
