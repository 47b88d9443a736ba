"""Regions as problem files state them: in full, or by one of a few names with parameters.

A new name is a function that returns a region, here or in a file of its own, and its entry in
`NAMED_REGIONS`.
"""

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from cvqmpt_lab.base.codec import field_defaults, field_kinds, from_plain
from cvqmpt_lab.base.errors import (
    InvalidInputError,
    at,
    mapping,
    nearest,
    require_choice,
    shown,
)
from cvqmpt_lab.base.poses import Placement, Pose, pose, rigid
from cvqmpt_lab.base.values import Angle, Array, FloatArray, Length, Name, frozen
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    Axis,
    Span,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    Tolerance,
    axis_vector,
    nearest_axis,
    symmetric_region,
    upright,
    upright_box,
)

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
HAND_FIELD = "end_effector"  # of a region, names its hand


def upper_axis(T_world_hand: np.ndarray) -> Axis:
    """Return the axis of the end effector at a pose (4, 4) that points up most."""
    return nearest_axis(T_world_hand[2, :3])


def fixed_orientation(
    tolerance: Angle, rpy: Vector | None = None, quaternion: Quaternion | None = None
) -> TaskSpaceRegion:
    """Return the region of a fixed orientation of the end effector; its position is free.

    Args:
        tolerance: bound on each entry of the rotation vector from that orientation [rad].
        rpy: roll, pitch, yaw about the world's x, y, z [rad].
        quaternion: the same as x, y, z, w.
    """
    there = Placement(rpy=rpy, quaternion=quaternion).matrix
    return symmetric_region(there, np.eye(4), [FREE] * 3 + [tolerance] * 3)


def plane(normal: Vector, point: Vector, tolerance: Tolerance = 0.0) -> TaskSpaceRegion:
    """Return the region where the end effector's origin stays in a plane; it turns freely.

    Args:
        normal: normal of the plane, of any length.
        point: a point of the plane [m].
        tolerance: to both sides [m].
    """
    bounds = [FREE, FREE, tolerance] + [FREE] * 3
    return symmetric_region(_along(point, normal), np.eye(4), bounds)


def line(direction: Vector, point: Vector, tolerance: Tolerance = 0.0) -> TaskSpaceRegion:
    """Return the region where the end effector's origin stays on a line; it turns freely.

    Args:
        direction: direction of the line, of any length.
        point: a point of the line [m].
        tolerance: across the line, in each of two directions [m].
    """
    bounds = [tolerance, tolerance, FREE] + [FREE] * 3
    return symmetric_region(_along(point, direction), np.eye(4), bounds)


def near_pose(
    at: Pose, position: Tolerance = 0.0, tilt: Angle = 0.0, yaw: Angle = 0.0
) -> TaskSpaceRegion:
    """Return the region of poses of the end effector at a pose, or close to it.

    Args:
        at: its pose in the world (4, 4).
        position: tolerance of x, y and z [m].
        tilt: largest angle by which a line of the hand that is vertical there may lean [rad].
        yaw: tolerance about the world's vertical [rad]; 3.15 leaves it free.
    """
    turned = at.copy()
    turned[:3, 3] = 0.0
    bounds = [position] * 3 + [FREE] * 2 + [yaw]
    return symmetric_region(pose(at[:3, 3]), turned, bounds, tilt)


def relative_pose(
    base: Name,
    at: Pose,
    position: Tolerance = 0.0,
    rotation: Angle = 0.0,
    about: Axis | None = None,
) -> TaskSpaceRegionChain:
    """Return the region of poses of the end effector in the frame of another one.

    Both then hold one body, as a closed chain.

    Args:
        base: the other end effector, or another frame of the robot.
        at: the pose in its frame (4, 4).
        position: tolerance of x, y and z [m].
        rotation: largest entry of the rotation vector, or angle of the axis `about` [rad].
        about: axis of the end effector about which it turns freely.
    """
    turned, bounds, tilt = np.eye(4), [position] * 3 + [rotation] * 3, None
    if about is not None:
        # w and e turned, so that z is the axis
        turned, bounds, tilt = _along((0.0, 0.0, 0.0), axis_vector(about)), bounds[:3], rotation
        bounds += [FREE] * 3
    Bw = frozen(np.array([[-bound, bound] for bound in bounds]))
    return TaskSpaceRegionChain(at @ turned, turned.T, Bw, tilt=tilt, base=base)


def look_at(
    point: Vector, angle: Angle = 0.1, axis: Axis = "z", distance: Span | None = None
) -> TaskSpaceRegion:
    """Return the region where an axis of the end effector, or of a camera, passes a point.

    Args:
        point: the point in the world [m].
        angle: largest angle between the axis and the line to the point [rad].
        axis: axis along which the end effector looks.
        distance: smallest and largest distance of the point from its origin [m]; None: any.
    """
    ahead = _along((0.0, 0.0, 0.0), axis_vector(axis))  # turned, so that z is the axis
    free = symmetric_region(pose(point), ahead.T, [FREE] * 6)
    return TaskSpaceRegion(free.T0_w, free.Tw_e, free.Bw, bearing=angle, distance=distance)


