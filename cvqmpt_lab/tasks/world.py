"""One moment of a task: the arm's configuration, what the hand holds, the scene."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import pose, rotation_vectors
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.robot.mechanism import with_articulated_object
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.articulation import take_out
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Cylinder, Shape, Sphere
from cvqmpt_lab.tasks.task import Grasp, Hold, Move, Phase, PlannedPhase, Release, Slide, Task, Turn

IN_HAND = 0.02  # [m] between an object and where a grasp expects it, at most, ...
TURNED = 0.1  # [rad] ... and its turn from there; what is checked is where the object truly is


class Load(NamedTuple):
    """A carried object."""

    item: SceneObject  # as it stood in the scene
    attachment: Attachment  # the same in the hand


class HeldDoor(NamedTuple):
    """A door or drawer in the hand."""

    name: str  # of the scene's articulation
    may_touch: tuple[tuple[str, str], ...]  # (robot piece, part of the door) pairs that touch


@dataclass(frozen=True, eq=False)
class World:
    """One moment of a task."""

    source: Mapping[str, Any]  # of the arm, with the gripper as it is now
    scene: Scene  # without what is carried, doors at their values
    q: np.ndarray  # (n,) of the arm [rad or m]
    held: Load | HeldDoor | None = None

    @staticmethod
    def before(task: Task) -> "World":
        """The start of a task."""
        return World(task.robot, task.scene, task.start)

    @property
    def arm(self) -> Robot:
        """The robot without the door it holds."""
        return robot_from_source(self.source)

    def problem(self, task: Task, phase: PlannedPhase) -> PlanningProblem:
        """The problem of a planned phase, without goals."""
        robot, scene, start = self.arm, self.scene, self.q
        attachments = (self.held.attachment,) if isinstance(self.held, Load) else ()
        constraint: tuple[TaskSpaceRegion, ...]
        match phase:
            case Move():
                constraint, goal = phase.constraint, phase.goal
            case Slide():
                T_world_hand = robot.pose(self.q)
                Bw = np.zeros((6, 2))
                Bw[2] = min(0.0, phase.distance), max(0.0, phase.distance)
                constraint = (TaskSpaceRegion(T_world_hand, np.eye(4), Bw),)
                there = T_world_hand @ pose((0.0, 0.0, phase.distance))
                goal = TaskSpaceRegion(there, np.eye(4), np.zeros((6, 2)))
            case Turn():
                assert isinstance(self.held, HeldDoor)
                turned = scene.with_joint(self.held.name, phase.value)[
                    phase.goal.base
                ].T_world_object
                constraint, goal = (phase.constraint,), phase.goal.at(turned)
                start = np.append(start, scene.articulation(self.held.name).value)
                scene, robot = _mechanism(robot, scene, self.held)
        return PlanningProblem(
            name=f"{task.name}/{phase.name}",
            robot=robot,
            scene=scene,
            start=start,
            constraint=constraint,
            attachments=attachments,
            goal_region=goal,
        )

    def moved(self, q: np.ndarray) -> "World":
        """The world after a planned phase that ended at q (n,), or (n + 1,) with a door in the
        hand.
        """
        if not isinstance(self.held, HeldDoor):
            return replace(self, q=q)
        joint = self.scene.articulation(self.held.name)
        scene = self.scene.with_joint(
            self.held.name, float(np.clip(q[-1], joint.lower, joint.upper))
        )
        return replace(self, scene=scene, q=q[:-1])

    def after(self, phase: Phase) -> "World":
        """The world after a phase that is not planned;
        InvalidInputError if the hand closes beside the object.
        """
        match phase:
            case Hold():
                held = HeldDoor(phase.articulation, phase.may_touch)
                return replace(self, source={**self.source, **phase.gripper}, held=held)
            case Grasp():
                return self._grasped(phase)
            case Release():
                scene = self.scene
                if isinstance(self.held, Load):
                    T = self.arm.pose(self.q) @ self.held.attachment.T_hand_object
                    scene = scene.with_objects(replace(self.held.item, T_world_object=T))
                return replace(
                    self, source={**self.source, **phase.gripper}, scene=scene, held=None
                )
        raise InvalidInputError(f"phase {phase.name!r} is planned: its end is not known before")

    def _grasped(self, phase: Grasp) -> "World":
        item, source, expected = (
            self.scene[phase.object],
            {**self.source, **phase.gripper},
            phase.attachment,
        )
        T_hand_object = np.linalg.inv(self.arm.pose(self.q)) @ item.T_world_object
        if expected is not None:
            off, turn = _offset(item.shape, expected.T_hand_object, T_hand_object)
            if off > IN_HAND or turn > TURNED:
                raise InvalidInputError(
                    f"phase {phase.name!r}: {item.name!r} is {off:.3f} m and {turn:.2f} rad from "
                    f"where the hand "
                    f"closes by its attachment, at most {IN_HAND} m and {TURNED} rad are allowed; "
                    f"let the phase before "
                    "end at the object, or leave 'attachment' out"
                )
        elif _beyond(robot_from_source(source), item, self.q):
            raise InvalidInputError(
                f"phase {phase.name!r}: {item.name!r} is more than {IN_HAND} m from the arm; let "
                f"the phase before end "
                "at the object, or say by an 'attachment' where a hand without collision bodies "
                "holds it"
            )
        held = Load(
            item, Attachment(expected.name if expected else item.name, item.shape, T_hand_object)
        )
        return World(source, self.scene.without(phase.object), self.q, held)


def _beyond(robot: Robot, item: SceneObject, q: np.ndarray) -> bool:
    """Whether an object is further than IN_HAND from every link at q (n,)."""
    scene = Scene(item.name, (replace(item, obstacle=True),))
    checker = CollisionChecker(robot, scene, margin=IN_HAND)
    return bool(checker.clear_of_obstacles(q[None], q[None, None]).all())


def _offset(shape: Shape, T_expected: np.ndarray, T: np.ndarray) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses of a shape;
    turns about an axis of symmetry do not count.
    """
    off, R = float(np.linalg.norm(T[:3, 3] - T_expected[:3, 3])), T_expected[:3, :3].T @ T[:3, :3]
    match shape:
        case Sphere():
            return off, 0.0
        case Cylinder():
            return off, math.acos(min(1.0, abs(R[2, 2])))
    return off, float(np.linalg.norm(rotation_vectors(R)))


_taken_out = lru_cache(maxsize=8)(take_out)  # takes 0.2 s for the casing of a door


@lru_cache(maxsize=8)
def _mechanism(robot: Robot, scene: Scene, held: HeldDoor) -> tuple[Scene, Robot]:
    """A scene without the held door, and the robot with it."""
    rest, door = _taken_out(scene, held.name, held.may_touch)
    return rest, with_articulated_object(robot, door)
