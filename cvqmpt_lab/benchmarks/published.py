"""Place task and multi-sequence task as the published code has them, not the paper's text.

Place task: the can is carried from the shelf to the counter, and F jumps at its bounds. The code
has one start, in a file that is not published. Here a start is drawn for each environment, because
answers depend on it: suites with one start each show how far.

Multi-sequence task: the code plans three phases, from random configurations to the handle, from the
open door to the can, and from there to the counter. The arm is at a fixed configuration where one
phase ends and the next begins, and the door's motion is stored. So phases are problems of their
own: `published_phases`. The can is no obstacle and is not modelled in the hand. The stored files
are in no repository: `door_motion` and the ordinary grasp in SHELF_GRASPS are ours. In
`planned_door_task`, the planner opens the door.
"""

from dataclasses import replace
from functools import cached_property, lru_cache, partial

import numpy as np

from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.benchmarks.item import Phases, UnsolvableProblem
from cvqmpt_lab.benchmarks.place_task import (
    DOOR_OPEN_RAD,
    HANDLE_GRIP_M,
    SHELF_DOOR,
    bar_pose,
    can_com,
    grasp_region,
    handle_region,
    multi_sequence_task,
    pads_on_bar,
    place_scene,
    sequence_of,
    sequence_start,
    sequence_world,
    shelf_com,
)
from cvqmpt_lab.benchmarks.results.row import PAPER_PHASES
from cvqmpt_lab.collision.exact import CollisionChecker, shared_checker
from cvqmpt_lab.constraints.goals import (
    MAX_GOALS,
    SAMPLE_MARGIN_M,
    sample_goals,
    sample_region,
    solve_poses,
)
from cvqmpt_lab.constraints.region_constraint import JumpingConstraint
from cvqmpt_lab.constraints.task_space_region import upright_box
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.features.tasks.world import World, phase_goals
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import panda, robot_from_source
from cvqmpt_lab.robot.mechanism import with_articulated_object
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.articulation import take_out

# grasps of the can on the shelf, from the front [rad]
SHELF_GRASPS = {
    "ordinary": (1.082, -0.785, -1.226, -1.743, 0.082, 2.975, -0.023),
    # the elbow is turned over, joint 5 at its limit
    "at-limit": (-0.2565, 1.6175, -2.6052, -1.5831, -2.8967, 1.4679, 0.2572),
}
ORDINARY_RAD = 0.2  # least distance of an ordinary configuration from the joint limits


class PublishedProblem(PlanningProblem):
    """A problem that planners of OMPL solve with the settings of the published code.

    F jumps at its bounds. Without a constraint, motions have no longest length, and are checked at
    OMPL's default distance.
    """

    @cached_property
    def manifold(self) -> JumpingConstraint:
        """The constraint F(q) = 0."""
        return JumpingConstraint(self.robot, self.constraint)


def published_problem(
    environment: int, grasp: str | None = None
) -> PlanningProblem | UnsolvableProblem:
    """Return the place task as the published code has it, from the shelf to the counter.

    Args:
        environment: number of the environment, which decides where on the counter the can goes.
        grasp: the start, a key of SHELF_GRASPS; None: an ordinary grasp from the front is drawn for
            each environment.
    """
    robot, scene = robot_from_source({"name": "panda"}), place_scene()
    start = None if grasp is None else np.array(SHELF_GRASPS[grasp])
    if start is None:
        straight = replace(grasp_region(shelf_com()), Bw=np.zeros((6, 2)))
        checker = shared_checker(robot, scene, (), SAMPLE_MARGIN_M)
        rng = np.random.default_rng([environment, 0])
        found = sample_region(robot, straight, checker, rng, count=20)
        ordinary = [q for q in found.configurations if _ordinary(robot, q)]
        if not ordinary:
            return UnsolvableProblem(
                str(environment), f"no start grasp away from all limits: {found.outcome}"
            )
        start = ordinary[0]
    return PublishedProblem(
        name=str(environment),
        robot=robot,
        scene=scene,
        start=start,
        constraint=(upright_box(),),
        goal_region=grasp_region(can_com(environment)),
    )


def _ordinary(robot: Robot, q: np.ndarray) -> bool:
    """Return whether a configuration (n,) is ORDINARY_RAD inside all joint limits."""
    return bool(np.minimum(q - robot.lower, robot.upper - q).min() >= ORDINARY_RAD)


