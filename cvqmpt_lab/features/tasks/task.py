"""Tasks: sequences of phases in which an arm reaches, holds a door, grasps, carries and releases.

`solve_task` plans a task; `world.World` is its state at one time. Tasks are saved as json, schema
``cvqmpt-task/1``: "name", "robot", "scene" and "start" as in a problem file, and::

    "phases": [
      {"kind": "move", "name", "goal": region, "constraint": [regions], "through": [regions],
       "configuration": [joint values]},
      {"kind": "slide", "name", "distance": 0.08, "axis": "z"},
      {"kind": "turn", "name", "value": -1.4, "constraint": chain, "goal": chain},
      {"kind": "hold", "name", "articulation", "gripper": {...}, "may_touch": [[piece, part]]},
      {"kind": "grasp", "name", "object", "gripper": {...}},
      {"kind": "release", "name", "gripper": {...}}]

A grasped object is carried with its shape, mass and pose in the scene. Contact counts as a
collision: leave a gap of 1 mm or more between an object and its support.
"""

from __future__ import annotations  # so that `help` shows types by their names

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self, TypeAlias

import numpy as np

from cvqmpt_lab.base.codec import Checked, Document, OneOrMore, Tagged
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    UnknownChoiceError,
    located,
    mapping,
    shown,
    unique,
)
from cvqmpt_lab.base.values import Name
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.task_space_region import Axis, TaskSpaceRegionChain, axis_vector
from cvqmpt_lab.robot.load import SourceForm, State, numbers_of, robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import (
    Articulation,
    Attachment,
    NamedScene,
    Scene,
    SceneObject,
    check_extent,
)
from cvqmpt_lab.scene.scene_files import with_files_read


@dataclass(frozen=True, eq=False)
class Move(Checked):
    """The arm moves, with its load if it has one, until its hand is in a region."""

    name: Name  # Unique in its task
    goal: Region  # Poses of the end effector
    # Regions in which it stays during the motion
    constraint: Annotated[tuple[Region, ...], OneOrMore(Region)] = ()
    # Regions in which it stops before the goal, in order
    through: Annotated[tuple[Region, ...], OneOrMore(Region)] = ()
    configuration: State | None = None  # (n,), the only goal if it is given [rad or m]

    @property
    def legs(self) -> tuple[Move, ...]:
        """One move to each region of `through`, called "NAME/1", "NAME/2", ..., and to the goal."""
        stops = (
            self.changed(name=f"{self.name}/{k}", goal=region, through=(), configuration=None)
            for k, region in enumerate(self.through, start=1)
        )
        return (*stops, self.changed(through=()))


@dataclass(frozen=True, eq=False)
class Slide(Checked):
    """The hand moves straight along an axis of the end-effector frame."""

    name: Name  # Unique in its task
    distance: float  # Along the axis; backwards if negative [m]
    axis: Axis = "z"  # Axis of the end-effector frame

    @property
    def translation(self) -> np.ndarray:
        """Translation (3,) of the hand in the end-effector frame [m]."""
        return self.distance * axis_vector(self.axis)


@dataclass(frozen=True, eq=False)
class Turn(Checked):
    """The arm moves the door or drawer that it holds to a joint value."""

    name: Name  # Unique in its task
    value: float  # Final value of the door or drawer [rad or m]
    constraint: TaskSpaceRegionChain  # How the hand holds the part during the motion
    goal: TaskSpaceRegionChain  # How the hand holds the part at the end


@dataclass(frozen=True, eq=False)
class Hold(Checked):
    """The fingers close on a door or drawer; from then on it is a joint of the robot."""

    name: Name  # Unique in its task
    articulation: Name  # Name of a door or drawer of the scene
    # Fields of the task's robot that change, e.g. {"finger_opening": 0.0075}
    gripper: Mapping[str, Any]
    # Pairs (robot piece, door part) that may touch from then on
    may_touch: tuple[tuple[Name, Name], ...] = ()


@dataclass(frozen=True, eq=False)
class Grasp(Checked):
    """The fingers close on an object of the scene; from then on it is carried."""

    name: Name  # Unique in its task
    object: Name  # Name of an object of the scene
    gripper: Mapping[str, Any]  # As in `Hold`
    # Expected object and pose in the hand, only compared with the object that is carried; its mass
    # counts where the object in the scene has none
    attachment: Attachment | None = None

    def check_shape(self, item: SceneObject) -> None:
        """Refuse an object that cannot be carried, and one whose attachment has another shape."""
        carried = Attachment(item.name, item.shape, np.eye(4)).shape
        if self.attachment is None or self.attachment.shape == carried:
            return
        shapes = (self.attachment.shape, carried)
        written, real = ({"type": type(shape).__name__, **vars(shape)} for shape in shapes)
        what = next(key for key in real if not np.array_equal(written[key], real[key]))
        raise InvalidInputError(
            f"{what} of the attachment is {shown(written[what])}, that of {item.name!r} in the "
            f"scene {shown(real[what])}; leave 'attachment' out, the object is carried as it is"
        )


@dataclass(frozen=True, eq=False)
class Release(Checked):
    """The fingers open; the door or object stays where it is."""

    name: Name  # Unique in its task
    gripper: Mapping[str, Any]  # As in `Hold`


