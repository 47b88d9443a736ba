"""Generation of datasets: random scenes with labels, in shards; it can be interrupted.

`SceneRecipe` is the base of all recipes. `PathRecipe` makes near-shortest paths, from which the
dictionary and MPNet are trained; `roadmap_labels` has the other recipe.
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
from cvqmpt_lab.benchmarks.results.provenance import provenance
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, Cylinder, Shape, Sphere
from cvqmpt_lab.search.anytime import NearShortestSettings, near_shortest
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.dataset import DATASET_SCHEMA, VALIDATION_EVERY
from cvqmpt_lab.training.shards import (
    DESCRIPTION_FILE,
    PATH_ARRAYS,
    SCENE_ARRAYS,
    SHARD_SCENES,
    SHARDS_FOLDER,
    WAYPOINT_SPACING_RAD,
    Column,
    archive,
    joined,
    packed,
    read_shards,
    shard_files,
)
from cvqmpt_lab.vqmpt.config import SerialChain

Shard = tuple[int, bytes]  # number of a shard and content of its file


@dataclass(frozen=True)
class SceneRecipe(ABC):
    """Robot and scenes of a dataset; subclasses make the labels."""

    title: ClassVar[str]  # title of the dataset card
    columns: ClassVar[Mapping[str, Column]]  # arrays of a shard
    first_scene: ClassVar = 10_000_000  # scenes of evaluation suites have smaller numbers
    most_scenes: ClassVar = 1_000_000  # scene numbers of each seed
    shard_scenes: ClassVar = SHARD_SCENES

    scenes: int  # number of scenes; families take turns
    paths_per_scene: int  # pairs of start and goal tried in each scene; some give no label
    families: tuple[str, ...] = tuple(FAMILIES)
    seed: int = 0
    # as field 'robot' of a problem file
    robot: Mapping[str, Any] = field(default_factory=lambda: {"name": "panda"})

    def __post_init__(self) -> None:
        for family in self.families:
            require_choice("scene family", family, FAMILIES)
        # with a larger seed, numbers of scenes would exceed 2^32
        whole_number("seed", self.seed, 0, 3999)
        whole_number("scenes", self.scenes, 1, self.most_scenes)
        whole_number("paths per scene", self.paths_per_scene, 1)

    def prepare(self, out: Path) -> None:  # noqa: B027 (nothing for most)
        """Write the files that all shards have in common."""

    def check(self) -> None:  # noqa: B027 (nothing for most)
        """Raise InvalidInputError, before anything is written, if labels cannot be made."""

    @abstractmethod
    def labelled(self, robot: Robot, scene: Scene, index: int) -> dict[str, Any] | None:
        """Make the arrays of a shard for one scene; None if it cannot be labelled."""

    def shard(self, number: int) -> Shard:
        """Make a shard, which depends only on the recipe and the shard's number."""
        robot, labelled = robot_from_source(self.robot), []
        first = number * self.shard_scenes
        for index in range(first, min(first + self.shard_scenes, self.scenes)):
            turn, family = divmod(index, len(self.families))
            # whether a scene is for validation depends on this number
            scene_number = self.first_scene + self.seed * self.most_scenes + turn
            scene = family_scene(self.families[family], scene_number)
            labels = self.labelled(robot, scene, index)
            if labels is not None:
                arrays = scene_rows(family, scene_number, scene) | labels
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
    """Write the shards that a folder does not have yet, and a card with counts.

    Args:
        recipe: what to generate.
        out: folder of the dataset.
        command: words of the command line, which are stored with the dataset.
        on_progress: called with the number of finished shards and of all shards.
        apply: calls a function with every number and yields the results in any order, like `map`.

    Raises:
        InvalidInputError: `out` holds a dataset of another recipe, is being written by another
            run, or cannot be written.
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
    """Return the dataset card: the recipe, and counts by family."""
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
    """Write dataset.json; if there is one, compare its recipe and its robot."""
    settings = json.loads(json.dumps(asdict(recipe)))
    path = out / DESCRIPTION_FILE
    robot = robot_from_source(recipe.robot)
    of_robot = {
        "robot": robot.name,
        "lower": robot.lower.tolist(),
        "upper": robot.upper.tolist(),
        "joints": list(robot.joint_names),
        "kinematics_digest": robot.kinematics_digest,
        "robot_files": [digest for _, digest in robot.files],
    }
    if path.exists():
        existing = read_json_object(path)
        if existing.get("recipe", {}) != settings:
            raise InvalidInputError(
                f"{out} holds a dataset of another recipe, {existing.get('recipe', {})}; choose "
                "another --out"
            )
        # the recipe names a URDF, which may have changed; datasets of earlier versions lack fields
        differ = [name for name, value in of_robot.items() if existing.get(name, value) != value]
        if differ:
            raise InvalidInputError(
                f"{out} holds a dataset of robot {robot.name!r} as it was before its files changed "
                f"({', '.join(differ)} differ); restore them or choose another --out"
            )
        return
    description = {
        "schema": DATASET_SCHEMA,
        **of_robot,
        "families": list(recipe.families),
        "kinematics": to_plain(serial_chain(robot)),
        "recipe": settings,
        "provenance": provenance(command, [recipe.seed]),
    }
    write_text(path, json.dumps(description, indent=1) + "\n")


def serial_chain(robot: Robot) -> SerialChain:
    """Return a robot's kinematics as a chain, with points at all joints but the first, and hand."""
    kinematics = robot.kinematics
    if robot.followers:
        names = ", ".join(joint.name for joint in robot.followers)
        raise InvalidInputError(
            f"robot {robot.name}: {names} mimic planned joints, which no network follows: lock the "
            "joints that they mimic, or plan without a network"
        )
    if (kinematics.parent != np.arange(robot.dof)).any():
        raise InvalidInputError(
            f"robot {robot.name}: its joints branch, like two arms, and networks know only "
            "chains: give one --end-effector, or plan without a network"
        )
    hand, T = robot.hand()
    offsets = np.zeros((robot.dof, 3))
    offsets[-1] = T[:3, 3]
    return SerialChain(
        rotation=kinematics.rotation,
        translation=kinematics.translation,
        points=(*range(1, robot.dof), hand - 1),
        offsets=offsets,
        sliders=tuple(np.flatnonzero(kinematics.prismatic).tolist()),
    )


