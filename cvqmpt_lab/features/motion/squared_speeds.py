"""Smooth curve q(s) along a path, and the largest squared speeds along it within the joint limits.

A robot can pass a corner of a planner's path without stopping only if the corner is rounded. The
curve q(s) is Schoenberg's spline: a cubic B-spline over arc length whose i-th control point is the
polyline at the average of knots i + 1 to i + 3. It keeps straight segments straight, rounds
corners on the inside (an interpolating spline would leave the checked clearance), stays in the
range of each joint and has continuous curvature. Its distance from a corner is about a sixth of
the knot spacing times the change of direction, so the knots are spaced more densely at corners
until that distance is small enough.

The squared speeds b = (ds/dt)^2 solve a linear program: maximise the sum of b on a grid such that

    q' = dq/ds sqrt(b),    q'' = d2q/ds2 b + dq/ds a,    a = (db/ds) / 2

keep the limits of velocity, acceleration and effort, which are rows of A b <= 1.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.interpolate import BSpline

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.polyline import distances_along, states_at
from cvqmpt_lab.features.motion.frame_speeds import FrameSpeeds
from cvqmpt_lab.features.motion.linear_program import greatest
from cvqmpt_lab.robot.dynamics import Dynamics
from cvqmpt_lab.robot.robot import JointLimits


@dataclass(frozen=True, eq=False)
class SmoothCurve:
    """A twice continuously differentiable curve q(s); s is close to the arc length [rad or m]."""

    spline: BSpline  # q(s) (n,) [rad or m]
    grid: np.ndarray  # (g,) values of s where speeds are computed: knots, points between [rad]
    deviation: float  # largest measured distance between q(s) and the polyline at s [rad]
    marks: np.ndarray  # (m,) values of s at the waypoints; the last is the polyline's length [rad]


class HeldSpeed(NamedTuple):
    """The speed along a curve at one of its ends, from there on for a distance."""

    speed: float = 0.0  # ds/dt [rad/s]
    distance: float = 0.0  # of s [rad]


def smooth_curve(
    states: np.ndarray,
    deviation: float,
    widest: float = 0.08,
    spans: int = 20,
    refinements: int = 40,
    samples: int = 8,
) -> SmoothCurve:
    """Smooth curve along waypoints that stays within `deviation` of their polyline.

    Args:
        states: waypoints (m, n) [rad or m]; neighbours differ.
        deviation: largest allowed distance from the polyline [rad].
        widest: knot spacing on smooth segments [rad].
        spans: minimum number of knot spans of a path of any length.
        refinements: maximum number of times that knots are spaced more densely.
        samples: points per knot span at which the distance is measured.

    Returns the curve. Raises InvalidInputError if no knots keep the deviation.
    """
    if not (np.isfinite(deviation) and deviation > 0.0):
        raise InvalidInputError(f"deviation {deviation}: give a distance above 0 [rad]")
    steps = np.diff(states, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    marks = distances_along(states)
    turns = np.linalg.norm(np.diff(steps / lengths[:, None], axis=0), axis=1)

    spacing, aim = min(widest, marks[-1] / spans), deviation
    for _ in range(refinements):
        knots = _knots(marks, turns, spacing, aim, spans)
        t = np.concatenate([np.repeat(knots[0], 3), knots, np.repeat(knots[-1], 3)])
        averages = (t[1:-3] + t[2:-2] + t[3:-1]) / 3.0
        spline = BSpline(t, states_at(states, marks, averages), 3)
        inside = np.arange(samples) / samples * np.diff(knots)[:, None]
        s = np.concatenate([(knots[:-1, None] + inside).ravel(), marks])
        # the distance at equal s is an upper bound of the distance between the two curves
        measured = float(np.linalg.norm(spline(s) - states_at(states, marks, s), axis=1).max())
        if measured <= deviation:
            # grid points between knots: three parts a span, four for the short spans at corners
            steps = np.diff(knots)
            parts = np.where(steps < 0.6 * steps.max(), 4, 3)
            cuts = [a + np.arange(m) / m * d for a, d, m in zip(knots, steps, parts, strict=False)]
            return SmoothCurve(spline, np.concatenate([*cuts, knots[-1:]]), measured, marks)
        aim *= 0.9 * deviation / measured
        spacing *= np.sqrt(0.9 * deviation / measured)
    raise InvalidInputError(
        f"no smooth curve within {deviation} rad of the path was found; give a larger deviation"
    )


def _knots(
    marks: np.ndarray,
    turns: np.ndarray,
    spacing: float,
    aim: float,
    spans: int,
    flat: float = 1.5,
    growth: float = 0.5,
) -> np.ndarray:
    """Knots (k,) from 0 to the end, so dense that the curve is about `aim` away from each corner.

    Args:
        marks: (m,) values of s at the waypoints [rad].
        turns: (m - 2,) changes of the unit direction at inner waypoints.
        spacing: knot spacing on smooth segments [rad].
        aim: distance of the curve from a corner [rad].
        spans: minimum number of knot spans.
        flat: number of finest spacings on each side of a corner before the spacing grows.
        growth: growth of the spacing per distance from a corner.
    """
    at_corner = 6.0 * aim / np.maximum(turns, 1e-12)
    sharp = at_corner < spacing
    corners, finest = marks[1:-1][sharp], at_corner[sharp]
    # the desired spacing is sampled on a lattice, and at corners, where it changes fast
    lattice = np.linspace(0.0, marks[-1], 4 * int(np.ceil(marks[-1] / spacing)) + 1)
    around = corners[:, None] + np.outer(finest, (-6, -4, -2.5, -flat, 0, flat, 2.5, 4, 6))
    s = np.unique(np.clip(np.concatenate([lattice, around.ravel()]), 0.0, marks[-1]))
    desired = np.full(len(s), spacing)
    for corner, fine in zip(corners, finest, strict=True):
        beyond = np.maximum(np.abs(s - corner) - flat * fine, 0.0)
        desired = np.minimum(desired, fine + growth * beyond)
    density = 0.5 * (1.0 / desired[1:] + 1.0 / desired[:-1]) * np.diff(s)
    count = np.concatenate([[0.0], np.cumsum(density)])
    most = max(spans, int(np.ceil(count[-1])))
    return np.interp(np.linspace(0.0, count[-1], most + 1), count, s)


def squared_speeds(
    curve: SmoothCurve,
    limits: JointLimits,
    dynamics: Dynamics | None = None,
    frames: FrameSpeeds | None = None,
    ends: tuple[HeldSpeed, HeldSpeed] = (HeldSpeed(), HeldSpeed()),
    flat: float = 1e-3,
    standstill: float = 1e-8,
    solver: str = "highs",
) -> np.ndarray:
    """Squared speeds b = (ds/dt)^2 along a curve with the largest sum within the limits.

    Args:
        curve: q(s).
        limits: |dq/ds| sqrt(b) <= velocity, |d2q/ds2 b + dq/ds (db/ds) / 2| <= acceleration.
        dynamics: |M (d2q/ds2 b + dq/ds (db/ds) / 2) + C(q, dq/ds) dq/ds b + g| <= effort, or None.
        frames: limits of the speeds of frames, |J dq/ds| sqrt(b) <= speed; or None.
        ends: speeds at the begin and at the end.
        flat: lower bound of |dq/ds| / velocity as a share of its median; it is 0 where all joints
            reverse at once.
        standstill: b, as a share of its typical value, below which the motion stands still.
        solver: of the linear program, see `linear_program.greatest`.

    Returns:
        b (g,) [rad^2/s^2] on the grid.

    Raises InvalidInputError that names the joint whose limit stops the motion, or the share of the
    speeds at the ends that is possible.
    """
    grid = curve.grid
    slope = np.abs(curve.spline(grid, 1))
    slowness = (slope / limits.velocity).max(axis=1)
    bound = np.maximum(slowness, flat * np.median(slowness)) ** -2
    bound = np.minimum(bound, _slow_at_corners(curve, limits, dynamics))
    if frames is not None:
        bound = np.minimum(bound, _slow_frames(curve, frames))
    typical = 1.0 / np.median((slope / limits.acceleration).max(axis=1))
    scale = min(np.median(bound), 2.0 * float(curve.marks[-1]) * typical)
    rows = [
        _acceleration_rows(curve, limits.acceleration, bound),
        _velocity_rows(curve, limits.velocity, bound),
    ]
    if dynamics is not None:
        rows.append(_effort_rows(curve, limits, dynamics, bound))
    rows = scale * sparse.vstack(rows, format="csr")
    bound = bound / scale
    begin, end = ends
    held = np.zeros(len(grid))
    held[grid <= begin.distance] = begin.speed**2 / scale
    held[grid >= grid[-1] - end.distance] = end.speed**2 / scale
    fixed = held > 0.0
    fixed[[0, -1]] = True

    def with_ends(share: float) -> np.ndarray | None:
        """Return b with this share of the speeds at the ends; None if there is no such b."""
        least = share**2 * held
        most = np.where(fixed, least, bound)
        return greatest(rows, most, least, solver) if (least <= bound).all() else None

    found = with_ends(1.0)
    if found is None and held.any():
        low, high = 0.0, 1.0
        for _ in range(7):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if with_ends(middle) is None else (middle, high)
        if low > 0.0:
            raise InvalidInputError(
                "the path cannot be timed with these velocities at its ends, but with about "
                f"{low:.2f} of them: give lower ones, or a higher speed factor on the limits"
            )
    if found is None:
        raise InvalidInputError(_why_not(curve, limits, bound))
    bound[fixed] = held[fixed]
    found = np.minimum(found, bound)
    if found[1:-1].min() <= standstill:
        raise InvalidInputError(_why_not(curve, limits, found))
    return scale * np.maximum(found, 0.0)


def _slow_frames(curve: SmoothCurve, frames: FrameSpeeds) -> np.ndarray:
    """Bounds (g,) on b so that frames keep their speeds at the grid and between its points."""
    s = np.linspace(curve.grid[:-1], curve.grid[1:], 5)
    used = frames.shares(curve.spline(s.ravel()), curve.spline(s.ravel(), 1)).reshape(s.shape)
    largest = used.max(axis=0)
    around = np.maximum(np.append(largest, 0.0), np.append(0.0, largest))
    with np.errstate(divide="ignore"):
        return around**-2.0


def _slow_at_corners(
    curve: SmoothCurve, limits: JointLimits, dynamics: Dynamics | None, share: float = 0.7
) -> np.ndarray:
    """Bounds (g,) on b so that jerk and torque rate keep their limits at constant speed.

    |d3q/ds3| b^(3/2) <= jerk and |M d3q/ds3| b^(3/2) <= torque rate; inf where neither is limited.
    Without these bounds one sharp corner would slow the whole motion down.

    share: share of that b which is used; the rest of jerk and torque rate is for changes of speed.
    """
    middle = 0.5 * (curve.grid[1:] + curve.grid[:-1])  # d3q/ds3 jumps at the grid
    change = curve.spline(middle, 3)
    slowness = np.zeros(len(middle))
    if limits.jerk is not None:
        slowness = (np.abs(change) / limits.jerk).max(axis=1)
    if dynamics is not None and limits.torque_rate is not None:
        q = curve.spline(middle)
        still = np.zeros_like(q)
        pull = dynamics.efforts(q, still, change) - dynamics.efforts(q, still, still)
        slowness = np.maximum(slowness, (np.abs(pull) / limits.torque_rate).max(axis=1))
    around = np.maximum(np.append(slowness, 0.0), np.append(0.0, slowness))
    with np.errstate(divide="ignore"):
        return share * around ** (-2.0 / 3.0)


def _velocity_rows(
    curve: SmoothCurve, velocity: np.ndarray, bound: np.ndarray
) -> sparse.csr_matrix:
    """Rows (|dq/ds| / velocity)^2 (b_k + b_(k+1)) / 2 <= 1 that b <= bound (g,) does not imply."""
    middle = 0.5 * (curve.grid[1:] + curve.grid[:-1])
    half = 0.5 * (np.abs(curve.spline(middle, 1)) / velocity).max(axis=1) ** 2
    interval = np.flatnonzero(half * (bound[1:] + bound[:-1]) > 1.0)
    values, row = np.tile(half[interval], 2), np.tile(np.arange(len(interval)), 2)
    places = (row, np.concatenate([interval, interval + 1]))
    return sparse.csr_matrix((values, places), shape=(len(interval), len(bound)))


def _acceleration_rows(
    curve: SmoothCurve, acceleration: np.ndarray, bound: np.ndarray
) -> sparse.csr_matrix:
    """Matrix A of the acceleration limits A b <= 1.

    Between grid points d2q/ds2 b + dq/ds a, with a = (db/ds) / 2, is a parabola in s. It lies
    between its three Bernstein coefficients, so bounds on these hold between grid points too.
    Rows that b <= bound (g,) implies are left out.
    """
    grid = curve.grid
    steps = np.diff(grid)[:, None]
    # coefficients of b at the two ends of each interval, (g - 1, n) each
    left, right = [], []
    for share in (0.0, 0.5, 1.0):
        s = grid[:-1] + share * np.diff(grid)
        change = curve.spline(s, 1) / acceleration / (2.0 * steps)
        bend = curve.spline(s, 2) / acceleration
        left.append((1.0 - share) * bend - change)
        right.append(share * bend + change)
    for side in (left, right):
        side[1] = 2.0 * side[1] - 0.5 * (side[0] + side[2])
    lower, upper = (np.concatenate([*side, *(-x for x in side)], axis=1) for side in (left, right))
    return _sparse_rows(lower, upper, bound)


def _effort_rows(
    curve: SmoothCurve, limits: JointLimits, dynamics: Dynamics, bound: np.ndarray
) -> sparse.csr_matrix:
    """Matrix A of the effort limits A b <= 1, at the ends and in the middle of every interval.

    tau = m a + c b + g, with m = M dq/ds and c = M d2q/ds2 + C(q, dq/ds) dq/ds.
    """
    assert limits.effort is not None
    steps = np.diff(curve.grid)
    lower, upper = [], []  # coefficients of b at the two ends of each interval
    for share in (0.0, 0.5, 1.0):
        s = curve.grid[:-1] + share * steps
        q, slope, bend = (curve.spline(s, order) for order in range(3))
        weights = dynamics.weights(q, limits)
        pull = dynamics.efforts(q, np.zeros_like(q), slope) - weights
        pull /= 2.0 * steps[:, None]
        swing = dynamics.efforts(q, slope, bend) - weights
        for sign in (1.0, -1.0):
            left = limits.effort - sign * weights  # effort that is left for the motion
            lower.append(sign * ((1.0 - share) * swing - pull) / left)
            upper.append(sign * (share * swing + pull) / left)
    return _sparse_rows(np.concatenate(lower, axis=1), np.concatenate(upper, axis=1), bound)


def _sparse_rows(lower: np.ndarray, upper: np.ndarray, bound: np.ndarray) -> sparse.csr_matrix:
    """Rows lower b_k + upper b_(k+1) <= 1 (g - 1, r), without redundant ones."""
    interval, column = np.nonzero(_binding(lower, upper, bound[:-1]))
    row = np.arange(len(interval))
    values = np.concatenate([lower[interval, column], upper[interval, column]])
    places = (np.concatenate([row, row]), np.concatenate([interval, interval + 1]))
    return sparse.csr_matrix((values, places), shape=(len(row), len(bound)))


def _binding(lower: np.ndarray, upper: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Mask (g - 1, r) of the non-redundant constraints lower x + upper y <= 1 of each interval.

    x is in [0, bound] (g - 1,) and y >= 0. Each constraint is an upper limit on y, linear in x. If
    it is looser than another one at both ends of x, it is looser everywhere, hence redundant.
    """
    size = np.maximum(np.abs(upper), 1e-12)
    at_zero, at_bound = 1.0 / size, (1.0 - lower * bound[:, None]) / size
    above = upper > 0.0
    # a constraint with upper <= 0 is a lower limit on y, and redundant where that is negative
    binding = above | (at_bound < 0.0)
    for r in range(lower.shape[1]):
        zero, end = at_zero[:, [r]], at_bound[:, [r]]
        tighter = (zero <= at_zero) & (end <= at_bound) & (above[:, [r]] == above)
        binding &= ~(tighter & ((zero < at_zero) | (end < at_bound)))
    return binding


def _why_not(curve: SmoothCurve, limits: JointLimits, squared: np.ndarray) -> str:
    """Error message: the inner grid point with the lowest speed, and the joint that limits it."""
    s = curve.grid[1 + int(np.argmin(squared[1:-1]))]
    by_velocity = (np.abs(curve.spline(s, 1)) / limits.velocity) ** 2
    by_acceleration = np.abs(curve.spline(s, 2)) / limits.acceleration
    j = int(np.argmax(np.maximum(by_velocity, by_acceleration)))
    kind = "velocity" if by_velocity[j] > by_acceleration[j] else "acceleration"
    waypoint = int(np.argmin(np.abs(curve.marks - s)))
    return (
        f"the path cannot be timed: joint {limits.joint_names[j]!r}, {kind} limit "
        f"{getattr(limits, kind)[j]:.3g}, stops it at {s:.3f} of {curve.marks[-1]:.3f} rad "
        f"(waypoint {waypoint}); raise that limit, or plan a path without that turn"
    )
