"""Grips of a handle for the hand of any arm: a bar between fingers, or a knob that is touched."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import rigid
from cvqmpt_lab.base.values import FULL_TURN_RAD
from cvqmpt_lab.constraints.task_space_region import Axis, axis_vector, nearest_axis
from cvqmpt_lab.robot.hulls import coal_hull
from cvqmpt_lab.robot.load import (
    gripper_joints,
    opening_sign,
    robot_from_source,
    with_gripper,
)
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.robot.source import PANDA_FINGER_OPENING_M
from cvqmpt_lab.robot.urdf import Joint
from cvqmpt_lab.scene.coal_shapes import coal_shape, shape_distance
from cvqmpt_lab.scene.shapes import Box

BAR_EDGE_M = 0.014  # edge of the square section of a bar


@dataclass(frozen=True, eq=False)
class Grip:
    """Pose of a hand that holds a handle, with its fingers open and closed.

    The frame of the handle: x away from the hand, y along the bar.
    """

    robot: Robot  # with its fingers open
    axis: Axis  # axis of the end effector, along which it approaches the handle
    T_handle_hand: np.ndarray  # (4, 4)
    beyond: float  # distance by which the hand extends past the handle's origin [m]
    bar: float  # length of a bar [m]; 0: a knob, whose face is the handle's origin
    touching: tuple[str, ...]  # pieces of the robot that touch the handle
    opened: Mapping[str, Any] = field(default_factory=dict)  # fields of the robot that open it
    closed: Mapping[str, Any] = field(default_factory=dict)  # fields of the robot that close it


def hold_of(source: Mapping[str, Any]) -> Grip:
    """Return the grip of an arm for the json of its robot.

    Fingers are the joints behind the arm's last joint. They are opened to the limit at which a bar
    fits in deepest, and closed until they touch it. If no bar fits, the hand touches a knob.

    Raises:
        InvalidInputError: the hand has no collision bodies.
    """
    fingers = _fingers(source)
    grips = [
        (hold, share)
        for share in ((1.0, 0.0) if fingers else (0.0,))
        for hold in _bars(source, _set(source, fingers, share))
    ]
    for hold, share in sorted(grips, key=lambda grip: -grip[0].beyond):
        closed = _closed(source, hold, fingers, share)
        if closed.touching:
            return closed
    return _knob(robot_from_source(source))


def _fingers(source: Mapping[str, Any]) -> list[Joint]:
    """Return the joints of the URDF that move behind the arm's last joint."""
    robot = robot_from_source(source)
    free = [joint for joint in gripper_joints(robot) if joint.immovable_reason is None]
    sliders = [joint.name for joint in free if joint.kind == "prismatic"]
    if len(sliders) > 1:
        moving = with_gripper(robot)
        signs = {f: opening_sign(moving, f, [o for o in sliders if o != f]) for f in sliders}
        # the limits of a slider that opens against the first one change places
        free = [
            replace(joint, lower=joint.upper, upper=joint.lower)
            if signs.get(joint.name, signs[sliders[0]]) != signs[sliders[0]]
            else joint
            for joint in free
        ]
    # the hand of TIAGo has tendons that turn by more than a joint can be held at
    return free if all(max(abs(f.lower), abs(f.upper)) <= FULL_TURN_RAD for f in free) else []


def _set(source: Mapping[str, Any], fingers: Sequence[Joint], share: float) -> dict[str, Any]:
    """Return the fields of the robot with fingers at a share of their range; {} without fingers."""
    if source.get("name") == "panda":
        return {"finger_opening": round(share * PANDA_FINGER_OPENING_M, 4)}
    at = {f.name: _rounded(f.lower + share * (f.upper - f.lower), f) for f in fingers}
    return {"locked": {**source.get("locked", {}), **at}} if fingers else {}


def _rounded(value: float, finger: Joint) -> float:
    """Return a value of a finger with four digits, within its limits also after rounding."""
    lower, upper = sorted((finger.lower, finger.upper))
    return min(max(round(value, 4), lower), upper)


def pieces_of(robot: Robot, end_effector: str | None = None) -> dict[str, np.ndarray]:
    """Return the corners (k, 3) of the pieces of a hand in the frame of the end effector [m].

    Raises:
        InvalidInputError: the end effector has no collision bodies.
    """
    row, T = robot.hand(end_effector)
    found = {
        piece.name: (piece.vertices_in_link - T[:3, 3]) @ T[:3, :3]
        for piece in robot.links
        if piece.link == row
    }
    if not found:
        raise InvalidInputError(
            f"robot {robot.name} has no collision bodies at "
            f"{end_effector or robot.end_effector}, so it is unknown where a handle touches it; "
            "name another --end-effector, or a URDF with such bodies"
        )
    return found


