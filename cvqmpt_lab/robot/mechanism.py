"""What is added to a robot: a tool, or the door or drawer that it moves.

A robot and a door are one kinematic tree of n + 1 joints.
Planners and kernels treat the door as part of the arm: its pieces are links, its handle is a frame.
"""

from __future__ import annotations  # `help` then shows types by their names

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated, Literal

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.codec import Checked, to_plain
from cvqmpt_lab.base.convex import require_volume
from cvqmpt_lab.base.errors import InvalidInputError, require_choice, unique
from cvqmpt_lab.base.poses import Pose
from cvqmpt_lab.base.values import Array, FloatArray, Length, Name
from cvqmpt_lab.robot.hulls import coal_hull, link_geometry
from cvqmpt_lab.robot.left_out import LeftOut
from cvqmpt_lab.robot.robot import Robot, axis_frames, in_link, kinematics_arrays


def add_tool(model: pin.Model, link: str, T_link_tool: np.ndarray) -> tuple[str, str]:
    """Add the frame LINK/tool to a model; return its name, and a line on what refers to it.

    The link keeps its pose. InvalidInputError: the model has a frame of this name.
    """
    name = f"{link}/tool"
    if model.existFrame(name):
        raise InvalidInputError(
            f"robot {model.name} has a frame {name!r} already, the name of the tool at {link}: "
            f"give {name} as end effector, without a tool, or rename it in the URDF"
        )
    number = model.getFrameId(link, pin.FrameType.BODY)
    held = model.frames[number]
    T_joint_tool = held.placement * pin.SE3(T_link_tool)
    model.addFrame(pin.Frame(name, held.parentJoint, number, T_joint_tool, pin.FrameType.BODY))
    place = " ".join(f"{x:g}" for x in T_link_tool[:3, 3])
    return name, (
        f"the hand is {name}, a tool at {place} m of {link}: constraint, goals and loads refer to "
        f"it; the name {link} means the link"
    )


def placed_frames(
    model: pin.Model, axes: list[np.ndarray], names: Sequence[str]
) -> dict[str, tuple[int, np.ndarray]]:
    """Return the pose row and T_link_frame (4, 4) of body frames, by name.

    axes: result of `axis_frames`.
    """
    frames = {name: model.frames[model.getFrameId(name, pin.FrameType.BODY)] for name in names}
    return {name: in_link(axes, f.parentJoint, f.placement) for name, f in frames.items()}


@dataclass(frozen=True, eq=False)
class Part(Checked):
    """A convex piece of an articulated object."""

    name: Name  # if the piece moves, the robot has a frame of this name
    T: Pose  # (4, 4) in the joint frame at value 0 if the piece moves, else in the world
    vertices: Annotated[FloatArray, Array((None, 3), "corners [m]")]  # (n, 3), in its own frame [m]

    def _check(self) -> None:
        require_volume(self.vertices, f"part {self.name!r}")


@dataclass(frozen=True, eq=False)
class ArticulatedObject(Checked):
    """A door or drawer: one joint, the pieces that it moves, and the fixed pieces around them."""

    name: Name  # name of the joint
    kind: Literal["hinge", "slider"]  # turns about the z axis of the joint frame, or moves along it
    T_world_joint: Pose  # (4, 4) at value 0
    lower: float  # [rad or m]
    upper: float  # [rad or m]
    parts: tuple[Part, ...]  # pieces that move
    casing: tuple[Part, ...] = ()  # fixed pieces, checked against the robot but not the parts
    # (robot piece, part) pairs that are not checked, e.g. finger and handle
    may_touch: tuple[tuple[str, str], ...] = ()
    velocity: Length = 1.0  # limit [rad/s or m/s], used only for timing
    acceleration: Length = 2.0  # limit [rad/s^2 or m/s^2], used only for timing

    def _check(self) -> None:
        what = f"articulated object {self.name!r}"
        if not self.lower < self.upper:
            raise InvalidInputError(
                f"{what} has range [{self.lower}, {self.upper}]: it needs lower < upper; something "
                "that does not move belongs in the scene"
            )
        if not self.parts:
            raise InvalidInputError(f"{what} moves nothing: give 'parts'")
        unique((part.name for part in (*self.parts, *self.casing)), f"pieces of {what}")


