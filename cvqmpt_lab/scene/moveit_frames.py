"""Frames of MoveIt's messages: links of the robot, or frames of fixed_frame_transforms."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.codec import from_plain
from cvqmpt_lab.base.errors import InvalidInputError, few, located, shown
from cvqmpt_lab.base.poses import Placement, ros_vector
from cvqmpt_lab.base.readers import field_of, listed
from cvqmpt_lab.base.values import FloatArray, numbers
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import log


class FixedTransform(NamedTuple):
    """An item of fixed_frame_transforms."""

    header: str
    child: str
    value: Any  # of the field transform

    @property
    def matrix(self) -> FloatArray:
        """The transform (4, 4) [m]."""
        with located(f"transform of {shown(self.header)} and {shown(self.child)}"):
            parts = (ros_vector(field_of(self.value, key)) for key in ("translation", "rotation"))
            return matrix_of(*parts)


def matrix_of(position: Any, orientation: Any) -> FloatArray:
    """Return a pose (4, 4); orientation: quaternion x, y, z, w, zeros for identity as in MoveIt."""
    turn = numbers(orientation, "orientation", "4 numbers, a quaternion x, y, z, w")
    quaternion = turn.tolist() if turn.any() or turn.shape != (4,) else [0.0, 0.0, 0.0, 1.0]
    return from_plain(Placement, {"xyz": position, "quaternion": quaternion}, "pose").matrix


def fixed_transforms(message: Mapping[str, Any]) -> list[FixedTransform]:
    """Return the transforms of a PlanningScene between two different frames."""
    found = [
        FixedTransform(
            frame_name(field_of(field_of(item, "header"), "frame_id")),
            frame_name(field_of(item, "child_frame_id")),
            field_of(item, "transform"),
        )
        for item in listed(message.get("fixed_frame_transforms"), "fixed_frame_transforms")
    ]
    return [item for item in found if not _of_one_frame(item)]


def _of_one_frame(item: FixedTransform) -> bool:
    """Return whether both names are one frame, as in the identity that MoveIt always writes."""
    if {item.header, item.child} == {"", "world"}:
        return np.array_equal(item.matrix, np.eye(4))
    return item.header == item.child


def frame_name(value: Any) -> str:
    """Return the name of a frame without the slash of old versions; "" for None."""
    return str(value or "").removeprefix("/")


def standing_frame(name: str, robot: Robot) -> FloatArray:
    """Return T_world_frame (4, 4) of a frame_id of a message, which must stand still."""
    if name in ("", "world") and name not in robot.frame_names:
        return np.eye(4)
    row, T = robot.link_of(name)
    if row != 0:
        raise InvalidInputError(
            f"frame_id {name!r} is moved by the planned joints; give a frame that stands still, "
            f"such as {robot.frame_names[0]!r}"
        )
    return T


def base_frame(name: str) -> FloatArray:
    """Return T_world_frame (4, 4) of a frame that by its name stands at a robot's base."""
    if not (_is_base(name) or name in ("", "world", "map", "odom", "origin")):
        raise InvalidInputError(
            f"frame_id {name!r} is not known to stand at the robot's base: give --robot, whose "
            "frames place the objects, or write their poses in frame world"
        )
    return np.eye(4)


def _is_base(name: str) -> bool:
    """Return whether a frame is a robot's base by its name, e.g. base_link or panda_link0."""
    return re.search(r"base|root|link_?0$", name.lower()) is not None


def placed_frames(
    names: Sequence[str], transforms: Sequence[FixedTransform], robot: Robot | None
) -> dict[str, FloatArray]:
    """Return T_world_frame (4, 4) of frames that objects are in, by name.

    MoveIt takes a transform as T_child_header, with a link of the robot as child. As in tf, it is
    T_header_child if the header has the link. Unused transforms are named in a warning. Without a
    robot, the names tell which frames are bases.
    """
    known: Callable[[str], bool] = _is_base
    stands: Callable[[str], FloatArray] = base_frame
    if robot is not None:
        known, stands = {*robot.frame_names}.__contains__, partial(standing_frame, robot=robot)
    found, used = dict[str, FloatArray](), list[FixedTransform]()
    for name in names:
        poses = list[FloatArray]()
        for item in transforms if name and not known(name) else ():
            link = {item.header: item.child, item.child: item.header}.get(name, "")
            if known(link):
                used.append(item)
                poses.append(stands(link) @ item.matrix)
        if any(not np.allclose(T, poses[0]) for T in poses):
            raise InvalidInputError(
                f"fixed_frame_transforms have several poses of frame {name!r}; keep one"
            )
        found[name] = poses[0] if poses else stands(name)
        if poses:
            at = " ".join(f"{x:.4g}" for x in poses[0][:3, 3])
            log.warning(f"frame {name!r} is at {at} m, as fixed_frame_transforms have it")
    unused = [f"{item.header!r} to {item.child!r}" for item in transforms if item not in used]
    if unused:
        log.warning(f"fixed_frame_transforms that no object needs are left out: {few(unused)}")
    return found
