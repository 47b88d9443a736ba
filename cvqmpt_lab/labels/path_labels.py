"""Near-shortest paths in random scenes, the labels that VQ-MPT and MPNet learn from."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.files import read_json_object
from cvqmpt_lab.labels.generation import SceneRecipe, Shard
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere
from cvqmpt_lab.search.anytime import NearShortestSettings, near_shortest
from cvqmpt_lab.search.motion import motion_free
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.search.space import ConstrainedSpace
from cvqmpt_lab.training.dataset import PathDataset, open_dataset
from cvqmpt_lab.training.shards import DESCRIPTION_FILE, packed, packed_shard

SPACING = 0.13  # [rad] between stored waypoints
SHAPES = {
    Box: lambda box: (0, box.size),
    Cylinder: lambda cylinder: (1, (cylinder.radius, cylinder.radius, cylinder.height)),
    Sphere: lambda sphere: (2, (sphere.radius,) * 3),
}


@dataclass(frozen=True)
class PathRecipe(SceneRecipe):
    """Near-shortest paths in random scenes."""

    labels: NearShortestSettings = field(default_factory=NearShortestSettings)

    def shard(self, number: int) -> Shard:
        """Labelled scenes; in every eighth of a family some paths get a second label, a twin."""
        robot, scenes, labels = robot_from_source(self.robot), [], []
        for index, family, scene_number, scene in self.scenes_of(number):
            with_twins = index // len(self.families) % 8 == 0
            rng = np.random.default_rng((self.seed, index))
            space = unconstrained_space(robot, scene)
            labels.append(_labels(space, rng, self.paths_per_scene, self.labels, with_twins))
            scenes.append((family, scene_number, scene))
        return packed_shard(number, scene_shapes(scenes) | _path_arrays(robot, labels))

    def card(self, out: Path) -> str:
        """Counts and twin ratios."""
        return dataset_card(out)


class _Label(NamedTuple):
    """One labelled path of a scene."""

    path: JointPath
    trivial: bool  # the straight line is free
    twin_of: int  # index of the path, in the same scene, of which it is a second label, or -1


def _path_arrays(robot: Robot, scenes: Sequence[list[_Label]]) -> dict[str, np.ndarray]:
    """Arrays of the labels of each scene of a shard."""
    labels = [label for scene in scenes for label in scene]
    counts = [len(scene) for scene in scenes]
    before = np.repeat(np.cumsum(counts) - counts, counts).astype(int)
    twin_of = np.array([label.twin_of for label in labels], np.int32)
    paths = [label.path.spaced(SPACING) for label in labels]
    waypoints = [packed(path, robot.lower, robot.upper) for path in paths]
    straight = [np.linalg.norm(label.path.states[-1] - label.path.states[0]) for label in labels]
    return {
        "path_scene": np.repeat(np.arange(len(scenes)), counts).astype(np.int32),
        "path_start": np.cumsum([0, *(len(w) for w in waypoints)], dtype=np.int32),
        "waypoints": np.concatenate([np.empty((0, robot.dof), np.uint16), *waypoints]),
        "length": np.array([label.path.length for label in labels], np.float32),
        "straight": np.array(straight, np.float32),
        "trivial": np.array([label.trivial for label in labels], bool),
        "twin_of": np.where(twin_of >= 0, twin_of + before, -1).astype(np.int32),
    }


def scene_shapes(scenes: Sequence[tuple[int, int, Scene]]) -> dict[str, np.ndarray]:
    """The scenes of a shard as arrays, from the family, the number and the shapes of each."""
    items = [item for _, _, scene in scenes for item in scene.obstacles]
    described = [SHAPES[type(item.shape)](item.shape) for item in items]
    return {
        "family": np.array([family for family, _, _ in scenes], np.uint8),
        "scene_seed": np.array([number for _, number, _ in scenes], np.int64),
        "shape_start": np.cumsum(
            [0, *(len(scene.obstacles) for _, _, scene in scenes)], dtype=np.int32
        ),
        "shape_kind": np.array([kind for kind, _ in described], np.uint8),
        "shape_size": np.array([size for _, size in described], np.float32).reshape(-1, 3),
        "shape_pose": np.array([item.T_world_object[:3] for item in items], np.float32).reshape(
            -1, 3, 4
        ),
    }


def unconstrained_space(robot: Robot, scene: Scene) -> ConstrainedSpace:
    """The unconstrained planning space of a scene."""
    middle = 0.5 * (robot.lower + robot.upper)
    return ConstrainedSpace(PlanningProblem(scene.name, robot, scene, middle, middle[None]))


def _labels(
    space: ConstrainedSpace,
    rng: np.random.Generator,
    pairs: int,
    settings: NearShortestSettings,
    with_twins: bool,
    most_trivial: float = 0.15,
    most_straight: float = 0.5,
    detour: float = 1.03,
) -> list[_Label]:
    """Labelled paths of one scene.

    Half of the starts and goals are anywhere, half with the hand near an obstacle. Most motions are
    nearly straight and say little about the scene, so their share is bounded.

    Args:
        space: unconstrained space of the scene.
        rng: draws starts, goals and searches.
        pairs: of start and goal, at most.
        settings: of the search.
        with_twins: whether the first paths get a second, independent label.
        most_trivial: share of pairs whose straight line may be free.
        most_straight: share of paths that may be straight or nearly so.
        detour: a path is nearly straight unless it is so many times as long as the straight line.
    """
    candidates = free_configurations(space, rng)
    if len(candidates) < 2:
        return []
    tasklike = candidates[near_obstacles(space, candidates)]
    labels: list[_Label] = []
    twins, straight = 2 if with_twins else 0, 0
    for pair in range(pairs):
        pool = tasklike if pair % 2 and len(tasklike) >= 2 else candidates
        enough = sum(label.trivial for label in labels) >= most_trivial * pairs
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
        labels.append(_Label(path, trivial, -1))
        if twins and not nearly:
            again = near_shortest(space, start, goal, rng, settings)
            if again is not None:
                labels.append(_Label(again, False, len(labels) - 1))
                twins -= 1
    return labels


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


def dataset_card(folder: Path) -> str:
    """What a dataset holds, and how far two labels of one problem lie apart."""
    dataset = open_dataset(folder)
    every = range(len(dataset.families))
    lines = [
        f"# Training paths of {dataset.robot.name}",
        "",
        f"Recipe: `{json.dumps(read_json_object(folder / DESCRIPTION_FILE).get('recipe'))}`",
        "",
        "Scenes whose number is divisible by 20 validate, the others train. Twins are second, "
        "independent labels; the ratio is their mean waypoint distance over that from the first "
        "label to the straight line.",
        "",
        "| family | scenes | paths | trivial | length rad | straight rad | twins | twin / "
        "straight-line distance |",
        "|---|---|---|---|---|---|---|---|",
        *(_card_row(dataset, dataset.families[k], [k]) for k in every),
        _card_row(dataset, "all", every),
    ]
    return "\n".join(lines) + "\n"


def _card_row(dataset: PathDataset, name: str, families: Sequence[int]) -> str:
    """Counts and means of the scenes of some families."""
    arrays = dataset.arrays
    chosen, twin = np.isin(arrays["family"], families), arrays["twin_of"] >= 0
    own = chosen[arrays["path_scene"]]
    first, twins = np.flatnonzero(own & ~twin), np.flatnonzero(own & twin)
    share, *means = "-", "-", "-"
    if len(first):
        share = f"{100 * arrays['trivial'][first].mean():.0f} %"
        means = [f"{arrays[name][first].mean():.2f}" for name in ("length", "straight")]
    return (
        f"| {name} | {chosen.sum()} | {len(first)} | {share} | {' | '.join(means)} | {len(twins)} "
        f"| {_ratio(dataset, twins)} |"
    )


def _ratio(dataset: PathDataset, twins: np.ndarray) -> str:
    """Waypoint distance of twins to first labels / that of first labels to straight lines."""
    span = np.array(dataset.robot.upper) - np.array(dataset.robot.lower)
    apart = off_line = 0.0
    marks = np.linspace(0.0, 1.0, 32)
    for twin in twins.tolist():
        one, other = (
            _resampled(dataset.path(row) * span, marks)
            for row in (twin, dataset.arrays["twin_of"][twin])
        )
        line = other[0] + marks[:, None] * (other[-1] - other[0])
        apart += float(np.linalg.norm(one - other, axis=1).mean())
        off_line += float(np.linalg.norm(other - line, axis=1).mean())
    return f"{apart / off_line:.2f}" if off_line else "-"


def _resampled(path: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Waypoints of a path (t, n) at given fractions of their indices."""
    places = np.linspace(0.0, 1.0, len(path))
    return np.stack([np.interp(marks, places, joint) for joint in path.T], axis=1)
