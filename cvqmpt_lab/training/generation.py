"""Datasets of labelled random scenes in shards; an interrupted generation can be continued.

Near-shortest paths are the labels that VQ-MPT and MPNet learn from.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.errors import InvalidInputError, require_choice, whole_number
from cvqmpt_lab.base.files import locked, make_folder, read_json_object, write_bytes, write_text
from cvqmpt_lab.benchmarks.families import FAMILIES, family_scene
from cvqmpt_lab.results.provenance import provenance
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere
from cvqmpt_lab.search.anytime import NearShortestSettings, near_shortest
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.dataset import SCHEMA, VALIDATION_EVERY
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    PATH_ARRAYS,
    SCENE_ARRAYS,
    SHARDS_FOLDER,
    SPACING,
    Column,
    archive,
    joined,
    packed,
    read_shards,
    shard_files,
)
from cvqmpt_lab.vqmpt.config import SerialChain

PANDA = {"name": "panda"}
SHAPES = {  # kind and size of a shape, as `training.dataset.Shapes` has them
    Box: lambda box: (0, box.size),
    Cylinder: lambda cylinder: (1, (cylinder.radius, cylinder.radius, cylinder.height)),
    Sphere: lambda sphere: (2, (sphere.radius,) * 3),
}
Shard = tuple[int, bytes]  # its number and the content of its file


@dataclass(frozen=True)
class SceneRecipe(ABC):
    """Robot and scenes of a dataset; subclasses make the labels."""

    title: ClassVar[str]  # of the dataset card
    columns: ClassVar[Mapping[str, Column]]  # arrays of a shard
    first_scene: ClassVar = 10_000_000  # scenes of evaluation suites have smaller numbers
    most_scenes: ClassVar = 1_000_000  # of a seed
    shard_scenes: ClassVar = 16

    scenes: int  # in all, families taking turns
    paths_per_scene: int  # pairs tried in each; some give no label
    families: tuple[str, ...] = tuple(FAMILIES)
    seed: int = 0
    # as field 'robot' of a problem file
    robot: Mapping[str, Any] = field(default_factory=PANDA.copy)

    def __post_init__(self) -> None:
        for family in self.families:
            require_choice("scene family", family, FAMILIES)
        # larger ones would number scenes beyond 2^32
        whole_number("seed", self.seed, 0, 3999)
        whole_number("scenes", self.scenes, 1, self.most_scenes)
        whole_number("paths per scene", self.paths_per_scene, 1)

    def prepare(self, out: Path) -> None:  # noqa: B027 (nothing for most)
        """Write the files that shards have in common."""

    def check(self) -> None:  # noqa: B027 (nothing for most)
        """Raise InvalidInputError, before anything is written, if labels cannot be made."""

    @abstractmethod
    def labelled(self, robot: Robot, scene: Scene, index: int) -> dict[str, Any] | None:
        """Arrays of a shard of the scene of this index alone; None if it cannot be labelled."""

    def shard(self, number: int) -> Shard:
        """One shard; depends on the recipe and its number alone."""
        robot, labelled = robot_from_source(self.robot), []
        first = number * self.shard_scenes
        for index in range(first, min(first + self.shard_scenes, self.scenes)):
            turn, family = divmod(index, len(self.families))
            # the number decides the split
            scene_number = self.first_scene + self.seed * self.most_scenes + turn
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
        typed = {name: arrays[name].astype(self.columns[name].dtype) for name in labelled[0]}
        return number, archive(typed)


def generate(
    recipe: SceneRecipe,
    out: Path,
    command: list[str],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    apply: Callable[[Callable[[int], Shard], list[int]], Iterable[Shard]] = map,
) -> None:
    """Write the shards that a folder does not have yet, and a card that counts what it holds.

    Args:
        recipe: what to generate.
        out: folder of the dataset.
        command: the words that asked for it, kept with the dataset.
        on_progress: called with the shards done and those in all.
        apply: calls a function with every number and gives its results in any order.

    InvalidInputError: `out` holds a dataset of another recipe, is being written by another run, or
    cannot be written.
    """
    recipe.check()
    make_folder(out / SHARDS_FOLDER)
    with locked(out):
        _describe(recipe, out, command)
        recipe.prepare(out)
        count = -(-recipe.scenes // recipe.shard_scenes)
        done = {int(file.stem) for file in shard_files(out)}
        on_progress(len(done), count)
        for number, content in apply(recipe.shard, [k for k in range(count) if k not in done]):
            write_bytes(out / SHARDS_FOLDER / f"{number:06d}.npz", content)
            done.add(number)
            on_progress(len(done), count)
        write_text(out / "README.md", _card(recipe, out))


def _card(recipe: SceneRecipe, out: Path) -> str:
    """Dataset card: the recipe, and counts by family."""
    arrays = joined(read_shards(out, SCENE_ARRAYS), SCENE_ARRAYS)
    validates = arrays["scene_seed"] % VALIDATION_EVERY == 0
    lines = ["| family | scenes | of them validate | paths |", "|---|---|---|---|"]
    rows = [(name, [number]) for number, name in enumerate(recipe.families)]
    for name, numbers in (*rows, ("all", [*range(len(rows))])):
        own = np.isin(arrays["family"], numbers)
        paths = own[arrays["path_scene"]].sum()
        lines.append(f"| {name} | {own.sum()} | {validates[own].sum()} | {paths} |")
    text = (
        f"Recipe: `{json.dumps(asdict(recipe))}`\n\nScenes whose number is divisible by "
        f"{VALIDATION_EVERY} validate, the others train."
    )
    return "\n".join((f"# {recipe.title}", "", text, "", *lines, ""))


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
    return ConstrainedSpace(robot, scene)


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
    for item in space.scene.obstacles:
        _, size = SHAPES[type(item.shape)](item.shape)
        half = 0.5 * np.array(size) if isinstance(item.shape, Box) else np.array(size)
        local = (hand - item.T_world_object[:3, 3]) @ item.T_world_object[:3, :3]
        outside = np.maximum(np.abs(local) - half, 0.0)
        near |= np.linalg.norm(outside, axis=1) < near_hand
    return near


@dataclass(frozen=True)
class PathRecipe(SceneRecipe):
    """Near-shortest paths in random scenes."""

    title: ClassVar = "Near-shortest paths in random scenes"
    columns: ClassVar = PATH_ARRAYS

    labels: NearShortestSettings = field(default_factory=NearShortestSettings)

    def labelled(self, robot: Robot, scene: Scene, index: int) -> dict[str, Any]:
        """Labelled paths."""
        rng = np.random.default_rng((self.seed, index))
        space = unconstrained_space(robot, scene)
        labels = _labels(space, rng, self.paths_per_scene, self.labels)
        paths = [path for path, _ in labels]
        waypoints = [packed(path.spaced(SPACING), robot.lower, robot.upper) for path in paths]
        return {
            "path_scene": np.zeros(len(paths), int),
            "path_start": np.cumsum([0, *map(len, waypoints)]),
            "waypoints": np.concatenate([np.empty((0, robot.dof), np.uint16), *waypoints]),
            "length": [path.length for path in paths],
            "straight": [np.linalg.norm(path.states[-1] - path.states[0]) for path in paths],
            "trivial": np.array([trivial for _, trivial in labels], bool),
        }


def _labels(
    space: ConstrainedSpace,
    rng: np.random.Generator,
    pairs: int,
    settings: NearShortestSettings,
    most_trivial: float = 0.15,
    most_straight: float = 0.5,
    detour: float = 1.03,
) -> list[tuple[JointPath, bool]]:
    """Labelled paths of one scene.

    Half of the starts and goals are anywhere, half with the hand near an obstacle. Most motions are
    nearly straight and say little about the scene, so their share is bounded.

    Args:
        space: unconstrained space of the scene.
        rng: draws starts, goals and searches.
        pairs: of start and goal, at most.
        settings: of the search.
        most_trivial: share of pairs whose straight line may be free.
        most_straight: share of paths that may be straight or nearly so.
        detour: a path is nearly straight unless it is so many times as long as the straight line.

    Returns:
        Paths, and whether the straight line of each is free.
    """
    candidates = free_configurations(space, rng)
    if len(candidates) < 2:
        return []
    tasklike = candidates[near_obstacles(space, candidates)]
    labels: list[tuple[JointPath, bool]] = []
    straight = 0
    for pair in range(pairs):
        pool = tasklike if pair % 2 and len(tasklike) >= 2 else candidates
        enough = sum(is_trivial for _, is_trivial in labels) >= most_trivial * pairs
        for _ in range(10):
            start, goal = pool[rng.choice(len(pool), 2, replace=False)]
            trivial = bool(motion_free(space.arrays, start, goal))
            if not (trivial and enough):
                break
        else:
            continue
        line = JointPath(np.array([start, goal]))
        path = line if trivial else near_shortest(space, start, goal, rng, settings)
        if path is None:
            continue
        nearly = path.length < detour * np.linalg.norm(goal - start)
        if nearly and straight >= most_straight * pairs:
            continue
        straight += int(nearly)
        labels.append((path, trivial))
    return labels
