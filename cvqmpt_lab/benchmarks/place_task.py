"""The paper's tasks in the kitchen: a can is carried, a door is opened, and both in sequence.

Place task: carry a can from the counter to the shelf without tilting it. As published, environment
e in 0..149 puts the can at x = 0.4 + 0.3 u1, y = -0.6 + 1.0 u2, z = 0.171, u1 and u2 the first
uniforms of numpy's legacy generator seeded by e. The start is a collision-free grasp of that can,
the goals are up to 20 grasps of a can on the shelf, yaw within +-90 degrees; the hand stays upright
on the way.

Settings of planners were chosen in the published kitchen, on TUNING_ENVIRONMENTS.
`mirrored_problem` asks the same in a kitchen that no tuning has seen: the same modules, measured
differently and mirrored left to right.

Door: as published, the hand frame stands 0.10 m in front of the bar of the handle, its x axis down,
and the door goes from closed to -0.45 pi. Here the motion is planned: the door is the robot's
eighth joint, the constraint a region about the bar.

Multi-sequence task: open the shelf's door, take a can out, stand it upright on the counter. As
published, task k starts free of collision (seed 100 + k), the can is carried to within a decimetre
of (0.25, -0.45), and two obstacles stand on the counter. Unlike published, opening the door is
planned, not replayed; the can's final pose is drawn for every task; the can is an obstacle until it
is grasped, then it collides like the robot, and is put down LIFT above the published height.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose, rigid
from cvqmpt_lab.benchmarks.item import UnsolvableProblem
from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.goals import (
    SAMPLE_MARGIN_M,
    goals_in_any_posture,
    on_manifold,
    sample_region,
)
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    UPRIGHT_ROTATION,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    upright_box,
)
from cvqmpt_lab.problem import PlanningProblem, shared_checker
from cvqmpt_lab.results.row import PAPER_PHASES, FailReason
from cvqmpt_lab.robot.load import PANDA_FINGER_OPENING_M, panda, robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.articulation import take_out
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder
from cvqmpt_lab.tasks.task import Grasp, Hold, Move, Release, Slide, Task, Turn


@dataclass(frozen=True)
class ObjectModel:
    """The collision shape of an object, and poses of shape and centre of mass in the link frame."""

    shape: Box | Cylinder  # centred on its own frame, parallel to the link frame
    shape_centre: tuple[float, float, float]  # middle of the shape in the link frame [m]
    com: tuple[float, float, float]  # centre of mass in the link frame [m]
    mass: float  # [kg]

    def at_com(self, name: str, position_com: Sequence[float], yaw: float = 0.0) -> SceneObject:
        """Return the object with centre of mass at `position_com` (3,) [m] and a `yaw` [rad]."""
        T_world_link = pose(position_com, yaw) @ pose(-np.array(self.com))
        T_world_object = T_world_link @ pose(self.shape_centre)
        return SceneObject(name, self.shape, T_world_object, mass=self.mass)


# Masses of box and bottle: YCB Object and Model Set, Calli et al. 2015, table III.
# YcbChipsCan as scaled in the published experiment code; the mass of a full drinks can.
CAN = ObjectModel(
    Cylinder(0.0373, 0.242),
    shape_centre=(-0.005, 0.012, 0.1265),
    com=(-0.005, 0.010, 0.100),
    mass=0.35,
)
# YcbCrackerBox.
CRACKER_BOX = ObjectModel(
    Box((0.0616, 0.1575, 0.2068)), (0.028, -0.011, -0.005), com=(0.030, -0.010, -0.020), mass=0.411
)
# YcbMustardBottle; the horizontal middle of its box is taken to be the centre of mass's.
MUSTARD_BOTTLE = ObjectModel(
    Box((0.0589, 0.0986, 0.1905)), (0.005, 0.005, 0.0125), (0.005, 0.005, -0.015), mass=0.603
)

TUNING_ENVIRONMENTS = range(1000, 1060)  # same distribution, never reported
DOOR = "dagger_door_left"
DOOR_ANGLE = -1.57  # [rad]
SHELF_LINK = (0.56, -0.39, 0.642)  # the can's link frame on the shelf [m]
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])  # left to right
# [m] above the can's published place on the counter, which is 1.5 mm inside the top
LIFT = 0.005


def grasp_region(com: np.ndarray) -> TaskSpaceRegion:
    """Grasps of a can with centre of mass com (3,) [m]: from the side, yaw within +-90 degrees."""
    Tw_e = rigid(UPRIGHT_ROTATION, (-0.11, 0.0, 0.05))
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
    found = goals_in_any_posture(problem)
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
    return problem_between(
        str(environment),
        scene,
        (grasp_region(com), shelf),
        upright_box(),
        np.random.default_rng([environment, 0]),
        attachments,
        "start grasp",
    )


def problem_between(
    name: str,
    scene: Scene,
    ends: Sequence[TaskSpaceRegion],
    constraint: TaskSpaceRegion,
    rng: np.random.Generator,
    attachments: tuple[Attachment, ...] = (),
    what: str = "start",
) -> PlanningProblem | UnsolvableProblem:
    """The Panda's problem from a state drawn in one region to another one, inside of a third.

    what: is drawn, in words.
    """
    robot = robot_from_source({"name": "panda"})
    checker = shared_checker(robot, scene, attachments, SAMPLE_MARGIN_M)
    starts = sample_region(robot, ends[0], checker, rng, count=1)
    if len(starts.configurations) == 0:
        return UnsolvableProblem(name, f"no {what}: {starts.outcome}")
    return PlanningProblem(
        name=name,
        robot=robot,
        scene=scene,
        start=starts.configurations[0],
        constraint=(constraint,),
        attachments=attachments,
        goal_region=ends[1],
    )


OPEN = -0.45 * np.pi  # [rad]
BAR = f"{DOOR}/handle_bar"
GRIP = 0.0075  # [m] opening of each finger: the bar's radius
PADS = ("panda_leftfinger_3", "panda_rightfinger_3")  # pieces of the fingers that close on the bar
TURN = 0.4  # [rad] about the bar: goals lie within +- this, so that the fingers can open there


def handle_region(turn: float = FREE) -> TaskSpaceRegionChain:
    """Hand poses that hold the bar, turned about it by at most +-turn [rad]."""
    # hand z along x, hand x down
    R = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    Tw_e = rigid(R, (-0.10, 0.0, 0.0))
    Bw = np.zeros((6, 2))
    Bw[5] = -turn, turn
    return TaskSpaceRegionChain(np.eye(4), Tw_e, Bw, BAR)


@lru_cache(maxsize=2)
def door_world(finger_opening: float = GRIP) -> tuple[Scene, Robot]:
    """The kitchen without the door, and the Panda with it; only finger pads may touch the bar."""
    scene, door = take_out(kitchen(), DOOR, may_touch=[(pad, BAR) for pad in PADS])
    return scene, robot_from_source({**panda(finger_opening).source, "articulated": to_plain(door)})


def bar_pose(angle: float) -> np.ndarray:
    """T_world_bar (4, 4) with the door at an angle [rad]; InvalidInputError outside its range."""
    return kitchen().with_joint(DOOR, angle)[BAR].T_world_object


def door_problem(seed: int, goals_needed: int = 10) -> PlanningProblem | UnsolvableProblem:
    """Open the door, from a grasp of the closed one; goals are sampled by `pipeline.solve`.

    Args:
        seed: of the start grasp.
        goals_needed: in whose posture so many of `goals.MAX_GOALS` are found; one that reaches
            fewer stands at a limit and may get stuck.
    """
    scene, robot = door_world()
    # a closed door is only 1 mm from its neighbour
    checker = CollisionChecker(robot, scene, margin=5e-4)
    grasp = handle_region(turn=0.0)
    goal = handle_region(TURN).at(bar_pose(OPEN))
    rng = np.random.default_rng([seed, 1])
    starts = sample_region(robot, grasp.at(bar_pose(0.0)), checker, rng, count=20, within=(grasp,))
    for start in starts.configurations:
        problem = PlanningProblem(
            name=str(seed),
            robot=robot,
            scene=scene,
            start=start,
            goals=np.empty((0, robot.dof)),
            constraint=(handle_region(),),
            goal_region=goal,
        )
        if len(on_manifold(problem, goals_in_any_posture(problem).configurations)) >= goals_needed:
            return problem
    return UnsolvableProblem(
        str(seed), f"no start grasp whose posture reaches the goal: {starts.outcome}"
    )


CAN_NAME = "can"


@lru_cache(maxsize=1)
def sequence_world() -> Scene:
    """The kitchen, door closed, with the two obstacles on the counter and the can on the shelf."""
    centre = np.add(SHELF_LINK, CAN.com) + (0.0, 0.0, CAN.shape_centre[2] - CAN.com[2])
    return kitchen().with_objects(
        CRACKER_BOX.at_com("cracker_box", (0.600, -0.623, 0.287), -np.pi / 4),
        MUSTARD_BOTTLE.at_com("mustard_bottle", (0.550, -0.303, 0.262)),
        # its axis through its centre of mass
        SceneObject(CAN_NAME, CAN.shape, pose(centre), mass=CAN.mass),
    )


def multi_sequence_task(number: int) -> Task:
    """Task `number`; 0 to 9 are the paper's, others follow the same distribution."""
    if number < 0:
        raise InvalidInputError(
            f"multi-sequence task {number}: give 0 or more, the paper's are 0 to 9"
        )
    robot = robot_from_source({"name": "panda"})
    rng = np.random.default_rng(100 + number)
    checker = CollisionChecker(robot, sequence_world(), margin=SAMPLE_MARGIN_M)
    start = robot.random_configurations(rng, 1)[0]
    while checker.in_collision(start):
        start = robot.random_configurations(rng, 1)[0]
    # where the can's centre of mass goes: within a square of a decimetre
    target = np.array((0.25, -0.45, 0.271 + LIFT))
    target[:2] += 0.1 * rng.uniform(size=2)
    grasp = grasp_region(np.add(SHELF_LINK, CAN.com))
    approach = 0.08  # [m] straight to the can: depth of the fingers, and 3 mm of play
    pregrasp = TaskSpaceRegion(grasp.T0_w, grasp.Tw_e @ pose((0.0, 0.0, -approach)), grasp.Bw)
    reach_handle, reach_can, carry = PAPER_PHASES
    can_grip = CAN.shape.radius  # type: ignore[union-attr]
    open_fingers, grip = {"finger_opening": PANDA_FINGER_OPENING_M}, {"finger_opening": GRIP}
    return Task(
        name=str(number),
        robot=robot.source,
        scene=sequence_world(),
        start=start,
        phases=(
            Move(reach_handle, handle_region(turn=0.0).at(bar_pose(0.0))),
            Hold("hold-handle", DOOR, grip, tuple((pad, handle_region().base) for pad in PADS)),
            Turn("open-door", OPEN, handle_region(), handle_region(turn=TURN)),
            Release("let-go", open_fingers),
            Move(reach_can, pregrasp),
            Slide("approach", approach),
            Grasp("grasp-can", CAN_NAME, {"finger_opening": can_grip}),
            Move(carry, grasp_region(target), (upright_box(),)),
            Release("put-down", open_fingers),
        ),
    )