def distance(
    bounds: Span, point: Vector = (0.0, 0.0, 0.0), base: Name | None = None
) -> TaskSpaceRegion:
    """Return the region where the end effector's origin has a distance from a point.

    Args:
        bounds: smallest and largest distance [m]; None as the largest: any.
        point: the point, in the world or in the frame `base` [m].
        base: frame of the robot that the point moves with; None: the world.
    """
    free = symmetric_region(pose(point), np.eye(4), [FREE] * 6)
    if base is None:
        return TaskSpaceRegion(free.T0_w, free.Tw_e, free.Bw, distance=bounds)
    return TaskSpaceRegionChain(free.T0_w, free.Tw_e, free.Bw, base=base, distance=bounds)


def on_sphere(centre: Vector, radius: Length, tolerance: Tolerance = 0.0) -> TaskSpaceRegion:
    """Return the region where the end effector's origin stays on a sphere; it turns freely.

    Args:
        centre: centre of the sphere [m].
        radius: radius of the sphere [m].
        tolerance: to both sides [m].
    """
    return distance((max(radius - tolerance, 0.0), radius + tolerance), centre)


def on_cylinder(
    direction: Vector, point: Vector, radius: Length, tolerance: Tolerance = 0.0
) -> TaskSpaceRegion:
    """Return the region where the end effector's origin stays on a cylinder; it turns freely.

    Args:
        direction: direction of the cylinder's axis, of any length.
        point: a point of the axis [m].
        radius: radius of the cylinder [m].
        tolerance: to both sides [m].
    """
    free = symmetric_region(_along(point, direction), np.eye(4), [FREE] * 6)
    bounds = (max(radius - tolerance, 0.0), radius + tolerance)
    return TaskSpaceRegion(free.T0_w, free.Tw_e, free.Bw, radius=bounds)


def joint_coupling(
    factors: Mapping[str, float], lower: float | None = 0.0, upper: float | None = 0.0
) -> Any:
    """Return the constraint of a weighted sum of joints.

    Args:
        factors: factor of each joint of the sum, by the joint's name.
        lower: smallest value of the sum [rad or m]; None: no bound.
        upper: largest value of the sum [rad or m]; None: no bound.
    """
    from cvqmpt_lab.constraints.joint_coupling import JointCoupling  # few problems have one

    return JointCoupling(factors, lower, upper)


def centre_of_mass(
    corners: Annotated[FloatArray, Array((None, 2), "corners [x, y] of a polygon [m]")],
    margin: Tolerance = 0.0,
) -> Any:
    """Return the constraint that the robot's centre of mass, with its load, is above a polygon.

    Args:
        corners: corners (k, 2) of a convex polygon in order, x and y in the world [m].
        margin: distance that it keeps from the edges [m].
    """
    from cvqmpt_lab.constraints.centre_of_mass import CentreOfMass  # few problems have one

    return CentreOfMass(corners, margin)


# function by name: `{"upright": {...}}`, or `{"upright": 0.1}` with its first parameter alone
NAMED_REGIONS: Mapping[str, Any] = {
    "upright": upright,
    "upright-box": upright_box,
    "fixed-orientation": fixed_orientation,
    "plane": plane,
    "line": line,
    "pose": near_pose,
    "relative-pose": relative_pose,
    "look-at": look_at,
    "distance": distance,
    "on-sphere": on_sphere,
    "on-cylinder": on_cylinder,
    "joint-coupling": joint_coupling,
    "centre-of-mass": centre_of_mass,
}


def region(name: str, **fields: Any) -> Any:
    """Return a region by name and fields of a problem file: ``region("plane", normal=..., ...)``.

    Names and fields: see `NAMED_REGIONS`; UnknownChoiceError or InvalidInputError for others.
    """
    require_choice("region", name, NAMED_REGIONS)
    return RegionForm(with_functions=True).read({name: fields}, "")


def _along(point: Vector, direction: Vector | np.ndarray) -> np.ndarray:
    """Return a frame (4, 4) at a point whose z axis points along a direction."""
    if not any(direction):
        raise InvalidInputError("the direction is 0, 0, 0")
    # scaled, so that the squared length is neither 0 nor infinite
    z = np.ldexp(direction, -np.frexp(np.abs(direction).max())[1])
    z /= np.linalg.norm(z)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return rigid(np.stack([x, np.cross(z, x), z], axis=1), point)


