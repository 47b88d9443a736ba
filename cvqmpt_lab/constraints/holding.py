"""How far a second hand may move against an object that another hand carries."""

from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.robot.robot import Robot

MOST_PLAY_M = 0.02  # a second hand holds an object if its points move by no more against it


def play_of_hand(
    robot: Robot, regions: Sequence[TaskSpaceRegion], carrier: str | None, hand: str
) -> float:
    """Return a bound on the way of a hand's points against the hand that carries an object [m].

    It is the least bound of the regions between the two hands; inf: there is no such region.

    Args:
        robot: the robot.
        regions: the constraint.
        carrier: the hand that carries the object; None: the first one.
        hand: the other hand.
    """
    ends = {robot.hand(carrier)[0], robot.hand(hand)[0]}
    ties = [
        region
        for region in regions
        if isinstance(region, TaskSpaceRegionChain)
        and {row for row, _ in region.links(robot)} == ends
    ]
    return min((_play(robot, tie, hand) for tie in ties), default=np.inf)


def _play(robot: Robot, region: TaskSpaceRegionChain, hand: str) -> float:
    """Bound the way of the points of a hand, at one end of a region, against its other end [m].

    The hand's origin p in w moves to R p + t if the hand is at e, and to R^T (p - t) if it is at
    the base, with x = (t, Log R) in the bounds. Of two such x, with r the largest distance of a
    point of the hand from its origin,

        way <= |t - t'| + |R - R'| (|p| + r).

    If R turns freely about an axis of w, this axis may lean by an angle b. Then

        way <= |t - t'| + 2 (distance of p from the axis) + 2 sin(b) (|p| along the axis + r):

    turning about an axis through the hand itself is no way, as around a round handle.
    """
    (_, T_base_w), (end, T_link_e) = region.links(robot)
    row, T_link_hand = robot.hand(hand)
    lower, upper = region.bounds[:6].T
    if row == end:
        origin = (region.Tw_e @ np.linalg.inv(T_link_e) @ T_link_hand)[:3, 3]
        arm = np.abs(origin)
    else:
        origin = (np.linalg.inv(T_base_w) @ T_link_hand)[:3, 3]
        arm = np.abs(origin) + np.maximum(np.abs(lower[:3]), np.abs(upper[:3]))
    slides = float(np.linalg.norm(upper[:3] - lower[:3]))
    if not np.isfinite(slides):
        return np.inf
    points = [piece.vertices_in_link for piece in robot.links if piece.link == row]
    corners = np.concatenate([T_link_hand[None, :3, 3], *points])
    radius = float(np.linalg.norm(corners - T_link_hand[:3, 3], axis=1).max())
    ways = [_chord(_largest_turn(region)) * (float(np.linalg.norm(arm)) + radius)]
    for axis in range(3):
        off_axis = float(np.linalg.norm(np.delete(arm, axis)))
        leans = _chord(2.0 * _largest_lean(region, axis))
        ways.append(2.0 * off_axis + leans * (float(arm[axis]) + radius))
    return slides + min(ways)


def _chord(angle: float) -> float:
    """Return the largest way of a point at distance 1 from an axis, turned by up to an angle."""
    return float(2.0 * np.sin(0.5 * min(angle, np.pi)))


def _largest_turn(region: TaskSpaceRegion) -> float:
    """Bound the angle between two rotations in the bounds [rad].

    It is at most the distance of their rotation vectors, see `sample_poses` for those in a tilt.
    """
    lower, upper = region.bounds[3:6].T
    across = np.linalg.norm(upper[:2] - lower[:2])
    tilt = min(float(region.bounds[6, 1]), np.pi)
    return float(np.hypot(min(across, 2.0 * np.pi * np.sin(0.5 * tilt)), upper[2] - lower[2]))


def _largest_lean(region: TaskSpaceRegion, axis: int) -> float:
    """Bound the angle b between an axis of w and the same axis of the displaced frame [rad].

    With h the size of the rotation vector across the axis, sin(b / 2) <= h / 2.
    """
    across = np.delete(np.abs(region.bounds[3:6]).max(axis=1), axis)
    lean = 2.0 * np.arcsin(min(0.5 * float(np.linalg.norm(across)), 1.0))
    return float(min(lean, region.bounds[6, 1]) if axis == 2 else lean)
