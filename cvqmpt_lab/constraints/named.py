"""Regions as problem files write them: in full, or one of a few common ones by name."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from cvqmpt_lab.codec import COMMENT, field_kinds, from_plain, to_plain
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    upright,
)
from cvqmpt_lab.errors import (
    InvalidInputError,
    UnknownChoiceError,
    at,
    located,
    mapping,
    nearest,
    shown,
)
from cvqmpt_lab.poses import Placement, Pose, pose
from cvqmpt_lab.values import Angle, Condition

Vector = tuple[float, float, float]
Tolerance = Annotated[float, Condition(float, lambda x: x >= 0.0, "0 or more")]


@dataclass(frozen=True)
class Upright:
    """An axis of the end effector points up; yaw about it and position are free."""

    tilt: Angle = 0.1  # [rad]
    axis: Literal["x", "-x", "y", "-y", "z", "-z"] = "x"  # Axis of the end-effector frame

    def region(self) -> TaskSpaceRegion:
        """The region in full."""
        return upright(self.tilt, self.axis)


def upper_axis(T_world_hand: np.ndarray) -> str:
    """The axis of the end effector, at a pose (4, 4), that points up most."""
    up = T_world_hand[2, :3]
    k = int(np.argmax(np.abs(up)))
    return ("-" if up[k] < 0.0 else "") + "xyz"[k]


@dataclass(frozen=True)
class FixedOrientation:
    """The end effector has a fixed orientation; its position is free."""

    tolerance: Angle  # Of each entry of the rotation vector from that orientation [rad]
    rpy: Vector | None = None  # Roll, pitch, yaw about the world's x, y, z [rad]
    quaternion: tuple[float, float, float, float] | None = None  # The same as x, y, z, w

    def region(self) -> TaskSpaceRegion:
        """The region in full."""
        there = Placement(rpy=self.rpy, quaternion=self.quaternion).matrix
        return _region(there, np.eye(4), [FREE] * 3 + [self.tolerance] * 3)


@dataclass(frozen=True)
class Plane:
    """The end effector's origin stays in a plane; it turns freely."""

    normal: Vector  # Of any length
    point: Vector  # A point of the plane [m]
    tolerance: Tolerance = 0.0  # To both sides [m]

    def region(self) -> TaskSpaceRegion:
        """The region in full."""
        return _region(
            _along(self.point, self.normal), np.eye(4), [FREE, FREE, self.tolerance] + [FREE] * 3
        )


@dataclass(frozen=True)
class Line:
    """The end effector's origin stays on a line; it turns freely."""

    direction: Vector  # Of any length
    point: Vector  # A point of the line [m]
    tolerance: Tolerance = 0.0  # Across the line, in each of two directions [m]

    def region(self) -> TaskSpaceRegion:
        """The region in full."""
        there = _along(self.point, self.direction)
        return _region(there, np.eye(4), [self.tolerance, self.tolerance, FREE] + [FREE] * 3)


@dataclass(frozen=True)
class Near:
    """The end effector stands at a pose, or close to it."""

    at: Pose  # Its pose in the world
    position: Tolerance = 0.0  # Of x, y and z [m]
    tilt: Angle = 0.0  # About the world's x and y [rad]
    yaw: Angle = 0.0  # About the world's vertical [rad]; 3.15 leaves it free

    def region(self) -> TaskSpaceRegion:
        """The region in full."""
        turned = self.at.copy()
        turned[:3, 3] = 0.0
        bounds = [self.position] * 3 + [self.tilt] * 2 + [self.yaw]
        return _region(pose(self.at[:3, 3]), turned, bounds)


BY_POSITION = {"plane": Plane, "line": Line, "pose": Near}
# what may stand for a region: `{"upright": {...}}` or `{"upright": 0.1}`, its first field
NAMED: Mapping[str, Any] = {
    "upright": Upright,
    "fixed-orientation": FixedOrientation,
    **BY_POSITION,
}


def region(name: str, **fields: Any) -> TaskSpaceRegion:
    """A region by its name and a problem file's fields: ``region("plane", normal=..., point=...)``.

    Names and fields: see `NAMED`; UnknownChoiceError or InvalidInputError for others.
    """
    if name not in NAMED:
        raise UnknownChoiceError("region", name, NAMED)
    return from_plain(Region, {name: fields})


def _region(T0_w: np.ndarray, Tw_e: np.ndarray, bounds: list[float]) -> TaskSpaceRegion:
    """A region with symmetric bounds (6,)."""
    return TaskSpaceRegion(T0_w, Tw_e, np.array([[-bound, bound] for bound in bounds]))


def _along(point: Vector, direction: Vector) -> np.ndarray:
    """A frame (4, 4) at a point whose z axis points along a direction."""
    if not any(direction):
        raise InvalidInputError("the direction is 0, 0, 0")
    # scaled, so that the squared length is neither 0 nor infinite
    z = np.ldexp(direction, -np.frexp(np.abs(direction).max())[1])
    z /= np.linalg.norm(z)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    T = pose(point)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return T


class RegionForm:
    """A region, one that hangs on a frame of the robot when it has a "base", or one of `NAMED`."""

    def read(self, value: Any, where: str) -> TaskSpaceRegion:
        """Make the region, in full."""
        if isinstance(value, TaskSpaceRegion):
            return value
        full = field_kinds(TaskSpaceRegionChain)
        keys = [key for key in mapping(value, where, ", ".join(full)) if key != COMMENT]
        unknown = next((key for key in keys if key not in (*full, *NAMED)), None)
        if unknown is not None:
            raise InvalidInputError(
                f"{at(where, shown(unknown)[1:-1])} is unknown{nearest(unknown, [*full, *NAMED])}; "
                f"fields: {', '.join(full)}, or one of {', '.join(NAMED)} alone"
            )
        if not any(key in NAMED for key in keys):
            kind: Any = TaskSpaceRegionChain if "base" in value else TaskSpaceRegion
            return from_plain(kind, value, where)
        if len(keys) > 1:
            raise InvalidInputError(f"{where} has {', '.join(keys)}; a region by name stands alone")
        kind, content, where = NAMED[keys[0]], value[keys[0]], at(where, keys[0])
        if not isinstance(content, Mapping):
            content = {next(iter(field_kinds(kind))): content}
        named = from_plain(kind, content, where)
        with located(where):
            return named.region()

    def write(self, value: TaskSpaceRegion) -> Any:
        """The region in full."""
        return to_plain(value)


Region = Annotated[TaskSpaceRegion, RegionForm()]