@dataclass(frozen=True)
class RegionForm:
    """Json form of a region: in full (a chain if it has a "base"), or by name."""

    with_functions: bool = False  # whether names of constraints that are no regions are read, too

    def read(self, value: Any, where: str) -> Any:
        """Return the region of a json value."""
        if isinstance(value, TaskSpaceRegion):
            return value
        if isinstance(value, str):
            require_choice(where, value, NAMED_REGIONS)
            examples = {
                "plane": {"normal": [0, 0, 1], "point": [0.4, 0.0, 0.5], "tolerance": 0.01},
                "line": {"direction": [0, 1, 0], "point": [0.4, 0.0, 0.5], "tolerance": 0.01},
                "pose": {"at": {"xyz": [0.4, 0.0, 0.5], "rpy": [3.14, 0.0, 0.0]}},
                "relative-pose": {"base": "HAND", "at": {"xyz": [0.0, 0.4, 0.0]}},
                "look-at": {"point": [0.6, 0.0, 0.2], "angle": 0.1},
                "distance": {"bounds": [0.3, 0.5], "point": [0.6, 0.0, 0.2]},
                "on-sphere": {"centre": [0.6, 0.0, 0.2], "radius": 0.3},
                "joint-coupling": {"factors": {"JOINT": 1.0, "OTHER": -1.0}},
                "centre-of-mass": {"corners": [[0.1, 0.1], [-0.1, 0.1], [0.0, -0.1]]},
                "on-cylinder": {"direction": [0, 0, 1], "point": [0.6, 0.0, 0.2], "radius": 0.3},
            }
            filled = json.dumps({value: examples.get(value, 0.1)})
            raise InvalidInputError(f"{where} is {shown(value)}, a name alone; write {filled}")
        full = field_kinds(TaskSpaceRegionChain)
        keys = [key for key in mapping(value, where, ", ".join(full)) if key != "_comment"]
        unknown = next((key for key in keys if key not in (*full, *NAMED_REGIONS)), None)
        if unknown is not None:
            raise InvalidInputError(
                f"{at(where, shown(unknown)[1:-1])} is unknown"
                f"{nearest(unknown, [*full, *NAMED_REGIONS])}; fields: {', '.join(full)}, or one "
                f"of {', '.join(NAMED_REGIONS)} alone, or with {HAND_FIELD}"
            )
        # a region in full may have a field that is called like a name
        names = [key for key in keys if key in NAMED_REGIONS]
        names = [key for key in names if key not in full or "T0_w" not in value]
        if not names:
            kind: Any = TaskSpaceRegionChain if "base" in value else TaskSpaceRegion
            return from_plain(kind, value, where)
        name = names[0]
        if [key for key in keys if key not in (name, HAND_FIELD)]:
            raise InvalidInputError(
                f"{where} has {', '.join(keys)}; a region by name stands alone, or with "
                f"{HAND_FIELD}"
            )
        kind, content = NAMED_REGIONS[name], value[name]
        if not isinstance(content, Mapping):
            content = {next(iter(field_kinds(kind))): content}
        made = from_plain(kind, content, at(where, name))
        if not isinstance(made, TaskSpaceRegion) and not self.with_functions:
            raise InvalidInputError(f"{where} is {name}, which is no region: give it as constraint")
        if HAND_FIELD not in value:
            return made
        if not isinstance(made, TaskSpaceRegion):
            raise InvalidInputError(f"{where}: {name} is about no frame: leave out {HAND_FIELD}")
        hand = from_plain(Name | None, value[HAND_FIELD], at(where, HAND_FIELD))
        return made.changed(end_effector=hand)

    def schema(self, schema_of: Any) -> dict[str, Any]:
        """Return the JSON schema of all regions: in full, and by each name."""
        found = [schema_of(TaskSpaceRegion), schema_of(TaskSpaceRegionChain)]
        for name, kind in NAMED_REGIONS.items():
            content = schema_of(kind)
            first, *others = field_kinds(kind).items()
            if first[1] is not Any and field_defaults(kind).keys() >= dict(others).keys():
                alone = {"not": {"type": "object"}, **schema_of(first[1])}
                content = {"anyOf": [alone, content]}
            fields = {name: content, HAND_FIELD: schema_of(Name | None), "_comment": {}}
            found.append(
                {
                    "type": "object",
                    "properties": fields,
                    "required": [name],
                    "additionalProperties": False,
                }
            )
        return {"anyOf": found}


Region = Annotated[TaskSpaceRegion, RegionForm()]


def rpy_of(R: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw (3,) [rad] of a rotation (3, 3); yaw is 0 at a pitch of 90 deg."""
    from scipy.spatial.transform import Rotation  # takes 0.3 s

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # at that pitch, roll and yaw are not unique
        return Rotation.from_matrix(R).as_euler("xyz")
