"""The paper's tasks in the kitchen: a can is carried, a door is opened, and both in sequence.

Place task: carry a can from the counter to the shelf without tilting it. As published, environment
e in 0..149 puts the can at x = 0.4 + 0.3 u1, y = -0.6 + 1.0 u2, z = 0.171, u1 and u2 the first
uniforms of numpy's legacy generator seeded by e. The start is a collision-free grasp of that can,
the goals are up to 20 grasps of a can on the shelf, yaw within +-90 degrees; the hand stays upright
on the way.

Settings of planners were chosen in the published kitchen, on TUNING_ENVIRONMENTS.
`mirrored_problem` is the same task in a kitchen that no tuning has seen: the same modules, with
other measures and mirrored left to right.

Door: as published, the hand frame stands 0.10 m in front of the bar of the handle, its x axis down,
and the door goes from closed to -0.45 pi. Here the motion is planned: the door is the robot's
eighth joint, the constraint a region about the bar.

Multi-sequence task: open the shelf's door, take a can out, stand it upright on the counter. As
published, task k starts free of collision (seed 100 + k), the can is carried to within a decimetre
of (0.25, -0.45), and two obstacles stand on the counter. Unlike published, opening the door is
planned, not replayed; the can's final pose is drawn for every task; the can is an obstacle until it
is grasped, then it collides like the robot, and is put down CAN_LIFT_M above the published height.
`benchmarks.published` has both tasks as the published code has them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose, rigid
from cvqmpt_lab.benchmarks.item import ExecutedProblem, Solvable, UnsolvableProblem
from cvqmpt_lab.benchmarks.kitchen import kitchen
from cvqmpt_lab.benchmarks.results.row import PAPER_PHASES, FailReason, phase_problem
from cvqmpt_lab.collision.exact import CollisionChecker, shared_checker
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
from cvqmpt_lab.features.tasks.task import Grasp, Hold, Move, Release, Slide, Task, Turn
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import PANDA_FINGER_OPENING_M, panda, robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.articulation import take_out
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder


@dataclass(frozen=True)
class ObjectModel:
    """Collision shape of an object, and positions of shape and centre of mass in its link frame."""

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
COUNTER_OBJECTS = {
    # YcbCrackerBox
    "cracker_box": ObjectModel(
        Box((0.0616, 0.1575, 0.2068)),
        shape_centre=(0.028, -0.011, -0.005),
        com=(0.030, -0.010, -0.020),
        mass=0.411,
    ),
    # YcbMustardBottle; the centre of mass is assumed in the horizontal middle of its box
    "mustard_bottle": ObjectModel(
        Box((0.0589, 0.0986, 0.1905)),
        shape_centre=(0.005, 0.005, 0.0125),
        com=(0.005, 0.005, -0.015),
        mass=0.603,
    ),
}

TUNING_ENVIRONMENTS = range(1000, 1060)  # same distribution, never reported
SHELF_DOOR = "dagger_door_left"
# height above the can's published place on the counter, which is 1.5 mm inside the top
CAN_LIFT_M = 0.005


def grasp_region(com: np.ndarray) -> TaskSpaceRegion:
    """Return grasps of a can with centre of mass com (3,) [m], from the side.

    The yaw is within +-90 degrees.
    """
    Tw_e = rigid(UPRIGHT_ROTATION, (-0.11, 0.0, 0.05))
    Bw = np.zeros((6, 2))
    Bw[5] = (-np.pi / 2, np.pi / 2)
    return TaskSpaceRegion(pose(com), Tw_e, Bw)


def can_com(environment: int) -> np.ndarray:
    """Return the centre of mass (3,) [m] of the can on the counter of an environment."""
    u1, u2 = np.random.RandomState(environment).uniform(size=2)
    return np.array([0.4 + 0.3 * u1, -0.6 + 1.0 * u2, 0.171]) + CAN.com


def shelf_com() -> np.ndarray:
    """Return the centre of mass (3,) [m] of the can on the shelf."""
    return np.add((0.56, -0.39, 0.642), CAN.com)  # the origin of its link frame, and the offset


@lru_cache(maxsize=1)
def carried_can() -> Attachment:
    """Return the can in the hand, at the grasp of `grasp_region`."""
    # Yaw is about the centre of mass, 2 mm off the cylinder's axis: the axis is taken instead.
    above = pose((0.0, 0.0, CAN.shape_centre[2] - CAN.com[2]))
    T_hand_object = np.linalg.inv(grasp_region(np.zeros(3)).Tw_e) @ above
    return Attachment("carried_can", CAN.shape, T_hand_object, CAN.mass)


def place_kitchen(changes: Mapping[str, float] | None = None) -> Scene:
    """Return the kitchen with the shelf's door open as in the place task.

    changes: dimensions that differ from those of `kitchen.toml`, by name.
    """
    return kitchen(changes, {SHELF_DOOR: -1.57})


@lru_cache(maxsize=1)
def place_scene() -> Scene:
    """Return the kitchen of the place task."""
    return place_kitchen()


@lru_cache(maxsize=1)
def _mirrored_scene() -> Scene:
    """Return the kitchen with other measures, mirrored; shapes are their own mirror images."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    # [m]; wider, flatter and higher cabinets, a lower hood
    remeasured = {"cabinet_width": 0.42, "wall_cabinet_depth": 0.33}
    remeasured |= {"dagger_bottom_z": 0.6765, "hood_bottom_z": 0.70}
    scene = place_kitchen(remeasured)
    objects = tuple(
        replace(item, T_world_object=mirror @ item.T_world_object @ mirror)
        for item in scene.objects
    )
    return Scene("kitchen mirrored", objects)


