"""Goal configurations drawn from a region of poses: solved and checked in compiled code."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from cvqmpt_lab.collision.arrays import robot_arrays, scene_arrays
from cvqmpt_lab.collision.exact import reach_with
from cvqmpt_lab.constraints.inverse_kinematics import (
    ATTEMPTS,
    MAX_ITERATIONS,
    NEAR,
    SAMPLE_MARGIN,
    TOLERANCE,
    GoalSample,
    pose_regions,
)
from cvqmpt_lab.constraints.project import projection_scratch
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.kernels.search.reach import (
    COLLIDING,
    UNREACHABLE,
    UNTRIED,
    Poses,
    Seeds,
    reach_free,
)
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot

SEEDS = 8192  # configurations anywhere, made once a robot
SEEDS_NEAR = 512  # configurations around a given one
LOOK = 16
SHARE_OF_REACH = 0.3  # that a hand must be shifted to be as far off as one turned by a radian


def sample_goals(
    problem: PlanningProblem,
    rng: np.random.Generator,
    count: int,
    max_poses: int = 100,
    within: Sequence[TaskSpaceRegion] = (),
    near: np.ndarray | None = None,
) -> GoalSample:
    """Up to count collision-free configurations in a problem's goal region, one per pose.

    Where joints turn by more than a full turn, every second one is taken by the turns nearest to the start: else
    most goals of an arm with several such joints are whole turns away, and none may be on the start's side.

    within: regions kept at the same time; that of a held handle puts its door where the hand is.
    near: configuration (n,) that Newton's method starts around, instead of anywhere.
    """
    robot, region = problem.robot, problem.goal_region
    assert region is not None
    regions = pose_regions(robot, within)
    seeds = _seeds_anywhere(robot) if near is None else _seeds_near(robot, near, rng)
    T = region.sample_poses(rng, max_poses)
    poses = Poses(
        np.ascontiguousarray(T[:, :3, :3]),
        np.ascontiguousarray(T[:, :3, 3]),
        np.empty((max_poses, robot.dof)),
        np.empty(max_poses, dtype=np.int64),
        np.empty(max_poses, dtype=np.int64),
    )
    found = reach_free(
        robot.kinematics,
        regions,
        robot_arrays(robot, problem.attachments),
        scene_arrays(problem.scene, reach_with(robot, problem.attachments)),
        SAMPLE_MARGIN,
        seeds,
        rng.integers(len(seeds.configurations) - LOOK + 1, size=(ATTEMPTS, max_poses)),
        LOOK,
        TOLERANCE,
        MAX_ITERATIONS,
        near is None,  # from a given posture the way may be long
        projection_scratch(robot.dof, regions),
        count,
        poses,
    )
    configurations = poses.configurations[poses.reached[:found]]
    configurations[::2] = _turned_near(configurations[::2], problem.start, robot)
    return GoalSample(
        configurations,
        poses_tried=int((poses.verdict != UNTRIED).sum()),
        unreachable=int((poses.verdict == UNREACHABLE).sum()),
        colliding=int((poses.verdict == COLLIDING).sum()),
    )


def _turned_near(configurations: np.ndarray, start: np.ndarray, robot: Robot) -> np.ndarray:
    """The same postures (k, n), hinges turned by whole turns to where limits allow nearest to a start (n,)."""
    whole = 2.0 * np.pi * np.round((configurations - start) / (2.0 * np.pi))
    turned = configurations - np.where(robot.kinematics.prismatic, 0.0, whole)
    return np.where((turned >= robot.lower) & (turned <= robot.upper), turned, configurations)


@lru_cache(maxsize=8)
def _seeds_anywhere(robot: Robot) -> Seeds:
    """Uniform configurations, always the same."""
    return _seeds(robot, robot.random_configurations(np.random.default_rng(0), SEEDS))


def _seeds_near(robot: Robot, near: np.ndarray, rng: np.random.Generator) -> Seeds:
    """Configurations scattered around one (n,), inside the limits."""
    scattered = near + NEAR * rng.standard_normal((SEEDS_NEAR, robot.dof))
    return _seeds(robot, np.clip(scattered, robot.lower, robot.upper))


def _seeds(robot: Robot, configurations: np.ndarray) -> Seeds:
    """Configurations (k, n) with their hand poses."""
    link, T = robot.end_effector_link
    rotations, translations = link_poses(robot.kinematics, configurations)
    return Seeds(
        configurations,
        rotations[:, link] @ T[:3, :3],
        translations[:, link] + rotations[:, link] @ T[:3, 3],
        SHARE_OF_REACH * robot.reach,
    )
