"""Free configurations as when grasping upright things inside or near furniture from the side."""

from functools import lru_cache

import numpy as np

from cvqmpt_lab.constraints.inverse_kinematics import hand_reach, solve_poses
from cvqmpt_lab.constraints.task_space_region import UPRIGHT_ROTATION
from cvqmpt_lab.labels.generation import SHAPES
from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.search.space import ConstrainedSpace

POINTS = 20_000  # drawn of each kind, most of them useless
TRIED = 160  # poses of each kind, at most
APART = 0.6  # [m] between the two points of obstacles that a hand is between, at most
NEAR = 0.2  # [m] along each axis, from a point of an obstacle to a hand that is near it, at most
ROOM = 0.08  # [m] from the hand to obstacles, at least
ATTEMPTS = 8  # configurations that Newton's method starts from, per pose

_reach = lru_cache(maxsize=1)(hand_reach)


def grasps_among(space: ConstrainedSpace, rng: np.random.Generator, most: int) -> np.ndarray:
    """Free configurations with the hand between or near obstacles, and turned as for a grasp.

    Half of them have the hand halfway between points of two obstacles, half near an obstacle, if as
    many are found. Its x axis points up; its z axis is level and leads away from the first joint,
    at most 90 degrees to a side.

    Args:
        space: unconstrained space of a scene.
        rng: draws poses and where Newton's method starts.
        most: configurations at most, each of another pose.

    Returns:
        (k, n), k at most `most`; few or none where the arm reaches few or no such poses.
    """
    if most == 0 or not space.problem.scene.obstacles:
        return np.empty((0, space.robot.dof))
    between, near = (
        _free_grasps(space, rng, _places(space, rng, pairs)) for pairs in (True, False)
    )
    half = most // 2
    return rng.permutation(np.concatenate([between[:half], near, between[half:]])[:most])


def _places(space: ConstrainedSpace, rng: np.random.Generator, pairs: bool) -> np.ndarray:
    """Points for the hand (k, 3) [m], k at most TRIED.

    pairs: they are between two obstacles, otherwise near one.
    """
    centres, rotations, halves = _boxes(space.problem.scene)
    which = rng.integers(len(halves), size=(2, POINTS))
    inside = rng.uniform(-1.0, 1.0, (2, POINTS, 3)) * halves[which]
    points = np.einsum("pkij,pkj->pki", rotations[which], inside) + centres[which]
    if pairs:
        close = np.linalg.norm(points[0] - points[1], axis=1) < APART
        places = points.mean(axis=0)[close & (which[0] != which[1])]
    else:
        places = points[0] + rng.uniform(-NEAR, NEAR, (POINTS, 3))
    robot = space.robot
    axis = robot.kinematics.translation[0]
    places = places[np.linalg.norm(places - axis, axis=1) < _reach(robot)][: 12 * TRIED]
    local = np.einsum("oij,koi->koj", rotations, places[:, None] - centres)
    outside = np.linalg.norm(np.maximum(np.abs(local) - halves, 0.0), axis=2)
    return places[outside.min(axis=1) > ROOM][:TRIED]


def _boxes(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes around obstacles: centres (k, 3), rotations (k, 3, 3), halves of edges (k, 3) [m]."""
    T = np.array([item.T_world_object for item in scene.obstacles])
    # the first two sizes of cylinders, and all of balls, are radii
    halves = [
        np.multiply(
            SHAPES[type(item.shape)](item.shape)[1],
            0.5 if isinstance(item.shape, Box) else (1.0, 1.0, 0.5),
        )
        for item in scene.obstacles
    ]
    return T[:, :3, 3], T[:, :3, :3], np.array(halves)


def _free_grasps(
    space: ConstrainedSpace, rng: np.random.Generator, places: np.ndarray
) -> np.ndarray:
    """Free configurations (k, n) with the hand at places (p, 3) [m], at most one of each."""
    robot = space.robot
    away = places - robot.kinematics.translation[0]
    yaws = np.arctan2(away[:, 1], away[:, 0])
    yaws = yaws + rng.uniform(-0.5 * np.pi, 0.5 * np.pi, len(places))
    poses = np.array([pose(place, yaw) for place, yaw in zip(places, yaws, strict=True)])
    poses = poses.reshape(-1, 4, 4)
    poses[:, :3, :3] = poses[:, :3, :3] @ UPRIGHT_ROTATION
    guesses = robot.random_configurations(rng, len(poses) * ATTEMPTS)
    solved = solve_poses(robot, poses, guesses.reshape(len(poses), ATTEMPTS, robot.dof))
    found = np.concatenate([*solved, np.empty((0, robot.dof))])
    number = np.repeat(np.arange(len(solved)), [len(rows) for rows in solved])
    free = space.valid_batch(found)
    return found[free][np.unique(number[free], return_index=True)[1]]
