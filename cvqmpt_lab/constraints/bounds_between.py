"""Bounds on the violation of a task-space region between the states of straight joint motions."""

import numpy as np

from cvqmpt_lab.constraints.report import excess
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.robot.robot import Robot

# Bound on the second derivative of a rotation vector's entry per D^2, D = sum_j |dq_j|: |Jl^-1| is
# at most pi / 2, its derivative 1.29, and the angular velocity changes by half.
ROTATION_BEND = 2.81
# Bound on the first derivative per D, up to angle pi, where the rotation vector changes its sign.
ROTATION_RATE = 0.5 * np.pi


def bound_between(
    robot: Robot, region: TaskSpaceRegion, q: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute an upper bound on the increase of the violation between neighbouring states.

    On a motion with turns D = sum_j |dq_j|, no rotation entry of x exceeds the larger of its ends
    by more than ROTATION_BEND / 8 D^2 (or ROTATION_RATE / 2 D near angle pi, where its sign
    changes), and no tilt by more than D^2 / 8 (see `_between_tilts`). Where the sign may change and
    rotation bounds are not symmetric, the ends count with both signs.

    Args:
        robot: the robot.
        region: the region.
        q: (m, n) [rad or m].
        x: (m, 7), displacements [m, rad].

    Returns:
        The bound (m - 1,) [m, rad], and whether it is linear in the length of the stretch (m - 1,):
        where the rotation vector may change its sign, or the tilt comes close to pi.
    """
    # of all joints: those that mimic others turn links, too
    change = np.abs(np.diff(robot.kinematics.joint_values(q), axis=0))
    rows = region.bounded_rows
    slides = robot.kinematics.prismatic
    turn, slide = change[:, ~slides].sum(1), change[:, slides].sum(1)
    angle = np.linalg.norm(x[:, 3:6], axis=1)
    flips = np.maximum(angle[:-1], angle[1:]) + ROTATION_RATE * turn > np.pi
    rotation = np.where(flips, 0.5 * ROTATION_RATE * turn, ROTATION_BEND / 8.0 * turn**2)
    lever = 2.0 * robot.reach + np.linalg.norm(np.linalg.inv(region.Tw_e)[:3, 3])
    position = 0.25 * turn * (lever * turn + slide)
    turns = bool(((rows >= 3) & (rows < 6)).any())
    between = np.maximum(rotation * turns, position * bool((rows < 3).any()))
    if flips.any() and (region.bounds[3:6, 0] != -region.bounds[3:6, 1]).any():
        between = np.where(flips, np.maximum(between, rotation + _other_sign(region, x)), between)
    if 6 not in rows:
        return between, flips
    tilting, linear = _between_tilts(turn, x[:, 6])
    return np.maximum(between, tilting), linear | (flips & turns)


def _other_sign(region: TaskSpaceRegion, x: np.ndarray) -> np.ndarray:
    """Increase of the violation at ends (m - 1,) if the rotation vector changes sign [m, rad].

    A rotation by pi has two vectors, v and -v; close to it, a motion has now one and now the other.

    Args:
        region: the region.
        x: (m, 7), displacements [m, rad].
    """
    mirrored = x * np.repeat([1.0, -1.0, 1.0], [3, 3, 1])
    given, other = excess(region, x).max(axis=1), excess(region, mirrored).max(axis=1)
    further = np.maximum(other[:-1], other[1:]) - np.maximum(given[:-1], given[1:])
    return further.clip(min=0.0)


def _between_tilts(turn: np.ndarray, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bound on the excess of the tilt over the larger tilt b at both ends of each stretch.

    b is the angle between a fixed unit vector and z(s), which turns with angular velocity w(s), 0
    <= s <= 1. With |w| <= D = sum_j |dq_j|, |b'| <= D: b exceeds the larger end by at most D / 2.

    For the other bound let (b, p) be the polar angles of z on the sphere. The acceleration of z in
    the sphere has the part b'' - sin(b) cos(b) p'^2 along b. It is the part of w' x z + (w . z) w
    across z, at most |w'| + |w|^2 / 2. The axis of a joint is turned by the joints before it, so
    |w'| <= sum_{i < j} |dq_i| |dq_j| <= D^2 / 2. As sin(b) p' <= D, with c = max(0, -cot b),

        b'' >= -(1 + c) D^2,    b <= larger end + (1 + c) D^2 / 8,

    c at the largest tilt possible, the larger end + D / 2. At b = 0, where b has no derivative, b'
    only jumps upwards, which leaves the second bound true.

    Args:
        turn: D (m - 1,) [rad].
        tilt: (m,), at the ends [rad].

    Returns:
        The smaller one of both bounds (m - 1,) [rad], and whether it is the linear one (m - 1,).
    """
    largest = np.maximum(tilt[:-1], tilt[1:]) + 0.5 * turn
    c = np.maximum(0.0, -1.0 / np.tan(largest.clip(0.5 * np.pi, np.pi)))
    linear, bent = 0.5 * turn, (1.0 + c) / 8.0 * turn**2
    return np.minimum(linear, bent), linear < bent
