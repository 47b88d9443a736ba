"""What a problem file says of its robot: a name or a URDF, and what of it is to be planned for."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from cvqmpt_lab.codec.forms import FloatArray, Schema, numbers
from cvqmpt_lab.codec.plain import from_plain, mapping
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.poses import Pose
from cvqmpt_lab.robot.named import ARMS, FINGER_OPENING
from cvqmpt_lab.robot.packages import example_robots

ARTICULATED = "articulated"
FILES = ("urdf", "srdf")
WHERE = "robot"
"""How errors call field 'robot' of a problem file."""


class PerJoint:
    """A number for all joints, or one for each."""

    def read(self, value: Any, where: str) -> FloatArray:
        """A read-only array (n,) or ()."""
        array = numbers(value, where, "a number, or one a joint")
        array.setflags(write=False)
        return array

    def write(self, value: FloatArray) -> Any:
        """The same in json."""
        return value.tolist()

    def schema(self, of: Schema) -> dict[str, Any]:
        """Either."""
        return {"oneOf": [{"type": "number"}, {"type": "array", "items": {"type": "number"}}]}


@dataclass(frozen=True, eq=False, kw_only=True)
class RobotOptions:
    """What may be said of any robot."""

    srdf: str | None = None
    """File with the link pairs to skip; None: they are found by sampling, unless an arm with a name brings one."""
    locked: Mapping[str, float] = field(default_factory=dict)
    """Joints to fix, with their values [rad or m]."""
    package_dirs: tuple[str, ...] = ()
    """Folders in which ``package://`` mesh paths are looked up first."""
    acceleration_limits: Annotated[FloatArray, PerJoint()] | None = None
    """(n,), or () for all joints alike [rad/s^2 or m/s^2]; only timing a path needs them."""
    base: Pose | None = None
    """(4, 4), pose of the URDF's base link in the world; None: at its origin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class UrdfRobot(RobotOptions):
    """A robot of a URDF file."""

    urdf: str
    """The robot's description."""
    end_effector: str
    """Frame that constraints and goals speak of."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedRobot(RobotOptions):
    """A robot that has a name; what is said beside it counts instead of what the name stands for."""

    name: str
    """A key of `ARMS`."""
    end_effector: str | None = None
    """Frame that constraints and goals speak of, instead of the usual one."""
    finger_opening: float | None = None
    """[m] of each finger of the Panda."""

    @property
    def described(self) -> UrdfRobot:
        """The URDF, options and end effector that the name stands for."""
        if self.name not in ARMS:
            raise UnknownChoiceError("robot", self.name, [*ARMS, "or 'urdf' and 'end_effector'"])
        arm, robots = ARMS[self.name], example_robots()
        fingers: Mapping[str, float] = {}
        if self.finger_opening is not None:
            if self.name != "panda":
                raise InvalidInputError(
                    f"'finger_opening' is the panda's, not that of {self.name!r}; use 'locked'"
                )
            if not 0.0 <= self.finger_opening <= FINGER_OPENING:
                raise InvalidInputError(
                    f"finger opening {self.finger_opening} m: give a value from 0 to {FINGER_OPENING} m"
                )
            fingers = dict.fromkeys(arm.locked, self.finger_opening)
        accelerations = numbers(arm.acceleration_limits, WHERE) if arm.acceleration_limits else None
        given = self.acceleration_limits
        return UrdfRobot(
            urdf=str(robots / arm.urdf),
            end_effector=self.end_effector or arm.end_effector,
            srdf=self.srdf or (arm.srdf and str(robots / arm.srdf)),
            locked={**arm.locked, **fingers, **self.locked},
            package_dirs=self.package_dirs,
            acceleration_limits=accelerations if given is None else given,
            base=self.base,
        )


def seen_from(folder: Path, source: Any) -> Any:
    """A robot's source whose relative paths are seen from a folder; what is no object is left to `read_source`."""
    if not isinstance(source, Mapping):
        return source
    files: dict[str, Any] = {
        name: str(folder / source[name]) for name in FILES if isinstance(source.get(name), str)
    }
    folders = source.get("package_dirs")
    if isinstance(folders, list) and all(isinstance(path, str) for path in folders):
        files["package_dirs"] = [str(folder / path) for path in folders]
    return {**source, **files}


def read_source(source: Mapping[str, Any]) -> UrdfRobot:
    """The files and options that a robot's source names.

    Raises
    ------
    InvalidInputError
        For a field that is unknown, missing or of the wrong type.
    UnknownChoiceError
        For a name that no arm has; the message lists them.
    """
    values = {name: value for name, value in mapping(source, WHERE).items() if name != ARTICULATED}
    if "urdf" in values:
        return from_plain(UrdfRobot, values, WHERE)
    if "name" not in values:
        raise InvalidInputError(f"{WHERE} needs 'name' ({', '.join(ARMS)}) or 'urdf' and 'end_effector'")
    return from_plain(NamedRobot, values, WHERE).described
