"""Training data: random scenes and labels in them, in shards that can be resumed.

The folder's format is described in `cvqmpt_lab.training.shards`, which reads it. A shard depends on the
recipe and its own number alone, so a dataset is the same however often it was interrupted. Scene numbers
start at FIRST_SCENE: the scenes of evaluation suites have smaller ones.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.codec.plain import to_plain
from cvqmpt_lab.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.files import locked, make_folder, read_json_object, write_text
from cvqmpt_lab.planning.near_shortest import NearShortestSettings
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    SCHEMA,
    SHARDS_FOLDER,
    IndexRow,
    finished_shards,
    packed_shard,
    write_shard,
)
from cvqmpt_lab.vqmpt.inputs import SerialChain
from experiments.executors import Lost, local_processes
from experiments.labels.dataset_card import dataset_card
from experiments.labels.labelled_scenes import labelled_scene, shard_arrays

FIRST_SCENE = 10_000_000
SCENES_PER_SEED = 1_000_000
SCENES_PER_SHARD = 16
PANDA = {"name": "panda"}
TWIN_EVERY = 8  # scenes of each family: their first non-trivial paths get a second, independent label


@dataclass(frozen=True)
class SceneRecipe(ABC):
    """Which scenes a dataset is made of, and of which robot; what is labelled in them is its subclasses' business."""

    scenes: int
    """Number of scenes, families taking turns."""
    paths_per_scene: int
    """Pairs tried in each; some give no label."""
    families: tuple[str, ...] = tuple(FAMILIES)
    seed: int = 0
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
        """Family index and scene number of scene `index` of this dataset; numbers decide which scenes validate."""
        turn, family = divmod(index, len(self.families))
        return family, FIRST_SCENE + self.seed * SCENES_PER_SEED + turn

    def scenes_of(self, shard: int) -> Iterator[tuple[int, int, int, Scene]]:
        """Index, family index, number and shapes of the scenes of a shard."""
        first = shard * SCENES_PER_SHARD
        for index in range(first, min(first + SCENES_PER_SHARD, self.scenes)):
            family, number = self.scene_of(index)
            yield index, family, number, family_scene(self.families[family], number)

    @abstractmethod
    def prepare(self, out: Path) -> None:
        """Write what shards have in common."""

    @abstractmethod
    def shard(self, number: int) -> tuple[IndexRow, bytes]:
        """One shard; it depends on the recipe and its number alone."""

    @abstractmethod
    def card(self, out: Path) -> str:
        """What the dataset holds, as a page to read."""


@dataclass(frozen=True)
class Recipe(SceneRecipe):
    """Near-shortest paths in random scenes."""

    labels: NearShortestSettings = field(default_factory=NearShortestSettings)

    def prepare(self, out: Path) -> None:
        """Nothing."""

    def shard(self, number: int) -> tuple[IndexRow, bytes]:
        """Labelled scenes; some of each family have twins."""
        robot, scenes = robot_from_source(self.robot), []
        for index, family, scene_number, scene in self.scenes_of(number):
            with_twins = index // len(self.families) % TWIN_EVERY == 0
            seed = (self.seed, index)
            draw = labelled_scene(
                robot, scene, self.paths_per_scene, self.labels, seed, with_twins=with_twins
            )
            scenes.append((family, scene_number, draw))
        return packed_shard(number, shard_arrays(scenes))

    def card(self, out: Path) -> str:
        """Counts and twin ratios."""
        return dataset_card(out)


def generate(
    recipe: SceneRecipe, out: Path, jobs: int, command: list[str], on_progress: Callable[[int, int], None]
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
        recipe.prepare(out)
        count = -(-recipe.scenes // SCENES_PER_SHARD)
        done = {row.shard: row for row in finished_shards(out)}
        on_progress(len(done), count)
        left = [k for k in range(count) if k not in done]
        with local_processes(jobs) as executor:
            for k, shard in executor.results(recipe.shard, left):
                if isinstance(shard, Lost):
                    raise CvqmptError(f"shard {k}: {shard.detail}; what was finished is kept")
                row, content = shard
                done[row.shard] = row
                write_shard(out, row, content, done.values())
                on_progress(len(done), count)
        write_text(out / "README.md", recipe.card(out))
    return sum(row.paths for row in done.values())


def _describe(recipe: SceneRecipe, out: Path, command: list[str]) -> None:
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