def with_articulated_object(robot: Robot, item: ArticulatedObject) -> Robot:
    """Return the robot with a door or drawer: its joint becomes the last one, its pieces links.

    A part's pose is T_world_joint Rot_z(q_n) T for a hinge, T_world_joint Trans_z(q_n) T for a
    slider. The scene must not contain these pieces: `scene.articulation.take_out` removes them.
    """
    _check_names(robot, item)
    model = robot.model.copy()
    geometry = robot.collision_model.copy()
    joint = model.addJoint(
        0,
        pin.JointModelRZ() if item.kind == "hinge" else pin.JointModelPZ(),
        pin.SE3(item.T_world_joint),
        item.name,
        # no effort limit
        np.full(1, np.inf),
        np.array([item.velocity], dtype=float),
        np.array([item.lower], dtype=float),
        np.array([item.upper], dtype=float),
    )
    above = model.addJointFrame(joint)
    for part in item.parts:
        model.addFrame(pin.Frame(part.name, joint, above, pin.SE3(part.T), pin.FrameType.BODY))
    arm = range(geometry.ngeoms)
    for carrier, pieces in ((joint, item.parts), (0, item.casing)):
        for piece in pieces:
            hull = coal_hull(piece.vertices)
            added = pin.GeometryObject(piece.name, carrier, pin.SE3(piece.T), hull)
            geometry.addGeometryObject(added)
    objects = geometry.geometryObjects
    parts = range(len(arm), len(arm) + len(item.parts))
    casing = range(parts.stop, len(objects))
    pairs = [
        (i, k)
        for k, i in product(parts, arm)
        if (objects[i].name, objects[k].name) not in item.may_touch
    ]
    pairs += [(i, k) for k, i in product(casing, arm) if objects[i].parentJoint != 0]
    for i, k in pairs:
        geometry.addCollisionPair(pin.CollisionPair(i, k))
    left_out = [LeftOut(*names, "may touch") for names in item.may_touch]
    both = product(item.parts, item.casing)
    left_out += [LeftOut(part.name, fixed.name, "casing") for part, fixed in both]
    frames = axis_frames(model)
    limits = {
        kind: np.append(values, item.acceleration if kind == "acceleration" else np.inf)
        for kind, values in robot.limits.items()
    }
    return replace(
        robot,
        name=f"{robot.name}+{item.name}",
        source={**robot.source, "articulated": to_plain(item)},
        model=model,
        collision_model=geometry,
        kinematics=kinematics_arrays(model, frames, robot.followers),
        links=(*robot.links, *(link_geometry(objects[k], frames) for k in (*parts, *casing))),
        self_collision_pairs=(*robot.self_collision_pairs, *pairs),
        left_out_pairs=(*robot.left_out_pairs, *left_out),
        limits=limits,
    )


def _check_names(robot: Robot, item: ArticulatedObject) -> None:
    if "articulated" in robot.source:
        raise InvalidInputError(
            f"robot {robot.name} has an articulated object already: give the arm without it"
        )
    pieces = [piece.name for piece in robot.links]
    parts = [part.name for part in item.parts]
    known = {*pieces, *robot.frame_names, *robot.moving_joints}
    for name in (item.name, *(part.name for part in (*item.parts, *item.casing))):
        if name in known:
            raise InvalidInputError(
                f"robot {robot.name} has a {name!r} already: use another name in {item.name!r}"
            )
    for pair in item.may_touch:
        for what, name, names in zip(("robot piece", "part"), pair, (pieces, parts), strict=True):
            require_choice(f"{what} in 'may_touch' of {item.name!r}", name, names)