def mirrored_problem(environment: int) -> PlanningProblem | UnsolvableProblem:
    """Return the problem of one environment in the mirrored kitchen."""
    side = np.array([1.0, -1.0, 1.0])
    # the can's link frame on the shelf before it is mirrored [m]
    shelf = grasp_region(side * np.add((0.60, -0.41, 0.692), CAN.com))
    return _problem(environment, _mirrored_scene(), side * can_com(environment), shelf)


def single_goal_problem(environment: int) -> PlanningProblem | UnsolvableProblem:
    """Return a problem with one goal, so that no planner can choose an easier one."""
    return with_first_goal(place_problem(environment))


def with_first_goal(
    problem: PlanningProblem | UnsolvableProblem,
) -> PlanningProblem | UnsolvableProblem:
    """Return a problem with only the first goal that is drawn for it."""
    if isinstance(problem, UnsolvableProblem):
        return problem
    found = goals_in_any_posture(problem)
    if len(found.configurations) == 0:
        return UnsolvableProblem(problem.name, f"no goal: {found.outcome}", FailReason.NO_GOAL)
    return problem.changed(goals=found.configurations[:1])


def place_problem(environment: int, with_can: bool = False) -> PlanningProblem | UnsolvableProblem:
    """Return the problem of one environment; `pipeline.solve` samples its goals.

    with_can: the can is part of the robot and CAN_LIFT_M higher; the published experiment leaves it
        out.
    """
    attachments = (carried_can(),) if with_can else ()
    lift = CAN_LIFT_M if with_can else 0.0
    com = can_com(environment) + (0.0, 0.0, lift)
    shelf = grasp_region(shelf_com())
    return _problem(environment, place_scene(), com, shelf, attachments)


def _problem(
    environment: int,
    scene: Scene,
    com: np.ndarray,
    shelf: TaskSpaceRegion,
    attachments: tuple[Attachment, ...] = (),
) -> PlanningProblem | UnsolvableProblem:
    """Return the problem from a grasp of the can at com (3,) [m] to grasps on the shelf."""
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
    """Return a problem of the Panda from a state drawn in one region to another region.

    Args:
        name: name of the problem.
        scene: with all obstacles.
        ends: regions of the hand at the start and at the goal.
        constraint: region of the hand on the way.
        rng: random generator for the start.
        attachments: objects in the hand.
        what: noun for the start in the error message.
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


DOOR_OPEN_RAD = -0.45 * np.pi
HANDLE_BAR = f"{SHELF_DOOR}/handle_bar"
HANDLE_GRIP_M = 0.0075  # opening of each finger: the bar's radius


def pads_on_bar() -> tuple[tuple[str, str], ...]:
    """Return the pairs of a piece of a finger and the bar that touch when the hand holds it."""
    return tuple((pad, HANDLE_BAR) for pad in ("panda_leftfinger_3", "panda_rightfinger_3"))


def handle_region(turn: float = FREE) -> TaskSpaceRegionChain:
    """Return the hand poses that hold the bar, turned about it by at most +-turn [rad]."""
    # hand z along x, hand x down
    R = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    Tw_e = rigid(R, (-0.10, 0.0, 0.0))
    Bw = np.zeros((6, 2))
    Bw[5] = -turn, turn
    return TaskSpaceRegionChain(np.eye(4), Tw_e, Bw, HANDLE_BAR)


def opened_handle_region() -> TaskSpaceRegionChain:
    """Return the hand poses of goals: turned by at most 0.4 rad, so that the fingers can open."""
    return handle_region(turn=0.4)


@lru_cache(maxsize=2)
def door_world(finger_opening: float = HANDLE_GRIP_M) -> tuple[Scene, Robot]:
    """Return the kitchen without the door, and the Panda with it.

    Only finger pads may touch the bar. finger_opening: of each finger [m].
    """
    scene, door = take_out(kitchen(), SHELF_DOOR, may_touch=pads_on_bar())
    return scene, robot_from_source({**panda(finger_opening).source, "articulated": to_plain(door)})


def bar_pose(angle: float) -> np.ndarray:
    """Return T_world_bar (4, 4) with the door at an angle [rad].

    Raises:
        InvalidInputError: the angle is outside the door's range.
    """
    return kitchen().with_joint(SHELF_DOOR, angle)[HANDLE_BAR].T_world_object


def door_problem(seed: int, goals_needed: int = 10) -> PlanningProblem | UnsolvableProblem:
    """Return the problem to open the door from a grasp of the closed door.

    `pipeline.solve` samples its goals.

    Args:
        seed: random seed of the start grasp.
        goals_needed: number of goals that must be found in the posture of the start; a start that
            reaches fewer stands at a joint limit and may get stuck.
    """
    scene, robot = door_world()
    # a closed door is only 1 mm from its neighbour
    checker = CollisionChecker(robot, scene, margin=5e-4)
    grasp = handle_region(turn=0.0)
    goal = opened_handle_region().at(bar_pose(DOOR_OPEN_RAD))
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


@lru_cache(maxsize=1)
def sequence_world() -> Scene:
    """Return the kitchen with a closed door, two obstacles on the counter, the can on the shelf."""
    centre = shelf_com() + (0.0, 0.0, CAN.shape_centre[2] - CAN.com[2])
    box, bottle = COUNTER_OBJECTS["cracker_box"], COUNTER_OBJECTS["mustard_bottle"]
    return kitchen().with_objects(
        box.at_com("cracker_box", (0.600, -0.623, 0.287), -np.pi / 4),
        bottle.at_com("mustard_bottle", (0.550, -0.303, 0.262)),
        # its axis through its centre of mass
        SceneObject("can", CAN.shape, pose(centre), mass=CAN.mass),
    )


def multi_sequence_task(number: int) -> Task:
    """Return task `number`; 0 to 9 are the paper's, others follow the same distribution."""
    rng, start = sequence_start(number)
    return sequence_of(number, start, 0.1 * rng.uniform(size=2))


