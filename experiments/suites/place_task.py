"""The place task: carry a can from the kitchen counter to the shelf without tilting it.

As published, environment e in 0..149 puts the can at x = 0.4 + 0.3 u1, y = -0.6 + 1.0 u2, z = 0.171, u1 and u2 the
first uniforms of numpy's legacy generator seeded by e. The start is a collision-free grasp of that can, the goals are
up to 20 grasps of a can on the shelf, yaw within +-90 degrees; the hand stays upright on the way.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.task_space_region import UPRIGHT_ROTATION, TaskSpaceRegion, upright
from cvqmpt_lab.pipeline import drawn_goals
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem, shared_checker
from cvqmpt_lab.results.row import FailReason
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.objects import CAN
from cvqmpt_lab.scene.scene import Attachment, Scene

ENVIRONMENTS = range(150)
TUNING_ENVIRONMENTS = range(1000, 1060)  # same distribution, never reported
GOALS = 20
SINGLE_GOAL_ENVIRONMENTS = range(30)
DOOR = "dagger_door_left"
DOOR_ANGLE = -1.57  # [rad]
SHELF_LINK = (0.56, -0.39, 0.642)  # the can's link frame on the shelf [m]
LIFT = 0.005  # [m] by which a can that collides is above its published place on the counter, 1.5 mm inside the top


@dataclass(frozen=True)
class UnsolvableProblem:
    """An environment without a planning problem, and why."""

    name: str
    reason: str
    kind: FailReason = FailReason.NO_START  # what its rows are counted as


def grasp_region(com: np.ndarray) -> TaskSpaceRegion:
    """Hand poses that grasp a can with centre of mass com (3,) [m]: from the side, yaw within +-90 degrees."""
    Tw_e = pose((-0.11, 0.0, 0.05))
    Tw_e[:3, :3] = UPRIGHT_ROTATION
    Bw = np.zeros((6, 2))
    Bw[5] = (-np.pi / 2, np.pi / 2)
    return TaskSpaceRegion(pose(com), Tw_e, Bw)


@lru_cache(maxsize=1)
def _on_the_shelf() -> TaskSpaceRegion:
    return grasp_region(np.add(SHELF_LINK, CAN.com))


def can_com(environment: int) -> np.ndarray:
    """Centre of mass (3,) [m] of the can on the counter of an environment."""
    u1, u2 = np.random.RandomState(environment).uniform(size=2)
    return np.array([0.4 + 0.3 * u1, -0.6 + 1.0 * u2, 0.171]) + CAN.com


@lru_cache(maxsize=1)
def carried_can() -> Attachment:
    """The can in the hand, at the grasp of `grasp_region`."""
    # Yaw is about the centre of mass, 2 mm off the cylinder's axis: the axis is taken instead.
    above = pose((0.0, 0.0, CAN.shape_centre[2] - CAN.com[2]))
    return Attachment("carried_can", CAN.shape, np.linalg.inv(grasp_region(np.zeros(3)).Tw_e) @ above)


@lru_cache(maxsize=1)
def _world() -> Scene:
    return kitchen(door_angles={DOOR: DOOR_ANGLE})


def single_goal_problem(environment: int) -> PlanningProblem | UnsolvableProblem:
    """The same with the first of its goals alone, so that a planner cannot choose an easier one."""
    problem = place_problem(environment)
    if isinstance(problem, UnsolvableProblem):
        return problem
    found = drawn_goals(problem)
    if len(found.configurations) == 0:
        return UnsolvableProblem(problem.name, f"no goal: {found.outcome}", FailReason.NO_GOAL)
    return problem.with_goals(found.configurations[:1])


def place_problem(environment: int, with_can: bool = False) -> PlanningProblem | UnsolvableProblem:
    """The problem of one environment, goals sampled by `pipeline.solve`; with_can: the can is part of the robot.

    The published experiment leaves the can out; with it the can is LIFT higher.
    """
    name = str(environment)
    robot = robot_from_source({"name": "panda"})
    attachments = (carried_can(),) if with_can else ()
    checker = shared_checker(robot, _world(), attachments, SAMPLE_MARGIN)
    rng = np.random.default_rng([environment, 0])
    com = can_com(environment) + (0.0, 0.0, LIFT * with_can)
    start = sample_region(robot, grasp_region(com), checker, rng, count=1)
    if len(start.configurations) == 0:
        return UnsolvableProblem(name, f"no start grasp: {start.outcome}")
    return PlanningProblem(
        name=name,
        robot=robot,
        scene=_world(),
        start=start.configurations[0],
        goals=np.empty((0, robot.dof)),
        constraint=(upright(),),
        attachments=attachments,
        goal_region=_on_the_shelf(),
    )