def scene_rows(family: int, number: int, scene: Scene) -> dict[str, Any]:
    """Return a scene as arrays of a shard (`shards.SCENE_ARRAYS`).

    family: index of the scene's family; number: number of the scene.
    """
    shapes = [shape_row(item.shape) for item in scene.obstacles]
    poses = np.array([item.T_world_object[:3] for item in scene.obstacles])
    return {
        "family": [family],
        "scene_seed": [number],
        "shape_start": [0, len(shapes)],
        "shape_kind": [kind for kind, _ in shapes],
        "shape_size": np.array([size for _, size in shapes]).reshape(-1, 3),
        "shape_pose": poses.reshape(-1, 3, 4),
    }


def shape_row(shape: Shape) -> tuple[int, tuple[float, float, float]]:
    """Return kind and size [m] of a shape of a random scene, as in `dataset.Shapes`."""
    if isinstance(shape, Box):
        x, y, z = shape.size
        return 0, (x, y, z)
    if isinstance(shape, Cylinder):
        return 1, (shape.radius, shape.radius, shape.height)
    assert isinstance(shape, Sphere)
    return 2, (shape.radius, shape.radius, shape.radius)


def free_configurations(
    space: ConstrainedSpace, rng: np.random.Generator, drawn: int = 512
) -> np.ndarray:
    """Draw random configurations and return those free of collision (k, n) [rad or m]."""
    candidates = space.robot.random_configurations(rng, drawn)
    return candidates[space.valid_batch(candidates)]


def near_obstacles(
    space: ConstrainedSpace, configurations: np.ndarray, near_hand: float = 0.25
) -> np.ndarray:
    """Whether the hand is near an obstacle, (b,) bool.

    Args:
        space: space of a scene.
        configurations: (b, n) [rad or m].
        near_hand: maximum distance of the hand to a box around an obstacle [m].
    """
    robot = space.robot
    link, T = robot.hand()
    rotations, translations = link_poses(robot.kinematics, configurations)
    hand = rotations[:, link] @ T[:3, 3] + translations[:, link]
    near = np.zeros(len(configurations), dtype=bool)
    for item in space.world.scene.obstacles:
        _, size = shape_row(item.shape)
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
        """Make the paths of a scene."""
        rng = np.random.default_rng((self.seed, index))
        space = ConstrainedSpace(World(robot, scene))
        labels = _labels(space, rng, self.paths_per_scene, self.labels)
        paths = [path for path, _ in labels]
        waypoints = [
            packed(path.spaced(WAYPOINT_SPACING_RAD), robot.lower, robot.upper) for path in paths
        ]
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
    """Find near-shortest paths of a scene.

    Half of the pairs of start and goal are random, half have the hand near an obstacle. Most
    motions are nearly straight and depend little on the scene, so their share is limited.

    Args:
        space: unconstrained space of the scene.
        rng: random numbers for starts, goals and searches.
        pairs: maximum number of pairs of start and goal.
        settings: settings of the search.
        most_trivial: maximum share of pairs whose straight line is free.
        most_straight: maximum share of paths that are straight or nearly straight.
        detour: a path is nearly straight if it is shorter than this multiple of the straight line.

    Returns:
        Paths, and whether the straight line from start to goal is free for each.
    """
    candidates = free_configurations(space, rng)
    if len(candidates) < 2:
        return []
    near_obstacle = candidates[near_obstacles(space, candidates)]
    labels: list[tuple[JointPath, bool]] = []
    straight = 0
    for pair in range(pairs):
        pool = near_obstacle if pair % 2 and len(near_obstacle) >= 2 else candidates
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
        nearly_straight = path.length < detour * np.linalg.norm(goal - start)
        if nearly_straight and straight >= most_straight * pairs:
            continue
        straight += int(nearly_straight)
        labels.append((path, trivial))
    return labels
