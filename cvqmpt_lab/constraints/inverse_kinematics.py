"""Inverse kinematics as projection: a pose is a task-space region whose bounds are all zero.

Newton's method from random configurations serves any serial robot and needs no other code than
the projection that the planners use.
"""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, stack_regions
from cvqmpt_lab.kernels.projection import project_batch, projection_scratch
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.collision import CollisionChecker

TOLERANCE = 1e-6  # [m, rad] on the pose
MAX_ITERATIONS = 25
BATCH = 16
SAMPLE_MARGIN = 1e-3  # [m] kept from obstacles by sampled starts and goals
BATCHES_PER_POSE = 2


def solve_pose(
    robot: Robot, T_world_e: np.ndarray, rng: np.random.Generator, attempts: int = BATCH
) -> np.ndarray:
    """Configurations (k, n) inside the limits that reach a pose, from random starts; k <= attempts."""
    regions = stack_regions(robot, (TaskSpaceRegion(T_world_e, np.eye(4), np.zeros((6, 2))),))
    configurations = robot.random_configurations(rng, attempts)
    scratch = projection_scratch(robot.dof, 6)
    iterations = project_batch(robot.kinematics, regions, configurations, TOLERANCE, MAX_ITERATIONS, scratch)
    return configurations[iterations >= 0]


@dataclass(frozen=True)
class GoalSample:
    """What sampling a goal region brought.

    Attributes
    ----------
    configurations: (k, n), collision-free. poses_tried: poses drawn.
    unreachable, colliding: poses without an inverse-kinematics solution, and with none free of collision.
    """

    configurations: np.ndarray
    poses_tried: int
    unreachable: int
    colliding: int


def sample_region(
    robot: Robot,
    region: TaskSpaceRegion,
    checker: CollisionChecker,
    rng: np.random.Generator,
    count: int,
    max_poses: int = 100,
) -> GoalSample:
    """Draw up to count collision-free configurations whose end effector lies in a region, one per pose."""
    found: list[np.ndarray] = []
    unreachable = colliding = tried = 0
    while len(found) < count and tried < max_poses:
        tried += 1
        T_world_e = region.sample_pose(rng)
        reachable = False
        for _ in range(BATCHES_PER_POSE):
            candidates = solve_pose(robot, T_world_e, rng, BATCH)
            reachable = reachable or len(candidates) > 0
            free = next((q for q in candidates if not checker.in_collision(q)), None)
            if free is not None:
                found.append(free)
                break
        else:
            unreachable += not reachable
            colliding += reachable
    configurations = np.array(found).reshape(-1, robot.dof)
    return GoalSample(configurations, tried, unreachable, colliding)
