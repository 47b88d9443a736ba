"""What an arm does in a task, phase by phase: move, slide, turn a door, hold it, grasp an object, let go.

Moves, slides and turns are planned; the others take no time.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

from cvqmpt_lab.codec.forms import Name, OneOrMore, Tagged
from cvqmpt_lab.codec.plain import Checked
from cvqmpt_lab.constraints.named import Region
from cvqmpt_lab.constraints.task_space_region_chain import TaskSpaceRegionChain
from cvqmpt_lab.scene.scene import Attachment


@dataclass(frozen=True, eq=False)
class Move(Checked):
    """The arm moves, with what it carries, until its hand is in a region."""

    name: Name
    """Unique in its task."""
    goal: Region
    """Poses of the end effector."""
    constraint: Annotated[tuple[Region, ...], OneOrMore(Region)] = ()
    """Regions it stays in on the way, none = free."""


@dataclass(frozen=True, eq=False)
class Slide(Checked):
    """The hand moves straight along its own z axis."""

    name: Name
    """Unique in its task."""
    distance: float
    """Forwards if positive [m]."""


@dataclass(frozen=True, eq=False)
class Turn(Checked):
    """The arm brings the door or drawer that it holds to a value."""

    name: Name
    """Unique in its task."""
    value: float
    """Of the door or drawer in the end [rad or m]."""
    constraint: TaskSpaceRegionChain
    """How the hand holds the part on the way."""
    goal: TaskSpaceRegionChain
    """How it holds the part in the end."""


@dataclass(frozen=True, eq=False)
class Hold(Checked):
    """The fingers close on a door or drawer, which from then on is a joint of the robot."""

    name: Name
    """Unique in its task."""
    articulation: Name
    """Which of the scene's."""
    gripper: Mapping[str, Any]
    """Fields of the task's robot that change, e.g. {"finger_opening": 0.0075}."""
    may_touch: tuple[tuple[Name, Name], ...] = ()
    """(Robot piece, part of the door) pairs that touch from then on."""


@dataclass(frozen=True, eq=False)
class Grasp(Checked):
    """The fingers close on an object of the scene, which from then on is carried."""

    name: Name
    """Unique in its task."""
    object: Name
    """Which of the scene's."""
    gripper: Mapping[str, Any]
    """As in `Hold`."""
    attachment: Attachment
    """What is checked while it is carried: the object, or a little less of it where it stood on something."""


@dataclass(frozen=True, eq=False)
class Release(Checked):
    """The fingers open; door or object stay where they are."""

    name: Name
    """Unique in its task."""
    gripper: Mapping[str, Any]
    """As in `Hold`."""


PHASES = {"move": Move, "slide": Slide, "turn": Turn, "hold": Hold, "grasp": Grasp, "release": Release}
"""Phases by the "kind" that json calls them."""

PlannedPhase: TypeAlias = Move | Slide | Turn
Phase: TypeAlias = Annotated[PlannedPhase | Hold | Grasp | Release, Tagged("kind", PHASES)]
