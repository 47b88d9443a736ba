"""Datasets of labelled random scenes in shards; an interrupted generation can be continued."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.errors import InvalidInputError, whole_number
from cvqmpt_lab.files import locked, make_folder, read_json_object, write_text
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.training.dataset import SCHEMA
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    SHARDS_FOLDER,
    IndexRow,
    finished_shards,
    write_shard,
)
from cvqmpt_lab.vqmpt.config import SerialChain

FIRST_SCENE = 10_000_000  # scenes of evaluation suites have smaller numbers
SCENES_PER_SEED = 1_000_000
SCENES_PER_SHARD = 16
PANDA = {"name": "panda"}
Shard = tuple[IndexRow, bytes]


@dataclass(frozen=True)
class SceneRecipe(ABC):
    """Robot and scenes of a dataset; subclasses make the labels."""

    scenes: int  # in all, families taking turns
    paths_per_scene: int  # pairs tried in each; some give no label
    families: tuple[str, ...] = tuple(FAMILIES)
    seed: int = 0
    # as field 'robot' of a problem file
    robot: Mapping[str, Any] = field(default_factory=PANDA.copy)

    def __post_init__(self) -> None:
        for family in self.families:
            if family not in FAMILIES:
                family_scene(family, 0)
        # larger ones would number scenes beyond 2^32
        whole_number("seed", self.seed, 0, 3999)
        whole_number("scenes", self.scenes, 1, SCENES_PER_SEED)
        whole_number("paths per scene", self.paths_per_scene, 1)

    def scene_of(self, index: int) -> tuple[int, int]:
        """Family index and scene number of scene `index`; the number decides the split."""
        turn, family = divmod(index, len(self.families))
        return family, FIRST_SCENE + self.seed * SCENES_PER_SEED + turn

    def scenes_of(self, shard: int) -> Iterator[tuple[int, int, int, Scene]]:
        """Index, family index, number and shapes of the scenes of a shard."""
        first = shard * SCENES_PER_SHARD
        for index in range(first, min(first + SCENES_PER_SHARD, self.scenes)):
            family, number = self.scene_of(index)
            yield index, family, number, family_scene(self.families[family], number)

    def prepare(self, out: Path) -> None:  # noqa: B027 (nothing for most)
        """Write the files that shards have in common."""

    def check(self) -> None:  # noqa: B027 (nothing for most)
        """Raise InvalidInputError, before anything is written, if labels cannot be made."""

    @abstractmethod
    def shard(self, number: int) -> Shard:
        """One shard; depends on the recipe and its number alone."""

    @abstractmethod
    def card(self, out: Path) -> str:
        """Dataset card: what the dataset holds."""


def generate(
    recipe: SceneRecipe,
    out: Path,
    command: list[str],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    apply: Callable[[Callable[[int], Shard], list[int]], Iterable[Shard]] = map,
) -> int:
    """Write the shards that a folder does not have yet.

    Args:
        recipe: what to generate.
        out: folder of the dataset.
        command: the words that asked for it, kept with the dataset.
        on_progress: called with the shards done and those in all.
        apply: calls a function with every number and gives its results in any order.

    Returns:
        The number of paths in all.

    InvalidInputError: `out` holds a dataset of another recipe, is being written by another run, or
    cannot be written.
    """
    recipe.check()
    make_folder(out / SHARDS_FOLDER)
    with locked(out):
        _describe(recipe, out, command)
        recipe.prepare(out)
        count = -(-recipe.scenes // SCENES_PER_SHARD)
        done = {row.shard: row for row in finished_shards(out)}
        on_progress(len(done), count)
        for row, content in apply(recipe.shard, [k for k in range(count) if k not in done]):
            done[row.shard] = row
            write_shard(out, row, content, done.values())
            on_progress(len(done), count)
        write_text(out / "README.md", recipe.card(out))
    return sum(row.paths for row in done.values())


def _describe(recipe: SceneRecipe, out: Path, command: list[str]) -> None:
    """Write dataset.json, or check that it is equal."""
    robot = robot_from_source(recipe.robot)
    settings = json.loads(json.dumps(asdict(recipe)))
    path = out / DESCRIPTION_FILE
    if path.exists():
        existing = read_json_object(path).get("recipe", {})
        if existing != settings:
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
        "kinematics": to_plain(serial_chain(robot)),
        "recipe": settings,
        "provenance": provenance(command, [recipe.seed]),
    }
    write_text(path, json.dumps(description, indent=1) + "\n")


def serial_chain(robot: Robot) -> SerialChain:
    """Kinematics of a robot as a chain, with a point on each joint but the first, and the hand."""
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
