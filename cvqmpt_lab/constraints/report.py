"""Reports on bounds: the share that a path uses, the bound that is violated most, useless ones.

Bounds that no state exceeds are refused: degrees or millimetres were meant.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import rotation_matrices
from cvqmpt_lab.base.values import FULL_TURN_RAD
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.region_constraint import Member
from cvqmpt_lab.constraints.task_space_region import (
    ROWS,
    UNITS,
    TaskSpaceRegion,
    displacements,
    excess,
    shown_lower,
)
from cvqmpt_lab.robot.robot import Robot

if TYPE_CHECKING:
    from cvqmpt_lab.constraints.joint_coupling import CoupledJoints

# pi or 2 pi, rounded, stand for a free rotation; other angles above pi are probably degrees
ROUNDED_HALF_TURN_RAD = 3.2
ROUNDED_FULL_TURN_RAD = 6.2


@dataclass(frozen=True)
class BoundUse:
    """Largest use of one entry's bounds along a path."""

    region: int  # index of the region, from 0
    row: int  # row of its `bounds`, 0 to 9
    value: float  # displacement closest to a bound, or furthest beyond it [m] or [rad]
    lower: float  # lower bound, -inf where there is none [m] or [rad]
    upper: float  # upper bound, inf where there is none [m] or [rad]

    @property
    def excess(self) -> float:
        """max(lower - value, value - upper) [m] or [rad]; negative inside."""
        return max(self.lower - self.value, self.value - self.upper)

    @property
    def unit(self) -> str:
        """Unit of value and bounds."""
        return str(UNITS[self.row])

    def __str__(self) -> str:
        """Return the use in words: "rotation about y 0.071 of 0.100 rad"."""
        if self.lower == -self.upper:
            return f"{ROWS[self.row]} {abs(self.value):.3g} of {self.upper:.3g} {self.unit}"
        lower = shown_lower(self.row, self.lower)
        return f"{ROWS[self.row]} {self.value:.3g} of {lower:.3g} to {self.upper:.3g} {self.unit}"


def bound_usage(
    robot: Robot, regions: Sequence[TaskSpaceRegion], states: np.ndarray
) -> tuple[BoundUse, ...]:
    """Return the largest use of every bound of regions over states (m, n), m >= 1, by pinocchio."""
    uses = []
    for k, region in enumerate(regions):
        x = displacements(robot, region, states)
        worst = excess(region, x).argmax(axis=0)
        for row in map(int, region.bounded_rows):
            bounds = map(float, region.bounds[row])
            uses.append(BoundUse(k, row, float(x[worst[row], row]), *bounds))
    return tuple(uses)


def broken_bound(region: TaskSpaceRegion, x: np.ndarray) -> str:
    """Return the bound that the best of displacements x (m, 10) violates most, in words, or ""."""
    beyond = excess(region, x)
    k = int(beyond.max(axis=1).argmin())
    if beyond[k].max() <= PROJECTION_TOLERANCE:
        return ""
    row = int(beyond[k].argmax())
    use = BoundUse(0, row, float(x[k, row]), *map(float, region.bounds[row]))
    # names of regions in problem files (see `named`) by the rows that they bound
    kinds = {
        (6,): "upright",
        (3, 4): "upright",
        (4, 5): "upright-box",
        (3, 4, 5): "fixed-orientation",
        (2,): "plane",
        (0, 1): "line",
        (7,): "distance",
        (8,): "on-cylinder",
        (9,): "look-at",
        (7, 9): "look-at",
        (0, 1, 2, 3, 4, 5): "pose",
        (0, 1, 2, 5, 6): "pose",
    }
    kind = kinds.get(tuple(region.bounded_rows.tolist()), "the region")
    leaning = ""
    if kind.startswith("upright"):
        leans = np.arccos(rotation_matrices(x[k, None, 3:6])[0, 0, 0].clip(-1.0, 1.0))
        leaning = f" (it tilts by {np.degrees(leans if kind == 'upright-box' else x[k, 6]):.0f}°)"
    return f"`{kind}` by {use.excess:.3g} {use.unit}: {use}{leaning}"


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
