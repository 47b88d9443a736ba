"""Datasets of labelled random scenes in shards; an interrupted generation can be continued."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cvqmpt_lab.codec import to_plain
from cvqmpt_lab.errors import InvalidInputError, whole_number
from cvqmpt_lab.files import locked, make_folder, read_json_object, write_text
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.families import FAMILIES, family_scene
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.dataset import SCHEMA
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    SHARDS_FOLDER,
    Column,
    IndexRow,
    finished_shards,
    joined,
    packed_shard,
    write_shard,
)
from cvqmpt_lab.vqmpt.config import SerialChain

FIRST_SCENE = 10_000_000  # scenes of evaluation suites have smaller numbers
SCENES_PER_SEED = 1_000_000
SCENES_PER_SHARD = 16
PANDA = {"name": "panda"}
SHAPES = {  # kind and size of a shape, as `training.dataset.Shapes` has them
    Box: lambda box: (0, box.size),
    Cylinder: lambda cylinder: (1, (cylinder.radius, cylinder.radius, cylinder.height)),
    Sphere: lambda sphere: (2, (sphere.radius,) * 3),
}
Shard = tuple[IndexRow, bytes]


@dataclass(frozen=True)
class SceneRecipe(ABC):
    """Robot and scenes of a dataset; subclasses make the labels."""

    columns: ClassVar[Mapping[str, Column]]  # arrays of a shard

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

    def prepare(self, out: Path) -> None:  # noqa: B027 (nothing for most)
        """Write the files that shards have in common."""

    def check(self) -> None:  # noqa: B027 (nothing for most)
        """Raise InvalidInputError, before anything is written, if labels cannot be made."""

    @abstractmethod
    def labelled(self, robot: Robot, scene: Scene, index: int) -> dict[str, Any] | None:
        """Arrays of a shard of the scene of this index alone; None if it cannot be labelled."""

    @abstractmethod
    def card(self, out: Path) -> str:
        """Dataset card: what the dataset holds."""

    def shard(self, number: int) -> Shard:
        """One shard; depends on the recipe and its number alone."""
        robot, labelled = robot_from_source(self.robot), []
        first = number * SCENES_PER_SHARD
        for index in range(first, min(first + SCENES_PER_SHARD, self.scenes)):
            turn, family = divmod(index, len(self.families))
            # the number decides the split
            scene_number = FIRST_SCENE + self.seed * SCENES_PER_SEED + turn
            scene = family_scene(self.families[family], scene_number)
            labels = self.labelled(robot, scene, index)
            if labels is not None:
                arrays = scene_arrays(family, scene_number, scene) | labels
                labelled.append({name: np.asarray(values) for name, values in arrays.items()})
        if not labelled:
            raise InvalidInputError(
                f"{robot.name}: every scene of shard {number} needs too many checks (a wall "
                "millimetres from the base, or a dictionary trained too briefly); give another "
                "--seed or --base, or --dictionary"
            )
        arrays = joined(labelled, self.columns)
        return packed_shard(
            number, {name: arrays[name].astype(self.columns[name].dtype) for name in labelled[0]}
        )


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
    settings = json.loads(json.dumps(asdict(recipe)))
    path = out / DESCRIPTION_FILE
    if path.exists():
        existing = read_json_object(path).get("recipe", {})
        if existing != settings:
            raise InvalidInputError(
                f"{out} holds a dataset of another recipe, {existing}; choose another --out"
            )
        return
    robot = robot_from_source(recipe.robot)
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


def scene_arrays(family: int, number: int, scene: Scene) -> dict[str, Any]:
    """A scene of a family as arrays of a shard."""
    described = [SHAPES[type(item.shape)](item.shape) for item in scene.obstacles]
    poses = np.array([item.T_world_object[:3] for item in scene.obstacles])
    return {
        "family": [family],
        "scene_seed": [number],
        "shape_start": [0, len(described)],
        "shape_kind": [kind for kind, _ in described],
        "shape_size": np.array([size for _, size in described]).reshape(-1, 3),
        "shape_pose": poses.reshape(-1, 3, 4),
    }


def unconstrained_space(robot: Robot, scene: Scene) -> ConstrainedSpace:
    """The unconstrained planning space of a scene."""
    middle = 0.5 * (robot.lower + robot.upper)
    return ConstrainedSpace(PlanningProblem(scene.name, robot, scene, middle, middle[None]))


def free_configurations(
    space: ConstrainedSpace, rng: np.random.Generator, drawn: int = 512
) -> np.ndarray:
    """Those of `drawn` random configurations that are free (k, n) [rad or m]."""
    candidates = space.robot.random_configurations(rng, drawn)
    return candidates[space.valid_batch(candidates)]


def near_obstacles(
    space: ConstrainedSpace, configurations: np.ndarray, near_hand: float = 0.25
) -> np.ndarray:
    """Whether the hand is near an obstacle, (b,) bool: within `near_hand` [m] of a box around one.

    configurations: (b, n) [rad or m].
    """
    robot = space.robot
    link, T = robot.end_effector_link
    rotations, translations = link_poses(robot.kinematics, configurations)
    hand = rotations[:, link] @ T[:3, 3] + translations[:, link]
    near = np.zeros(len(configurations), dtype=bool)
    for item in space.problem.scene.obstacles:
        _, size = SHAPES[type(item.shape)](item.shape)
        half = 0.5 * np.array(size) if isinstance(item.shape, Box) else np.array(size)
        local = (hand - item.T_world_object[:3, 3]) @ item.T_world_object[:3, :3]
        outside = np.maximum(np.abs(local) - half, 0.0)
        near |= np.linalg.norm(outside, axis=1) < near_hand
    return near


def dataset_card(
    title: str,
    text: str,
    columns: Sequence[str],
    families: Sequence[str],
    row: Callable[[Sequence[int]], Sequence[object]],
) -> str:
    """A title, a text and a table in markdown.

    Args:
        title: of the card.
        text: below the title.
        columns: of the table, beside the family's name.
        families: of the dataset, by their numbers in its arrays.
        row: gives the cells of one family, and of all together, from their numbers.
    """
    rows = [(name, *row([number])) for number, name in enumerate(families)]
    cells = [("family", *columns), *rows, ("all", *row(range(len(families))))]
    lines = [f"| {' | '.join(map(str, each))} |" for each in cells]
    lines.insert(1, "|" + len(cells[0]) * "---|")
    return "\n".join((f"# {title}", "", text, "", *lines, ""))
