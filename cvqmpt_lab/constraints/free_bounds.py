"""Bounds of regions that bind nothing are refused: degrees or millimetres were meant."""

from typing import TYPE_CHECKING

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.values import FULL_TURN_RAD
from cvqmpt_lab.constraints.region_constraint import Member
from cvqmpt_lab.constraints.task_space_region import ROWS, UNITS, TaskSpaceRegion, shown_lower
from cvqmpt_lab.robot.robot import Robot

if TYPE_CHECKING:
    from cvqmpt_lab.constraints.joint_coupling import CoupledJoints

# pi or 2 pi, rounded, stand for a free rotation; other angles above pi are probably degrees
ROUNDED_HALF_TURN_RAD = 3.2
ROUNDED_FULL_TURN_RAD = 6.2


def binds_no_angle(bound: float) -> bool:
    """Return whether a bound [rad] is above pi and does not stand for a free rotation."""
    size = abs(bound)
    as_full = ROUNDED_FULL_TURN_RAD <= size <= FULL_TURN_RAD + 0.01
    return bool(np.isfinite(size) and size > ROUNDED_HALF_TURN_RAD and not as_full)


def angle_asked(bound: float) -> str:
    """Return the question about an angle that binds nothing [rad]."""
    return (
        f"{abs(bound):g} rad is more than half a turn and bounds nothing: degrees? {abs(bound):g} "
        f"deg = {np.radians(abs(bound)):.3g} rad; pi leaves it free"
    )


def refuse_free_bounds(robot: Robot, member: Member, where: str) -> None:
    """Refuse a member of a constraint with bounds that no state of a robot exceeds.

    Args:
        robot: the robot; InvalidInputError, too, if the member does not go with it.
        member: a region, or a function.
        where: name of the member in messages.
    """
    if isinstance(member, TaskSpaceRegion):
        _refuse_free_region(robot, member, where)
        return
    made = member.on(robot)
    from cvqmpt_lab.constraints.joint_coupling import CoupledJoints  # few problems have functions

    if isinstance(made, CoupledJoints):
        _refuse_free_sum(robot, made, where)


def _refuse_free_region(robot: Robot, region: TaskSpaceRegion, where: str) -> None:
    """Refuse a region with an angle above pi, or with lengths that no state of the robot exceeds.

    A region bounds its position if one of its bounds does: others may be wide.
    """
    for row, bound in zip(*_angles(region), strict=True):
        if binds_no_angle(bound):
            raise InvalidInputError(f"{where}: {ROWS[row]}: {angle_asked(bound)}")
    reached = _farthest_displacement(robot, region)
    for rows in ((0, 1, 2), (7,), (8,)):
        given = [(row, *region.bounds[row].tolist()) for row in rows]
        wide = [(row, lower, upper) for row, lower, upper in given if upper >= reached]
        finite = [it for it in wide if np.isfinite(it[2])]
        least = 0.0 if rows[0] >= 7 else -reached
        if not finite or len(wide) < len(given) or any(lower > least for _, lower, _ in wide):
            continue
        row, lower, upper = finite[0]
        raise InvalidInputError(
            f"{where}: {ROWS[row]} {shown_lower(row, lower):g} to {upper:g} {UNITS[row]} bounds "
            f"nothing, as {robot.name} reaches at most {reached:.3g} m from there: millimetres? "
            f"{upper:g} mm = {upper / 1000:g} m; null leaves it free"
        )


def _refuse_free_sum(robot: Robot, coupled: "CoupledJoints", where: str) -> None:
    """Refuse a joint-coupling whose bounds no state of the robot exceeds."""
    ends = np.stack([robot.lower, robot.upper]) * coupled.factors
    least, most = float(ends.min(axis=0).sum()), float(ends.max(axis=0).sum())
    lower, upper = coupled.given.bounds
    if lower <= least and upper >= most:
        raise InvalidInputError(
            f"{where}: {coupled.describe()} bounds nothing: by the joint limits, the sum is from "
            f"{least:.3g} to {most:.3g} [rad or m]: degrees or millimetres? {upper:g} deg = "
            f"{np.radians(upper):.3g} rad"
        )


def _angles(region: TaskSpaceRegion) -> tuple[np.ndarray, np.ndarray]:
    """Return row and value (k,) of the bounds of rotation, tilt and bearing [rad]."""
    rows = np.repeat(np.flatnonzero(UNITS == "rad"), 2)
    return rows, region.bounds[UNITS == "rad"].ravel()


def _farthest_displacement(robot: Robot, region: TaskSpaceRegion) -> float:
    """Bound the distance of the displaced origin from the origin of w [m]; at least the reach."""
    (base, T_base_w), (link, T_link_e) = region.links(robot)
    arms = T_base_w, T_link_e, np.linalg.inv(region.Tw_e)
    lengths = [float(np.linalg.norm(T[:3, 3])) for T in arms]
    joints = float(robot.farthest[base] + robot.farthest[link])
    return max(sum(lengths, joints), robot.reach)
