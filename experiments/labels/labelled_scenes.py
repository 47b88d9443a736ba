"""Scenes with near-shortest paths: what shards are made of."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.kernels.search.motion import motion_free
from cvqmpt_lab.planning.near_shortest import NearShortestSettings, near_shortest
from cvqmpt_lab.planning.result import JointPath
from cvqmpt_lab.planning.space import ConstrainedSpace
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, Cylinder, Sphere
from cvqmpt_lab.training.shards import FULL_SCALE

SPACING = 0.13  # [rad] between stored waypoints
NEAR_HAND = 0.25  # [m] of an obstacle: a task-like configuration
MOST_TRIVIAL = 0.15  # share of a scene's paths that may be straight lines
DETOUR = 1.03  # a path is nearly straight unless it is this much longer than the straight line
MOST_STRAIGHT = 0.5  # share of a scene's paths that may be straight lines or nearly so
REDRAWS = 10  # pairs drawn to find one that is not trivial
CANDIDATES = 512  # configurations drawn per scene to choose starts and goals from


@dataclass(frozen=True, eq=False)
class _Label:
    """A path of one scene."""

    path: JointPath
    trivial: bool
    """The straight line is free."""
    twin_of: int
    """Index of the path, in the same scene, of which it is a second label, or -1."""


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """What training learns from one scene."""

    robot: Robot
    scene: Scene
    labels: list[_Label]


def labelled_scene(
    robot: Robot,
    scene: Scene,
    pairs: int,
    settings: NearShortestSettings,
    seed: Sequence[int],
    *,
    with_twins: bool,
) -> LabelledScene:
    """Label a scene: paths between `pairs` pairs of configurations, some of which give none."""
    space = unconstrained_space(robot, scene)
    rng = np.random.default_rng(seed)
    return LabelledScene(robot, scene, _labels(space, rng, pairs, settings, with_twins))


def shard_arrays(scenes: Sequence[tuple[int, int, LabelledScene]]) -> dict[str, np.ndarray]:
    """Arrays of a shard, from the family, the number and the labels of each scene."""
    draws = [draw for _, _, draw in scenes]
    labels = [label for draw in draws for label in draw.labels]
    before = np.cumsum([0, *(len(draw.labels) for draw in draws)])
    twins = [
        label.twin_of + offset if label.twin_of >= 0 else -1
        for draw, offset in zip(draws, before.tolist(), strict=False)
        for label in draw.labels
    ]
    robot = draws[0].robot
    waypoints = [packed(robot, label.path.spaced(SPACING)) for label in labels]
    straight = [np.linalg.norm(label.path.states[-1] - label.path.states[0]) for label in labels]
    return scene_shapes([(family, number, draw.scene) for family, number, draw in scenes]) | {
        "path_scene": np.repeat(np.arange(len(draws)), np.diff(before)).astype(np.int32),
        "path_start": np.cumsum([0, *(len(w) for w in waypoints)], dtype=np.int32),
        "waypoints": np.concatenate([np.empty((0, robot.dof), np.uint16), *waypoints]),
        "length": np.array([label.path.length for label in labels], np.float32),
        "straight": np.array(straight, np.float32),
        "trivial": np.array([label.trivial for label in labels], bool),
        "twin_of": np.array(twins, np.int32),
    }


def scene_shapes(scenes: Sequence[tuple[int, int, Scene]]) -> dict[str, np.ndarray]:
    """The scenes of a shard as arrays, from the family, the number and the shapes of each."""
    items = [item for _, _, scene in scenes for item in scene.obstacles]
    described = [SHAPES[type(item.shape)](item.shape) for item in items]
    return {
        "family": np.array([family for family, _, _ in scenes], np.uint8),
        "scene_seed": np.array([number for _, number, _ in scenes], np.int64),
        "shape_start": np.cumsum([0, *(len(scene.obstacles) for _, _, scene in scenes)], dtype=np.int32),
        "shape_kind": np.array([kind for kind, _ in described], np.uint8),
        "shape_size": np.array([size for _, size in described], np.float32).reshape(-1, 3),
        "shape_pose": np.array([item.T_world_object[:3] for item in items], np.float32).reshape(-1, 3, 4),
    }


SHAPES = {
    Box: lambda box: (0, box.size),
    Cylinder: lambda cylinder: (1, (cylinder.radius, cylinder.radius, cylinder.height)),
    Sphere: lambda sphere: (2, (sphere.radius,) * 3),
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
) -> list[_Label]:
    """Labelled paths of one scene: half of the starts and goals anywhere, half with the hand near an obstacle.

    Most motions are nearly straight and say little about the scene: beyond MOST_STRAIGHT they are left out.
    """
    candidates = space.robot.random_configurations(rng, CANDIDATES)
    candidates = candidates[space.valid_batch(candidates)]
    if len(candidates) < 2:
        return []
    tasklike = candidates[near_obstacles(space, candidates)]
    labels: list[_Label] = []
    twins, straight = 2 if with_twins else 0, 0
    for pair in range(pairs):
        pool = tasklike if pair % 2 and len(tasklike) >= 2 else candidates
        enough = sum(label.trivial for label in labels) >= MOST_TRIVIAL * pairs
        for _ in range(REDRAWS):
            start, goal = pool[rng.choice(len(pool), 2, replace=False)]
            trivial = bool(motion_free(space.arrays, start, goal))
            if not (trivial and enough):
                break
        else:
            continue
        path = (
            JointPath(np.array([start, goal]))
            if trivial
            else near_shortest(space, start, goal, rng, settings)
        )
        if path is None:
            continue
        nearly = path.length < DETOUR * np.linalg.norm(goal - start)
        if nearly and straight >= MOST_STRAIGHT * pairs:
            continue
        straight += int(nearly)
        labels.append(_Label(path, trivial, -1))
        if twins and not nearly:
            again = near_shortest(space, start, goal, rng, settings)
            if again is not None:
                labels.append(_Label(again, False, len(labels) - 1))
                twins -= 1
    return labels


def near_obstacles(space: ConstrainedSpace, configurations: np.ndarray) -> np.ndarray:
    """Whether the hand (b,) is within NEAR_HAND of a box around an obstacle."""
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
        near |= np.linalg.norm(outside, axis=1) < NEAR_HAND
    return near


def packed(robot: Robot, configurations: np.ndarray) -> np.ndarray:
    """Joints as 16-bit shares of their range."""
    u = (configurations - robot.lower) / (robot.upper - robot.lower)
    return np.rint(np.clip(u, 0.0, 1.0) * FULL_SCALE).astype(np.uint16)


def unpacked(robot: Robot, shares: np.ndarray) -> np.ndarray:
    """What `packed` stored [rad or m]."""
    return robot.lower + shares / FULL_SCALE * (robot.upper - robot.lower)
