"""The place task: carry a can from the kitchen counter to the shelf without tilting it.

As published, environment e in 0..149 puts the can at x = 0.4 + 0.3 u1, y = -0.6 + 1.0 u2, z =
0.171, u1 and u2 the first uniforms of numpy's legacy generator seeded by e. The start is a
collision-free grasp of that can, the goals are up to 20 grasps of a can on the shelf, yaw within
+-90 degrees; the hand stays upright on the way.

Settings of planners were chosen in the published kitchen, on TUNING_ENVIRONMENTS.
`mirrored_problem` asks the same in a kitchen that no tuning has seen: the same modules, measured
differently and mirrored left to right.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.objects import CAN
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.task_space_region import UPRIGHT_ROTATION, TaskSpaceRegion, upright_box
from cvqmpt_lab.pipeline import drawn_goals
from cvqmpt_lab.poses import pose
from cvqmpt_lab.problem import PlanningProblem, shared_checker
from cvqmpt_lab.results.row import FailReason
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.scene.kitchen import kitchen
from cvqmpt_lab.scene.scene import Attachment, Scene

ENVIRONMENTS = range(150)
TUNING_ENVIRONMENTS = range(1000, 1060)  # same distribution, never reported
DOOR = "dagger_door_left"
DOOR_ANGLE = -1.57  # [rad]
SHELF_LINK = (0.56, -0.39, 0.642)  # the can's link frame on the shelf [m]
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])  # left to right
# [m] above the can's published place on the counter, which is 1.5 mm inside the top
LIFT = 0.005


def grasp_region(com: np.ndarray) -> TaskSpaceRegion:
    """Grasps of a can with centre of mass com (3,) [m]: from the side, yaw within +-90 degrees."""
    Tw_e = pose((-0.11, 0.0, 0.05))
    Tw_e[:3, :3] = UPRIGHT_ROTATION
    Bw = np.zeros((6, 2))
    Bw[5] = (-np.pi / 2, np.pi / 2)
    return TaskSpaceRegion(pose(com), Tw_e, Bw)


def can_com(environment: int) -> np.ndarray:
    """Centre of mass (3,) [m] of the can on the counter of an environment."""
    u1, u2 = np.random.RandomState(environment).uniform(size=2)
    return np.array([0.4 + 0.3 * u1, -0.6 + 1.0 * u2, 0.171]) + CAN.com


@lru_cache(maxsize=1)
def carried_can() -> Attachment:
    """The can in the hand, at the grasp of `grasp_region`."""
    # Yaw is about the centre of mass, 2 mm off the cylinder's axis: the axis is taken instead.
    above = pose((0.0, 0.0, CAN.shape_centre[2] - CAN.com[2]))
    T_hand_object = np.linalg.inv(grasp_region(np.zeros(3)).Tw_e) @ above
    return Attachment("carried_can", CAN.shape, T_hand_object, CAN.mass)


@lru_cache(maxsize=1)
def _world() -> Scene:
    return kitchen(door_angles={DOOR: DOOR_ANGLE})


@lru_cache(maxsize=1)
def _mirrored_world() -> Scene:
    """The re-measured kitchen, mirrored. Its boxes and cylinders are their own mirror images."""
    # [m]; wider, flatter and higher cabinets, a lower hood
    remeasured = {"cabinet_width": 0.42, "wall_cabinet_depth": 0.33}
    remeasured |= {"dagger_bottom_z": 0.6765, "hood_bottom_z": 0.70}
    scene = kitchen(remeasured, {DOOR: DOOR_ANGLE})
    objects = tuple(
        replace(item, T_world_object=MIRROR @ item.T_world_object @ MIRROR)
        for item in scene.objects
    )
    return Scene("kitchen mirrored", objects)


def mirrored_problem(environment: int) -> PlanningProblem | UnsolvableProblem:
    """The problem of one environment in the mirrored kitchen."""
    side = MIRROR.diagonal()[:3]
    # the can's link frame on the shelf before it is mirrored [m]
    shelf = grasp_region(side * np.add((0.60, -0.41, 0.692), CAN.com))
    return _problem(environment, _mirrored_world(), side * can_com(environment), shelf)


def single_goal_problem(environment: int) -> PlanningProblem | UnsolvableProblem:
    """The problem with its first goal alone, so that planners cannot choose an easier one."""
    return with_first_goal(place_problem(environment))


def with_first_goal(
    problem: PlanningProblem | UnsolvableProblem,
) -> PlanningProblem | UnsolvableProblem:
    """A problem with the first goal that is drawn for it alone."""
    if isinstance(problem, UnsolvableProblem):
        return problem
    found = drawn_goals(problem)
    if len(found.configurations) == 0:
        return UnsolvableProblem(problem.name, f"no goal: {found.outcome}", FailReason.NO_GOAL)
    return problem.changed(goals=found.configurations[:1])


def place_problem(environment: int, with_can: bool = False) -> PlanningProblem | UnsolvableProblem:
    """The problem of one environment; `pipeline.solve` samples its goals.

    with_can: the can is part of the robot and LIFT higher; the published experiment leaves it out.
    """
    attachments = (carried_can(),) if with_can else ()
    com = can_com(environment) + (0.0, 0.0, LIFT * with_can)
    return _problem(
        environment, _world(), com, grasp_region(np.add(SHELF_LINK, CAN.com)), attachments
    )


def _problem(
    environment: int,
    scene: Scene,
    com: np.ndarray,
    shelf: TaskSpaceRegion,
    attachments: tuple[Attachment, ...] = (),
) -> PlanningProblem | UnsolvableProblem:
    """Problem from a grasp of the can at com (3,) [m] to grasps of the one on the shelf."""
    name = str(environment)
    robot = robot_from_source({"name": "panda"})
    checker = shared_checker(robot, scene, attachments, SAMPLE_MARGIN)
    rng = np.random.default_rng([environment, 0])
    start = sample_region(robot, grasp_region(com), checker, rng, count=1)
    if len(start.configurations) == 0:
        return UnsolvableProblem(name, f"no start grasp: {start.outcome}")
    return PlanningProblem(
        name=name,
        robot=robot,
        scene=scene,
        start=start.configurations[0],
        goals=np.empty((0, robot.dof)),
        constraint=(upright_box(),),
        attachments=attachments,
        goal_region=shelf,
    )
