"""Tasks: sequences of phases in which an arm reaches, holds a door, grasps, carries and lets go.

A task is a description; `task_world.World` is what it describes at one moment, `task_pipeline.solve_task`
plans it. Tasks are saved as json, schema ``cvqmpt-task/1``:

    {"schema": "cvqmpt-task/1", "name": "...",
     "robot": {...}, "scene": {...}, "start": [n numbers]  (see PlanningProblem),
     "phases": [{"kind": "move", "name", "goal": region, "constraint": [regions]},
                {"kind": "slide", "name", "distance": 0.08},
                {"kind": "turn", "name", "value": -1.4, "constraint": chain, "goal": chain},
                {"kind": "hold", "name", "articulation", "gripper": {...}, "may_touch": [[piece, part]]},
                {"kind": "grasp", "name", "object", "gripper": {...}, "attachment": {...}},
                {"kind": "release", "name", "gripper": {...}}]}

"gripper" holds the fields of "robot" that change, e.g. {"finger_opening": 0.04}. Moves, slides and turns
are planned; the others take no time.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.constraints.task_space_region_chain import TaskSpaceRegionChain, region_from_dict
from cvqmpt_lab.errors import CvqmptError, InvalidInputError, UnknownChoiceError
from cvqmpt_lab.robot.loading import robot_from_source
from cvqmpt_lab.scene.attachment import Attachment
from cvqmpt_lab.scene.scene import Scene

SCHEMA = "cvqmpt-task/1"


@dataclass(frozen=True, eq=False)
class Move:
    """The arm moves, with what it carries, until its hand is in a region.

    Attributes
    ----------
    goal: poses of the end effector. constraint: regions it stays in on the way, none = free.
    """

    kind: ClassVar[str] = "move"
    name: str
    goal: TaskSpaceRegion
    constraint: tuple[TaskSpaceRegion, ...] = ()


@dataclass(frozen=True, eq=False)
class Slide:
    """The hand moves straight along its own z axis by a distance [m], forwards if positive."""

    kind: ClassVar[str] = "slide"
    name: str
    distance: float


@dataclass(frozen=True, eq=False)
class Turn:
    """The arm brings the door or drawer that it holds to a value [rad or m].

    Attributes
    ----------
    constraint: how the hand holds the part on the way. goal: how in the end, with the part at the value.
    """

    kind: ClassVar[str] = "turn"
    name: str
    value: float
    constraint: TaskSpaceRegionChain
    goal: TaskSpaceRegionChain


@dataclass(frozen=True, eq=False)
class Hold:
    """The fingers close on a door or drawer, which from then on is a joint of the robot.

    Attributes
    ----------
    may_touch: (robot piece, part of the door) pairs that touch from then on.
    """

    kind: ClassVar[str] = "hold"
    name: str
    articulation: str
    gripper: Mapping[str, Any]
    may_touch: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, eq=False)
class Grasp:
    """The fingers close on an object of the scene, which from then on is carried.

    Attributes
    ----------
    attachment: what is checked while it is carried: the object, or a little less of it where it stood on something.
    """

    kind: ClassVar[str] = "grasp"
    name: str
    object: str
    gripper: Mapping[str, Any]
    attachment: Attachment


@dataclass(frozen=True, eq=False)
class Release:
    """The fingers open; door or object stay where they are."""

    kind: ClassVar[str] = "release"
    name: str
    gripper: Mapping[str, Any]


Phase = Move | Slide | Turn | Hold | Grasp | Release
PlannedPhase = Move | Slide | Turn
KINDS: Mapping[str, type] = {kind.kind: kind for kind in (Move, Slide, Turn, Hold, Grasp, Release)}


@dataclass(frozen=True, eq=False)
class Task:
    """A named sequence of phases of a robot in a scene.

    Attributes
    ----------
    robot: what a problem file says of it. start: (n,) [rad or m].

    Raises
    ------
    InvalidInputError: a phase that cannot follow the one before; names the phase.
    UnknownChoiceError: an object or articulation that the scene does not have.
    """

    name: str
    robot: Mapping[str, Any]
    scene: Scene
    start: np.ndarray
    phases: tuple[Phase, ...]

    def __post_init__(self) -> None:
        start = np.array(self.start, dtype=float)
        start.setflags(write=False)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "phases", tuple(self.phases))
        if not any(isinstance(phase, PlannedPhase) for phase in self.phases):
            raise InvalidInputError(f"task {self.name!r} plans nothing: give it a move, slide or turn")
        names = [phase.name for phase in self.phases]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidInputError(
                f"task {self.name!r} has two phases called {twice!r}: names must be unique"
            )
        _check_order(self)

    def to_dict(self) -> dict:
        """Plain json form."""
        return {
            "schema": SCHEMA,
            "name": self.name,
            "robot": dict(self.robot),
            "scene": self.scene.to_dict(),
            "start": self.start.tolist(),
            "phases": [_phase_to_dict(phase) for phase in self.phases],
        }

    @staticmethod
    def from_dict(data: dict) -> "Task":
        """Inverse of to_dict; errors name the phase and the missing or malformed field."""
        if not isinstance(data, dict) or data.get("schema") != SCHEMA:
            found = data.get("schema") if isinstance(data, dict) else type(data).__name__
            raise InvalidInputError(f"task field 'schema' is {found!r}; this version reads {SCHEMA!r}")
        for field in ("name", "robot", "scene", "start", "phases"):
            if field not in data:
                raise InvalidInputError(f"task field {field!r} is missing")
        robot = robot_from_source(data["robot"])
        try:
            start = np.array(data["start"], dtype=float)
        except (TypeError, ValueError) as error:
            raise InvalidInputError(f"task field 'start' must hold numbers: {error}") from error
        if start.shape != (robot.dof,) or not np.isfinite(start).all():
            raise InvalidInputError(f"task field 'start' must be {robot.dof} finite numbers")
        if not isinstance(data["phases"], list):
            raise InvalidInputError("task field 'phases' must be a list")
        return Task(
            name=str(data["name"]),
            robot=robot.source,
            scene=Scene.from_dict(data["scene"]),
            start=start,
            phases=tuple(_phase_from_dict(item, k) for k, item in enumerate(data["phases"])),
        )

    def save(self, path: Path | str) -> None:
        """Write the json form; a half-written file never takes the name."""
        path = Path(path)
        temporary = path.with_name(path.name + ".tmp")
        try:
            temporary.write_text(json.dumps(self.to_dict(), indent=1) + "\n", encoding="utf-8")
            temporary.replace(path)
        except OSError as error:
            raise InvalidInputError(f"cannot write {path}: {error.strerror}; choose another place") from error

    @staticmethod
    def load(path: Path | str) -> "Task":
        """Read a task file; errors name the file, the phase and the field."""
        try:
            return Task.from_dict(json.loads(Path(path).read_text(encoding="utf-8")))
        except OSError as error:
            raise InvalidInputError(f"cannot read task file {path}: {error.strerror}") from error
        except RecursionError as error:
            raise InvalidInputError(f"{path} is no task file: its json is nested too deeply") from error
        except ValueError as error:
            raise InvalidInputError(f"{path} is not json: {error}") from error
        except CvqmptError as error:
            raise InvalidInputError(f"{path}: {error}") from error


def _check_order(task: Task) -> None:
    """Walk through the phases with what the gripper would hold; refuse the first that does not fit."""
    scene: Scene = task.scene
    held: _Door | _Load | None = None
    for number, phase in enumerate(task.phases):
        where = f"task {task.name!r}, phase {number} {phase.name!r}"
        match phase:
            case Hold() | Grasp() if held is not None:
                raise InvalidInputError(
                    f"{where}: the gripper already holds {held.name!r}; release it before"
                )
            case Release() if held is None:
                raise InvalidInputError(
                    f"{where}: the gripper holds nothing to release; hold or grasp something before"
                )
            case Move() | Slide() if isinstance(held, _Door):
                raise InvalidInputError(
                    f"{where}: the hand holds {held.name!r}; a turn moves it, or release it before"
                )
            case Turn() if not isinstance(held, _Door):
                raise InvalidInputError(f"{where}: the hand holds no door or drawer; hold one before")
            case Turn():
                assert held is not None
                try:
                    scene = scene.with_joint(held.name, phase.value)
                except InvalidInputError as error:
                    raise InvalidInputError(f"{where}: {error}") from error
                if phase.constraint.base not in scene.articulation(held.name).moves:
                    moved = ", ".join(scene.articulation(held.name).moves)
                    raise InvalidInputError(
                        f"{where}: 'base' {phase.constraint.base!r} is no part of {held.name!r}; it moves {moved}"
                    )
            case Hold():
                held = _Door(_known(scene.articulation, phase.articulation, where))
            case Grasp():
                _known(scene.__getitem__, phase.object, where)
                scene, held = scene.without(phase.object), _Load(phase.object)
            case Release():
                if isinstance(held, _Load):
                    scene = scene.with_objects(task.scene[held.name])
                held = None
            case _:
                pass


@dataclass(frozen=True)
class _Door:
    name: str


@dataclass(frozen=True)
class _Load:
    name: str


def _known(look_up: Any, name: str, where: str) -> str:
    """The name, after the scene has found it; otherwise the phase is named with the choices."""
    try:
        look_up(name)
    except UnknownChoiceError as error:
        raise InvalidInputError(f"{where}: {error}") from error
    return name


def _phase_to_dict(phase: Phase) -> dict:
    return {
        "kind": phase.kind,
        **{field.name: _plain(getattr(phase, field.name)) for field in fields(phase)},
    }


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.to_dict() if hasattr(value, "to_dict") else value


def _phase_from_dict(data: Any, number: int) -> Phase:
    where = f"task phase {number}"
    if not isinstance(data, dict):
        raise InvalidInputError(f"{where} must be a json object, not {type(data).__name__}")
    if data.get("kind") not in KINDS:
        raise UnknownChoiceError(f"kind of {where}", data.get("kind"), KINDS)
    kind = KINDS[data["kind"]]
    where = f"{where} {data.get('name', '')!r}"
    required = [field.name for field in fields(kind) if field.name not in ("constraint", "may_touch")]
    required += ["constraint"] if kind is Turn else []
    missing = next((name for name in required if name not in data), None)
    if missing is not None:
        raise InvalidInputError(f"{where}: field {missing!r} is missing")
    unknown = set(data) - {"kind"} - {field.name for field in fields(kind)}
    if unknown:
        raise InvalidInputError(f"{where}: unknown field {min(unknown)!r}")
    try:
        return kind(**{name: _READERS[name](value, kind) for name, value in data.items() if name in _READERS})
    except (TypeError, ValueError, AttributeError) as error:
        raise InvalidInputError(f"{where} is malformed: {error}") from error
    except CvqmptError as error:
        raise InvalidInputError(f"{where}: {error}") from error


def _text(value: Any, kind: type) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"{value!r} is no name")
    return value


def _number(value: Any, kind: type) -> float:
    if not np.isfinite(float(value)):
        raise ValueError(f"{value!r} is not finite")
    return float(value)


def _goal(value: Any, kind: type) -> TaskSpaceRegion:
    return TaskSpaceRegionChain.from_dict(value) if kind is Turn else region_from_dict(value)


def _constraint(value: Any, kind: type) -> Any:
    return (
        TaskSpaceRegionChain.from_dict(value)
        if kind is Turn
        else tuple(region_from_dict(item) for item in value)
    )


_READERS: Mapping[str, Any] = {
    "name": _text,
    "object": _text,
    "articulation": _text,
    "value": _number,
    "distance": _number,
    "goal": _goal,
    "constraint": _constraint,
    "gripper": lambda value, kind: dict(value),
    "attachment": lambda value, kind: Attachment.from_dict(value),
    "may_touch": lambda value, kind: tuple((str(a), str(b)) for a, b in value),
}
