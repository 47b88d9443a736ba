"""A robot and the door or drawer it moves, as one kinematic tree of n + 1 joints.

What holds for the arm then holds for the door: a planner turns its joint, its panel and handle are
links checked against the arm and against the scene, and its handle is a frame that a constraint may
hang on. No kernel knows of doors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.robot.arrays import axis_frames, kinematics_arrays
from cvqmpt_lab.robot.hulls import convex_hull, link_geometry
from cvqmpt_lab.robot.robot import Robot

JOINT_MODELS = {"hinge": pin.JointModelRZ, "slider": pin.JointModelPZ}


@dataclass(frozen=True, eq=False)
class Part:
    """A convex piece of an articulated object.

    Attributes
    ----------
    T: (4, 4), pose in the joint frame at value 0 for a piece that moves, in the world for one that does not.
    vertices: (n, 3), in its own frame [m].
    """

    name: str
    T: np.ndarray
    vertices: np.ndarray

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InvalidInputError(f"articulated part field 'name' must be a string, not {self.name!r}")
        object.__setattr__(self, "T", _pose(self.T, f"'T' of part {self.name!r}"))
        points = _numbers(self.vertices, f"'vertices' of part {self.name!r}")
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4:
            raise InvalidInputError(f"'vertices' of part {self.name!r} must be (4 or more, 3) numbers [m]")
        if np.linalg.matrix_rank(points - points.mean(axis=0)) < 3:  # coal would crash
            raise InvalidInputError(
                f"'vertices' of part {self.name!r} lie in one plane: they must span a volume"
            )
        object.__setattr__(self, "vertices", points)

    def to_dict(self) -> dict:
        """Plain json form."""
        return {"name": self.name, "T": self.T.tolist(), "vertices": self.vertices.tolist()}


@dataclass(frozen=True, eq=False)
class ArticulatedObject:
    """A door or drawer: one joint, the pieces it moves, and the fixed pieces these rest against.

    Attributes
    ----------
    name: of the joint. kind: "hinge", which turns about the z axis of the joint frame, or "slider", along it.
    T_world_joint: (4, 4) at value 0. lower, upper: range of the joint [rad or m].
    parts: what moves; each part's name is also that of a frame of the robot, which constraints may hang on.
    casing: fixed pieces that the parts touch, or nearly, without ever entering them. They are checked
        against the robot and what it carries, never against the parts.
    may_touch: (robot piece, part) pairs that are not checked: what holds the handle.
    velocity, acceleration: how fast it may be moved [rad/s or m/s, and per s]; only timing a path needs them.
    """

    name: str
    kind: str
    T_world_joint: np.ndarray
    lower: float
    upper: float
    parts: tuple[Part, ...]
    casing: tuple[Part, ...] = ()
    may_touch: tuple[tuple[str, str], ...] = ()
    velocity: float = 1.0
    acceleration: float = 2.0

    def __post_init__(self) -> None:
        what = f"articulated object {self.name!r}"
        if not isinstance(self.name, str) or not self.name:
            raise InvalidInputError(f"articulated object field 'name' must be a string, not {self.name!r}")
        if self.kind not in JOINT_MODELS:
            raise UnknownChoiceError(f"kind of {what}", self.kind, JOINT_MODELS)
        object.__setattr__(self, "T_world_joint", _pose(self.T_world_joint, f"'T_world_joint' of {what}"))
        limits = _numbers([self.lower, self.upper], f"range of {what}")
        if not limits[0] < limits[1]:
            raise InvalidInputError(
                f"{what} has range [{self.lower}, {self.upper}]: lower < upper needed, else leave it in the scene"
            )
        fast = _numbers([self.velocity, self.acceleration], f"velocity and acceleration of {what}")
        if not (fast > 0.0).all():
            raise InvalidInputError(
                f"{what} has velocity {self.velocity}, acceleration {self.acceleration}: above 0 needed"
            )
        if not self.parts:
            raise InvalidInputError(f"{what} moves nothing: give 'parts'")
        names = [part.name for part in (*self.parts, *self.casing)]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InvalidInputError(f"{what} has two pieces called {twice!r}: names must be unique")

    def to_dict(self) -> dict:
        """Plain json form: field 'articulated' of a robot's source."""
        return {
            "name": self.name,
            "kind": self.kind,
            "T_world_joint": self.T_world_joint.tolist(),
            "lower": float(self.lower),
            "upper": float(self.upper),
            "parts": [part.to_dict() for part in self.parts],
            "casing": [part.to_dict() for part in self.casing],
            "may_touch": [list(pair) for pair in self.may_touch],
            "velocity": float(self.velocity),
            "acceleration": float(self.acceleration),
        }

    @staticmethod
    def from_dict(data: Any) -> "ArticulatedObject":
        """Inverse of to_dict; names the missing or malformed field."""
        if not isinstance(data, Mapping):
            raise InvalidInputError(f"robot field 'articulated' must be a json object, not {data!r}")
        try:
            return ArticulatedObject(
                name=data["name"],
                kind=data["kind"],
                T_world_joint=data["T_world_joint"],
                lower=data["lower"],
                upper=data["upper"],
                parts=tuple(Part(p["name"], p["T"], p["vertices"]) for p in data["parts"]),
                casing=tuple(Part(p["name"], p["T"], p["vertices"]) for p in data.get("casing", [])),
                may_touch=tuple((a, b) for a, b in data.get("may_touch", [])),
                **{key: data[key] for key in ("velocity", "acceleration") if key in data},
            )
        except KeyError as error:
            raise InvalidInputError(f"articulated object field {error} is missing") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise InvalidInputError(f"articulated object is malformed: {error}") from error