def outward(robot: Robot, end_effector: str | None = None) -> Axis:
    """Return the axis of an end effector that points away from its last joint."""
    _, T = robot.hand(end_effector)
    away = T[:3, :3].T @ T[:3, 3]
    if np.linalg.norm(away) < 0.01:
        # the frame of the last link: the direction of long fingers, else the joint's axis
        corners = np.concatenate(list(pieces_of(robot, end_effector).values()))
        away = T[2, :3] * (-1.0 if corners.mean(axis=0) @ T[2, :3] > 0.0 else 1.0)
        if np.abs(corners).max() > 0.08:
            away = corners.flat[np.abs(corners).argmax()] * np.eye(3)[np.abs(corners).argmax() % 3]
    return nearest_axis(away)


def _frame(axis: Axis, turned: bool) -> np.ndarray:
    """Return R_hand_handle (3, 3): x is the axis, y one of the two axes across it."""
    x = axis_vector(axis)
    y = np.eye(3)[("xyz".index(axis[-1]) + 1 + turned) % 3]
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _gaps(pieces: Mapping[str, np.ndarray], box: Box, T_hand_box: np.ndarray) -> dict[str, float]:
    """Return the distance of each piece of the hand to a box [m]."""
    shape = coal_shape(box)
    return {
        name: shape_distance(coal_hull(corners), np.eye(4), shape, T_hand_box)
        for name, corners in pieces.items()
    }


def _bars(source: Mapping[str, Any], opened: Mapping[str, Any], play: float = 0.003) -> list[Grip]:
    """Return grips of bars in both directions across the hand, if they fit in deep enough.

    Args:
        source: json of the robot.
        opened: fields of the robot that open its fingers.
        play: minimum distance between open fingers and a bar [m].
    """
    robot, found = robot_from_source({**source, **opened}), []
    pieces, axis = pieces_of(robot), outward(robot)
    for turned in (False, True):
        R = _frame(axis, turned)
        T = rigid(R)
        corners = np.concatenate(list(pieces.values())) @ R
        tip, length = corners[:, 0].max(), round(2.0 * np.abs(corners[:, 1]).max() + 0.06, 2)
        at = tip + BAR_EDGE_M
        while tip - at < 0.013:
            T[:3, 3] = (at - 0.001) * R[:, 0]
            if min(_gaps(pieces, Box((BAR_EDGE_M, length, BAR_EDGE_M)), T).values()) < play:
                break
            at -= 0.001
        T[:3, 3] = at * R[:, 0]
        if tip - at > 0.008:
            found.append(Grip(robot, axis, np.linalg.inv(T), tip - at, length, (), opened))
    return found


def _knob(robot: Robot, half: float = 0.015, gap: float = 0.002) -> Grip:
    """Return the grip of a knob that the hand touches.

    Args:
        robot: with its hand.
        half: half edge of the square end of the knob [m].
        gap: between hand and knob [m]; contact counts as a collision until the hand holds it.
    """
    pieces, axis = pieces_of(robot), outward(robot)
    R = _frame(axis, False)
    corners = np.concatenate(list(pieces.values())) @ R
    tip = corners[:, 0].max()
    T = rigid(R)
    box, at = Box((0.1, 2 * half, 2 * half)), tip
    for at in np.arange(tip + gap, tip - 0.1, -0.0005):
        T[:3, 3] = (at - 0.0005 + 0.05) * R[:, 0]
        gaps = _gaps(pieces, box, T)
        if min(gaps.values()) < gap:
            break
    T[:3, 3] = at * R[:, 0]
    near = tuple(name for name, off in gaps.items() if off < 2 * gap)
    return Grip(robot, axis, np.linalg.inv(T), max(tip - at, 0.0), 0.0, near)


def _closed(source: Mapping[str, Any], hold: Grip, fingers: Sequence[Joint], opened: float) -> Grip:
    """Return a grip with the fingers closed until they touch the bar.

    Args:
        source: json of the robot.
        hold: grip with open fingers.
        fingers: joints that close.
        opened: share of the fingers' range at which they are open.
    """
    box = Box((BAR_EDGE_M, hold.bar, BAR_EDGE_M))
    T = np.linalg.inv(hold.T_handle_hand)
    fields, gaps = hold.opened, _gaps(pieces_of(hold.robot), box, T)
    share, step = 1.0 - opened, 2.0 * opened - 1.0  # first all the way, then halves of the rest
    for _ in range(11 if fingers else 0):
        tried = _set(source, fingers, share)
        found = _gaps(pieces_of(robot_from_source({**source, **tried})), box, T)
        step *= 0.5
        if min(found.values()) < 0.0:
            share += step
            continue
        fields, gaps = tried, found
        if min(gaps.values()) < 2e-4 or share == 1.0 - opened:
            break
        share -= step
    near = {_link(name) for name, gap in gaps.items() if gap < 0.006}
    touching = tuple(name for name in gaps if _link(name) in near)
    return replace(hold, touching=touching, closed=fields)


def _link(piece: str) -> str:
    """Return the link of a piece, whose name ends with a number."""
    return piece.rpartition("_")[0]