PHASES = {
    "move": Move,
    "slide": Slide,
    "turn": Turn,
    "hold": Hold,
    "grasp": Grasp,
    "release": Release,
}
PlannedPhase: TypeAlias = Move | Slide | Turn
HandPhase: TypeAlias = Hold | Grasp | Release
Phase: TypeAlias = Annotated[PlannedPhase | HandPhase, Tagged("kind", PHASES)]


@dataclass(frozen=True, eq=False)
class Task(Document):
    """A named sequence of phases of a robot in a scene."""

    SCHEMA: ClassVar[str] = "cvqmpt-task/1"
    with_named_files = staticmethod(with_files_read)

    name: Name  # Name in result rows
    robot: Annotated[Mapping[str, Any], SourceForm()]  # As in a problem file
    scene: NamedScene  # At the beginning
    start: State  # (n,) [rad or m]
    phases: tuple[Phase, ...]  # In order of execution

    def __repr__(self) -> str:
        return (
            f"Task {self.name!r}: {self.robot.get('name') or self.robot.get('urdf')} in "
            f"{self.scene.name}\n"
            f"phases      {', '.join(phase.name for phase in self.phases)}"
        )

    def _check(self) -> None:
        robot = robot_from_source(self.robot)
        object.__setattr__(self, "robot", robot.source)
        if self.start.shape != (robot.dof,):
            raise InvalidInputError(
                f"task {self.name!r}: start has shape {self.start.shape}, robot {robot.name} "
                f"needs ({robot.dof},)"
            )
        if not self.planned:
            raise InvalidInputError(
                f"task {self.name!r} plans nothing: give it a move, slide or turn"
            )
        unique((phase.name for phase in self.phases), f"phases of task {self.name!r}")
        scene, held = self.scene, None
        for number, phase in enumerate(self.phases):
            with located(f"task {self.name!r}, phase {number} {phase.name!r}"):
                if isinstance(phase, Move):
                    _check_frames(robot, phase)
                    if phase.configuration is not None:
                        _check_configuration(robot, phase.configuration)
                scene, held = _after(phase, scene, held)

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Inverse of `to_dict`; a start may be {"joint": value} or name a group_state of the SRDF.

        Refuses lengths that cannot be metres; warns when nothing of the scene is within reach.
        """
        if isinstance(data, Mapping) and isinstance(data.get("start"), str | Mapping):
            robot = robot_from_source(mapping(data.get("robot"), "robot"))
            data = {**data, "start": numbers_of(robot, data["start"], "start")}
        task = super().from_dict(data)
        check_extent(task.scene, robot_from_source(task.robot).reach)
        return task

    @property
    def in_legs(self) -> Task:
        """The task with one move to each region at which a move stops, see `Move.legs`."""
        legs = (phase.legs if isinstance(phase, Move) else (phase,) for phase in self.phases)
        return self.changed(phases=tuple(leg for several in legs for leg in several))

    @property
    def planned(self) -> list[tuple[tuple[HandPhase, ...], PlannedPhase]]:
        """The planned phases in order, each with the hand phases that directly precede it."""
        found, before = [], list[HandPhase]()
        for phase in self.phases:
            if isinstance(phase, PlannedPhase):
                found.append((tuple(before), phase))
                before = []
            else:
                before.append(phase)
        return found


def _check_configuration(robot: Robot, q: np.ndarray) -> None:
    """Refuse a configuration of a move that has another shape, or is outside the joint limits."""
    if q.shape != (robot.dof,):
        raise InvalidInputError(
            f"configuration has shape {q.shape}, robot {robot.name} needs ({robot.dof},)"
        )
    if outside := robot.joint_outside_limits(q):
        raise InvalidInputError(
            f"configuration: {outside[0]} leaves its limits by {outside[1]:.2g}"
        )


def _check_frames(robot: Robot, move: Move) -> None:
    """Refuse a region of a frame that the robot lacks, or that cannot reach a goal."""
    for region in move.constraint:
        region.links(robot)
    for region in (move.goal, *move.through):
        robot.hand(region.end_effector)
        region.links(robot)


def _after(
    phase: Phase, scene: Scene, held: Articulation | SceneObject | None
) -> tuple[Scene, Articulation | SceneObject | None]:
    """Return the scene without the carried object, and the held door or object, after a phase.

    Refuses unknown names and a phase that does not fit what the hand holds before it.

    held: door, drawer or object in the hand before the phase; None: the hand is empty.
    """
    match phase:
        case Hold() | Grasp() if held is not None:
            raise InvalidInputError(f"the gripper already holds {held.name!r}; release it before")
        case Release() if held is None:
            raise InvalidInputError(
                "the gripper holds nothing to release; hold or grasp something before"
            )
        case Move() | Slide() if isinstance(held, Articulation):
            raise InvalidInputError(
                f"the hand holds {held.name!r}; a turn moves it, or release it before"
            )
        case Turn() if not isinstance(held, Articulation):
            raise InvalidInputError("the hand holds no door or drawer; hold one before")
        case Turn(constraint=chain) if (
            isinstance(held, Articulation) and chain.base not in held.moves
        ):
            raise UnknownChoiceError(f"'base' of what {held.name!r} moves:", chain.base, held.moves)
        case Turn() if held is not None:
            return scene.with_joint(held.name, phase.value), held
        case Hold():
            return scene, scene.articulation(phase.articulation)
        case Grasp():
            phase.check_shape(scene[phase.object])
            return scene.without(phase.object), scene[phase.object]
        case Release():
            return (scene.with_objects(held) if isinstance(held, SceneObject) else scene), None
    return scene, held
