"""Bounds on the violation of a task-space region between the states of straight joint motions."""

import numpy as np

from cvqmpt_lab.base.poses import rotation_matrices
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, excess
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
    changes), no tilt by more than D^2 / 8 (see `_between_tilts`); distance, radius and bearing: see
    `_between_places`. Where the sign may change and rotation bounds are not symmetric, the ends
    count with both signs.

    Args:
        robot: the robot.
        region: the region.
        q: (m, n) [rad or m].
        x: (m, 10), displacements [m, rad].

    Returns:
        The bound (m - 1,) [m, rad], and whether it is linear in the length of the stretch (m - 1,):
        near singularities: rotation angle pi, tilt pi, distance, radius or bearing 0.
    """
    # of all joints: mimic joints turn links, too
    change = np.abs(np.diff(robot.kinematics.joint_values(q), axis=0))
    rows = region.bounded_rows
    slides = robot.kinematics.prismatic
    turn, slide = change[:, ~slides].sum(1), change[:, slides].sum(1)
    angle = np.linalg.norm(x[:, 3:6], axis=1)
    flips = np.maximum(angle[:-1], angle[1:]) + ROTATION_RATE * turn > np.pi
    rotation = np.where(flips, 0.5 * ROTATION_RATE * turn, ROTATION_BEND / 8.0 * turn**2)
    lever = longest_lever(robot, region)
    position = 0.25 * turn * (lever * turn + slide)
    turns = bool(((rows >= 3) & (rows < 6)).any())
    between = np.maximum(rotation * turns, position * bool((rows < 3).any()))
    if flips.any() and (region.bounds[3:6, 0] != -region.bounds[3:6, 1]).any():
        between = np.where(flips, np.maximum(between, rotation + _other_sign(region, x)), between)
    if not (rows >= 6).any():
        return between, flips
    found = [(between, flips & turns)]
    if 6 in rows:
        found.append(_between_tilts(turn, x[:, 6]))
    found += _between_places(robot, region, turn, slide, x)
    largest, linear = zip(*found, strict=True)
    return np.max(largest, axis=0), np.any(linear, axis=0)


def longest_lever(robot: Robot, region: TaskSpaceRegion) -> float:
    """Return a bound of the distance of the displaced origin of e from any joint's axis [m]."""
    _, (row, T_link_e) = region.links(robot)
    # a frame that is no end effector may stand out of the bodies
    beyond = robot.farthest[row] + np.linalg.norm(T_link_e[:3, 3]) - robot.reach
    arm = np.linalg.norm(region.Te_w[:3, 3])
    return float(2.0 * robot.reach + arm + max(beyond, 0.0))


def _other_sign(region: TaskSpaceRegion, x: np.ndarray) -> np.ndarray:
    """Increase of the violation at ends (m - 1,) if the rotation vector changes sign [m, rad].

    A rotation by pi has two vectors, v and -v; close to it, a motion has now one and now the other.

    Args:
        region: the region.
        x: (m, 10), displacements [m, rad].
    """
    mirrored = x * np.repeat([1.0, -1.0, 1.0], [3, 3, 4])
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


def _between_places(
    robot: Robot, region: TaskSpaceRegion, turn: np.ndarray, slide: np.ndarray, x: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Bounds on the excess of distance, radius and bearing over the larger excess at both ends.

    The origin p of e as w sees it, and that y of w as e sees it, are products of the joints between
    the two. With L a bound of their distance from a joint's axis, D the sum of the turns and S that
    of the slides of all joints, 0 <= s <= 1:

        |p''| <= a = L D^2 + 2 D S,    |p'| <= v = min(L D + S, |p(1) - p(0)| + a / 2).

    Distance and radius, r = |p| or |(p_x, p_y)|, have |r'| <= v and r'' <= a + v^2 / r. A norm is
    convex and p strays from its chord by at most a / 8, so r exceeds the larger end by no more. It
    falls below the smaller end by at most (a + v^2 / r) / 8 with r the least possible, (r(0) +
    r(1) - v) / 2. Both are at most v / 2.

    The bearing b is a polar angle of y = r (sin b cos f, sin b sin f, cos b), whose acceleration
    along b is r b'' + 2 r' b' - r sin(b) cos(b) f'^2. With r'^2 + (r b')^2 + (r sin(b) f')^2 <= v^2
    and c = max(1, -cot b) at the largest b possible,

        b'' >= -(a + c v^2 / r) / r,    b <= larger end + (a + c v^2 / r) / (8 r),

    and in any case b <= larger end + v / (2 r). At b = 0, b' only jumps upwards.

    Args:
        robot: the robot.
        region: the region.
        turn: D (m - 1,) [rad].
        slide: S (m - 1,) [m].
        x: (m, 10), displacements [m, rad].

    Returns:
        For each of these rows that is bounded, the smaller one of both bounds (m - 1,) [m, rad],
        and whether it is the linear one (m - 1,).
    """
    rows, found = region.bounded_rows, []
    (base, T_base_w), (link, T_link_e) = region.links(robot)

    def bounds(row: int, T: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v and a (m - 1,) of a point at the origin of T in a pose row."""
        lever = robot.farthest.max() + robot.farthest[row] + np.linalg.norm(T[:3, 3])
        a = turn * (lever * turn + 2.0 * slide)
        chord = np.linalg.norm(np.diff(points, axis=0), axis=1)
        return np.minimum(lever * turn + slide, chord + 0.5 * a), a

    def least(row: int, v: np.ndarray) -> np.ndarray:
        """Return the least possible r of each motion (m - 1,)."""
        return (0.5 * (x[:-1, row] + x[1:, row] - v)).clip(min=1e-12)

    for row, axes in ((7, 3), (8, 2)):
        if row in rows:
            v, a = bounds(link, T_link_e @ region.Te_w, x[:, :axes])
            inwards = v**2 / least(row, v) if np.isfinite(region.bounds[row, 0]) else 0.0
            found.append((0.5 * v, (a + inwards) / 8.0))
    if 9 in rows:
        y = np.einsum("mji,mj->mi", rotation_matrices(x[:, 3:6]), -x[:, :3])
        v, a = bounds(base, T_base_w, y)
        r = least(7, v)
        straight = np.minimum(0.5 * v / r, np.pi)
        largest = np.maximum(x[:-1, 9], x[1:, 9]) + straight
        c = np.maximum(1.0, -1.0 / np.tan(largest.clip(0.5 * np.pi, np.pi)))
        found.append((straight, (a + c * v**2 / r) / (8.0 * r)))
    return [(np.minimum(linear, bent), linear < bent) for linear, bent in found]