def published_phases(number: int) -> Phases:
    """Return the three phases of task `number` that the published code plans.

    The code draws the can's final pose after it has seeded its generator with 0: it is the same in
    all tasks. Goals of the last phase are drawn for each task.
    """
    _, start = sequence_start(number)
    robot, motion = robot_from_source({"name": "panda"}), door_motion()
    at_can = np.array(SHELF_GRASPS["ordinary"])
    closed = sequence_world().without("can")
    opened = closed.with_joint(SHELF_DOOR, DOOR_OPEN_RAD)
    free = partial(PublishedProblem, robot=robot)
    reach_handle, reach_can, carry = (f"{number}/{phase}" for phase in PAPER_PHASES)
    target = np.append(np.add((0.25, -0.45), _final_shift()), 0.271)
    carried = free(
        name=carry,
        scene=opened,
        start=at_can,
        constraint=(upright_box(),),
        goal_region=grasp_region(target),
    )
    goals = sample_goals(carried, np.random.default_rng([number, 3]), MAX_GOALS)
    problems = (
        free(name=reach_handle, scene=closed, start=start, goals=motion[:1]),
        free(name=reach_can, scene=opened, start=motion[-1], goals=at_can[None]),
        carried.changed(goals=goals.configurations),
    )
    return Phases(str(number), dict(zip(PAPER_PHASES, problems, strict=True)))


def _final_shift() -> np.ndarray:
    """Return the shift (2,) of the can's final place within its square [m], see `sequence_of`."""
    return 0.1 * np.random.RandomState(0).uniform(size=4)[2:]


@lru_cache(maxsize=1)
def door_motion() -> np.ndarray:
    """Return configurations (80, n) of the arm that pull the shelf's door open [rad].

    As published, the hand keeps its pose at the bar, and each configuration is found by inverse
    kinematics from the one before. The motion begins at the first grasp drawn with seed 0 from
    which it is free of collision and both its ends are ordinary.
    """
    arm, scene = robot_from_source({"name": "panda"}), sequence_world()
    open_hand = CollisionChecker(arm, scene, margin=SAMPLE_MARGIN_M)
    # a closed door is only 1 mm from its neighbour
    rest, door = take_out(scene, SHELF_DOOR, may_touch=pads_on_bar())
    gripping = with_articulated_object(panda(HANDLE_GRIP_M), door)
    checker = CollisionChecker(gripping, rest, margin=5e-4)
    rng, grasp = np.random.default_rng(0), handle_region(turn=0.0).at(bar_pose(0.0))
    for start in sample_region(arm, grasp, open_hand, rng, count=60).configurations:
        motion = _followed(arm, start, np.linspace(0.0, DOOR_OPEN_RAD, 80))
        if len(motion) == 80 and not checker.in_collision_batch(motion).any():
            arm_motion = frozen(motion[:, :-1])
            if _ordinary(arm, arm_motion[0]) and _ordinary(arm, arm_motion[-1]):
                return arm_motion
    raise AssertionError("no grasp of the handle opens the door")


def _followed(arm: Robot, start: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return configurations (k, n + 1) that hold the bar, with the angles of the door [rad].

    Fewer than there are angles if one is out of reach, or far from the one before.

    Args:
        arm: the arm.
        start: configuration (n,) at the first angle [rad].
        angles: of the door, in order [rad].
    """
    found = [np.append(start, angles[0])]
    for angle in angles[1:]:
        region, before = handle_region(turn=0.0).at(bar_pose(angle)), found[-1][:-1]
        T_world_hand = region.T0_w @ region.Tw_e
        reached = solve_poses(arm, region, T_world_hand[None], before[None, None].copy())[0]
        if len(reached) == 0 or np.abs(reached[0] - before).max() > 0.3:
            break
        found.append(np.append(reached[0], angle))
    return np.array(found)


def planned_door_task(number: int) -> Task:
    """Return task `number` with the final pose of `published_phases`, its door opened by a planner.

    The handle and the can are reached in one fixed configuration each.
    """
    _, start = sequence_start(number)
    task = sequence_of(number, start, _final_shift())
    fixed = dict(zip(PAPER_PHASES[:2], _fixed_configurations(), strict=True))
    return task.changed(
        phases=tuple(
            phase.changed(configuration=fixed[phase.name]) if phase.name in fixed else phase
            for phase in task.phases
        )
    )


@lru_cache(maxsize=1)
def _fixed_configurations() -> tuple[np.ndarray, np.ndarray]:
    """Return the configurations (n,) at the handle and at the can: the first goals of task 0."""
    task = multi_sequence_task(0)
    closed = World.before(task)
    opened = replace(closed, scene=closed.scene.with_joint(SHELF_DOOR, DOOR_OPEN_RAD))
    names = [phase.name for _, phase in task.planned]
    at_handle, at_can = (
        phase_goals(task, names.index(name), world)[0][0]
        for name, world in zip(PAPER_PHASES[:2], (closed, opened), strict=True)
    )
    return at_handle, at_can