def with_articulated_object(robot: Robot, item: ArticulatedObject) -> Robot:
    """The robot with one more joint, its last: that of a door or drawer, whose pieces become links.

    The scene must not hold these pieces any more: `scene.articulation.take_out` gives both.

    Raises
    ------
    InvalidInputError: a robot that has an articulated object already, or names that it knows already.
    UnknownChoiceError: a piece in may_touch that does not exist.
    """
    _check_names(robot, item)
    model, geometry = robot.model.copy(), robot.collision_model.copy()
    joint = _add_joint(model, item)
    arm = range(geometry.ngeoms)
    parts = _add_pieces(geometry, item.parts, joint)
    casing = _add_pieces(geometry, item.casing, 0)
    objects = geometry.geometryObjects
    pairs = [(i, k) for k in parts for i in arm if (objects[i].name, objects[k].name) not in item.may_touch]
    pairs += [(i, k) for k in casing for i in arm if objects[i].parentJoint != 0]
    for i, k in pairs:
        geometry.addCollisionPair(pin.CollisionPair(i, k))
    frames = axis_frames(model)
    accelerations = robot.acceleration_limits
    return replace(
        robot,
        name=f"{robot.name}+{item.name}",
        source={**robot.source, "articulated": item.to_dict()},
        model=model,
        collision_model=geometry,
        kinematics=kinematics_arrays(model, frames),
        links=(*robot.links, *(link_geometry(objects[k], frames) for k in (*parts, *casing))),
        self_collision_pairs=(*robot.self_collision_pairs, *pairs),
        acceleration_limits=None if accelerations is None else np.append(accelerations, item.acceleration),
    )


def _check_names(robot: Robot, item: ArticulatedObject) -> None:
    if "articulated" in robot.source:
        raise InvalidInputError(f"robot {robot.name} has an articulated object already: start from the arm")
    pieces = [piece.name for piece in robot.links]
    known = {*pieces, *robot.frame_names, *robot.joint_names}
    for name in (item.name, *(part.name for part in (*item.parts, *item.casing))):
        if name in known:
            raise InvalidInputError(
                f"robot {robot.name} has a {name!r} already: rename that of {item.name!r}"
            )
    for piece, part in item.may_touch:
        if piece not in pieces:
            raise UnknownChoiceError(f"robot piece in 'may_touch' of {item.name!r}", piece, pieces)
        if part not in [p.name for p in item.parts]:
            raise UnknownChoiceError(
                f"part in 'may_touch' of {item.name!r}", part, [p.name for p in item.parts]
            )


def _add_joint(model: pin.Model, item: ArticulatedObject) -> int:
    """Append the joint and a body frame for each part; the index of the joint."""
    joint = model.addJoint(
        0,
        JOINT_MODELS[item.kind](),
        pin.SE3(item.T_world_joint),
        item.name,
        np.full(1, np.inf),  # effort
        np.array([item.velocity], dtype=float),
        np.array([item.lower], dtype=float),
        np.array([item.upper], dtype=float),
    )
    above = model.addJointFrame(joint)
    for part in item.parts:
        model.addFrame(pin.Frame(part.name, joint, above, pin.SE3(part.T), pin.FrameType.BODY))
    return joint


def _add_pieces(geometry: pin.GeometryModel, parts: Sequence[Part], joint: int) -> list[int]:
    """Append convex hulls carried by a joint; their indices."""
    return [
        geometry.addGeometryObject(
            pin.GeometryObject(part.name, joint, pin.SE3(part.T), convex_hull(part.vertices))
        )
        for part in parts
    ]


def _numbers(value: Any, what: str) -> np.ndarray:
    """A read-only array of finite numbers."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{what} must hold numbers: {error}") from error
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{what} must hold finite numbers")
    array.setflags(write=False)
    return array


def _pose(value: Any, what: str) -> np.ndarray:
    """A read-only rigid transformation (4, 4)."""
    T = _numbers(value, what)
    rigid = T.shape == (4, 4) and np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0))
    if not (rigid and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6) and np.linalg.det(T) > 0.0):
        raise InvalidInputError(f"{what} must be a rigid pose (4, 4): rotation matrix and position")
    return T