def sequence_start(number: int) -> tuple[np.random.Generator, np.ndarray]:
    """Return a task's generator, and its start (n,) free of collision [rad]."""
    if number < 0:
        raise InvalidInputError(
            f"multi-sequence task {number}: give 0 or more, the paper's are 0 to 9"
        )
    robot = robot_from_source({"name": "panda"})
    rng = np.random.default_rng(100 + number)
    checker = shared_checker(robot, sequence_world(), (), SAMPLE_MARGIN_M)
    start = robot.random_configurations(rng, 1)[0]
    while checker.in_collision(start):
        start = robot.random_configurations(rng, 1)[0]
    return rng, start


def sequence_of(number: int, start: np.ndarray, shift: np.ndarray) -> Task:
    """Return task `number` from a start (n,) [rad]; shift: of the can's final place (2,) [m]."""
    robot = robot_from_source({"name": "panda"})
    # where the can's centre of mass goes: within a square of a decimetre
    target = np.array((0.25, -0.45, 0.271 + CAN_LIFT_M))
    target[:2] += shift
    grasp = grasp_region(shelf_com())
    approach = 0.08  # [m] straight to the can: depth of the fingers, and 3 mm of play
    pregrasp = TaskSpaceRegion(grasp.T0_w, grasp.Tw_e @ pose((0.0, 0.0, -approach)), grasp.Bw)
    reach_handle, reach_can, carry = PAPER_PHASES
    can_grip = CAN.shape.radius  # type: ignore[union-attr]
    open_fingers = {"finger_opening": PANDA_FINGER_OPENING_M}
    grip = {"finger_opening": HANDLE_GRIP_M}
    return Task(
        name=str(number),
        robot=robot.source,
        scene=sequence_world(),
        start=start,
        phases=(
            Move(reach_handle, handle_region(turn=0.0).at(bar_pose(0.0))),
            Hold("hold-handle", SHELF_DOOR, grip, pads_on_bar()),
            Turn("open-door", DOOR_OPEN_RAD, handle_region(), opened_handle_region()),
            Release("let-go", open_fingers),
            Move(reach_can, pregrasp),
            Slide("approach", approach),
            Grasp("grasp-can", "can", {"finger_opening": can_grip}),
            Move(carry, grasp_region(target), (upright_box(),)),
            Release("put-down", open_fingers),
        ),
    )


def executed_problem(index: int) -> ExecutedProblem | UnsolvableProblem:
    """Return motion or task number index // 2, at full speed (even index) or half speed (odd).

    Numbers below 50 are motions; task k has number 50 + k.

    Each is executed by two controllers; one of them does not know the load in the hand.
    """
    motions = 50  # larger numbers are tasks
    number, at_half_speed = divmod(index, 2)
    speed = 0.5 if at_half_speed else 1.0
    if number < motions:
        kind, first_group = "motion", 1
        problem: Solvable | UnsolvableProblem = place_problem(number, with_can=True)
    else:
        kind, first_group = "task", 5
        problem = multi_sequence_task(number - motions)
    if isinstance(problem, UnsolvableProblem):
        return UnsolvableProblem(str(index), problem.reason, problem.kind)
    kind = f"{kind}, speed {speed:g}"
    group = first_group + 2 * at_half_speed
    controllers = {
        phase_problem(str(index), group, kind): "computed-torque",
        phase_problem(str(index), group + 1, f"{kind}, load unknown"): (
            "computed-torque-unknown-load"
        ),
    }
    return ExecutedProblem(str(index), problem, speed, controllers)
