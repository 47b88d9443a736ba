"""Time a path: the fastest motion within limits of speed, acceleration and jerk.

Along a curve q(s) with rounded corners the motion s(t) has the greatest sum of squared speeds
b = (ds/dt)^2 within the limits of speed and acceleration, a linear program:

    q' = dq/ds sqrt(b),    q'' = d2q/ds2 b + dq/ds a,    a = (db/ds) / 2.

Its path acceleration a jumps. Averaged over a window of T seconds,

    S(t) = 1/T int_{t-T}^{t} s(u) du,    S''(t) = (s'(t) - s'(t - T)) / T,

it does not, and the motion takes T longer. The window is the one with which the motion within the
limits of jerk is shortest; where averaging leads beyond a limit, the motion is slowed down as a
whole.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.interpolate import PPoly

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.dynamics import Dynamics
from cvqmpt_lab.robot.robot import SLOW, JointLimits
from cvqmpt_lab.trajectory.piecewise import extremes, quintic
from cvqmpt_lab.trajectory.smooth_curve import SmoothCurve, smooth_curve
from cvqmpt_lab.trajectory.trajectory import Trajectory


@dataclass(frozen=True)
class TimingSettings:
    """Settings of `time_path`."""

    speed: float = SLOW  # factor on velocity and acceleration limits, above 0 and at most 1
    deviation: float = 1e-3  # of the motion from the polyline at rounded corners, at most [rad]


def time_path(
    waypoints: np.ndarray,
    limits: JointLimits,
    settings: TimingSettings | None = None,
    check: Callable[[Trajectory], Sequence[str]] | None = None,
    dynamics: Dynamics | None = None,
) -> Trajectory:
    """The fastest motion along waypoints within the limits, at rest at both ends.

    Args:
        waypoints: (m, n) [rad or m], neighbours distinct.
        limits: of each joint.
        settings: speed, and how far corners may be cut.
        check: faults of the motion, see `motion_check.certified_motion`. While there are any,
            corners are cut less.
        dynamics: of the arm and what it carries; None: efforts are not limited.

    Raises InvalidInputError for waypoints that are no path, and names what holds the motion up.
    """
    settings = settings or TimingSettings()
    states = _checked_waypoints(waypoints)
    if states.shape[1] != len(limits.joint_names):
        raise InvalidInputError(
            f"waypoints have {states.shape[1]} joints, the limits {len(limits.joint_names)}: "
            f"{', '.join(limits.joint_names)}"
        )
    limits = limits.scaled(settings.speed)
    reasons: Sequence[str] = ()
    # a refused curve is drawn again, five times, each at half the deviation
    for k in range(6):
        curve = smooth_curve(states, settings.deviation / 2**k)
        motion = _trajectory(curve, squared_speeds(curve, limits, dynamics), limits, dynamics)
        reasons = check(motion) if check else ()
        if not reasons:
            return motion
    raise InvalidInputError(
        f"the path with rounded corners is refused even {curve.deviation:.1e} rad from it: "
        f"{'; '.join(reasons)}; plan with another seed"
    )


def _checked_waypoints(waypoints: np.ndarray) -> np.ndarray:
    """The waypoints (m, n) as floats; refused unless m >= 2, all finite, neighbours distinct."""
    try:
        states = np.array(waypoints, dtype=float)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            "waypoints are not an array of numbers: give (m, n) joint values [rad]"
        ) from error
    if states.ndim != 2 or len(states) < 2 or states.shape[1] == 0:
        raise InvalidInputError(
            f"waypoints have shape {states.shape}: give (m, n), two or more, one value a joint "
            "[rad]"
        )
    for k, j in np.argwhere(~np.isfinite(states)):
        raise InvalidInputError(
            f"waypoint {k} has {states[k, j]} at joint index {j}: give finite numbers"
        )
    for k in np.flatnonzero(np.linalg.norm(np.diff(states, axis=0), axis=1) < 1e-9):
        raise InvalidInputError(f"waypoint {k + 1} repeats waypoint {k}: leave one of the two out")
    return states


def _trajectory(
    curve: SmoothCurve, squared: np.ndarray, limits: JointLimits, dynamics: Dynamics | None
) -> Trajectory:
    """The motion averaged over 4 ms, or twice that, and so on while it is shorter.

    Over 0.25 ms without jerk limits: accelerations are continuous all the same.
    """
    window = 0.00025 if limits.jerk is None else 0.004
    motion = _averaged(curve, squared, limits, dynamics, window)
    while limits.jerk is not None:
        window *= 2.0
        other = _averaged(curve, squared, limits, dynamics, window)
        if other.duration >= motion.duration:
            break
        motion = other
    return motion


def _averaged(
    curve: SmoothCurve,
    squared: np.ndarray,
    limits: JointLimits,
    dynamics: Dynamics | None,
    window: float,
) -> Trajectory:
    """The motion averaged over a window [s], slowed down until it keeps the limits."""
    average = _average(_fastest(curve.grid, squared), window)
    # where the third derivative of the curve jumps: Newton's method from linear interpolation
    knots = np.unique(curve.spline.t)[1:-1]
    passed = np.interp(knots, average(average.x)[:, 0], average.x)
    for _ in range(4):
        passed -= (average(passed)[:, 0] - knots) / average.derivative()(passed)[:, 0]
    moments = _apart(np.concatenate([average.x, passed]), 0.01 * window)
    motion = _along(curve, average, moments, limits.joint_names)
    slower = _excess(motion, limits)
    if dynamics is not None:
        slower = max(slower, _excess_of_efforts(motion, limits, dynamics))
    return _along(curve, average, moments, limits.joint_names, slower)


def _fastest(grid: np.ndarray, squared: np.ndarray) -> PPoly:
    """The place s(t) of the motion with squared speeds (g,) at places grid (g,)."""
    speeds, steps = np.sqrt(squared), np.diff(grid)
    times = np.concatenate([[0.0], np.cumsum(2.0 * steps / (speeds[1:] + speeds[:-1]))])
    return PPoly([np.diff(squared) / (4.0 * steps), speeds[:-1], grid[:-1]], times)


def _average(s: PPoly, window: float) -> PPoly:
    """S(t) (1,), the mean of a place s(t) over the window [s] before t; pieces without jumps."""
    first, last = s.x[[0, -1]]
    still = np.array([[0.0], [0.0], [s(last)]])
    rest = PPoly(np.hstack([0.0 * still, s.c, still]), [first - window, *s.x, last + window])
    times = _apart(np.concatenate([s.x, s.x + window]), 0.01 * window)
    speed, rate = ((of(times) - of(times - window)) / window for of in (rest, rest.derivative()))
    speed[[0, -1]] = rate[[0, -1]] = 0.0
    # summed up: a difference of integrals loses digits that the jerk of short pieces needs
    h = np.diff(times)
    gains = h * (speed[:-1] + speed[1:]) / 2.0 + h**2 * (rate[:-1] - rate[1:]) / 12.0
    place = np.concatenate([[0.0], np.cumsum(gains)])
    place *= s(last) / place[-1]
    return quintic(times, place[:, None], speed[:, None], rate[:, None])


def _along(
    curve: SmoothCurve,
    average: PPoly,
    moments: np.ndarray,
    joint_names: tuple[str, ...],
    slower: float = 1.0,
) -> Trajectory:
    """The motion q(S(t)) at moments (k,) [s], in `slower` times its time and whole nanoseconds."""
    times = np.round(slower * moments, 9)
    at = np.minimum(times / slower, average.x[-1])
    place, speed, rate = (average.derivative(order)(at) / slower**order for order in range(3))
    speed[[0, -1]] = rate[[0, -1]] = 0.0
    slope, bend = curve.spline(place[:, 0], 1), curve.spline(place[:, 0], 2)
    return Trajectory(
        joint_names=joint_names,
        times=times,
        positions=curve.spline(place[:, 0]),
        # + 0.0 turns -0.0 into 0.0
        velocities=slope * speed + 0.0,
        accelerations=bend * speed**2 + slope * rate + 0.0,
        deviation=curve.deviation,
    )


def _apart(times: np.ndarray, least: float) -> np.ndarray:
    """Times in order, without those less than `least` [s] after another; the last one stays."""
    ordered = np.sort(times)
    kept = ordered[np.append(True, np.diff(ordered) > least)]
    kept[-1] = ordered[-1]
    return kept


def _excess(motion: Trajectory, limits: JointLimits, spare: float = 1e-6) -> float:
    """Factor on time, 1 or more, with which the motion keeps the limits."""
    slower = 1.0
    for order, limit in enumerate((limits.velocity, limits.acceleration, limits.jerk), start=1):
        if limit is not None:
            most = float((np.abs(extremes(motion.curve, order)[1]) / limit).max())
            slower = max(slower, (1.0 + spare) * most ** (1.0 / order))
    return slower


def _excess_of_efforts(
    motion: Trajectory,
    limits: JointLimits,
    dynamics: Dynamics,
    spare: float = 1e-3,
    period: float = 1e-3,
) -> float:
    """Factor on time, 1 or more, with which the motion keeps effort and torque rate.

    In c times its time efforts are (tau - g) / c^2 + g, and change at most by (tau - g)' / c^3 +
    g'. Efforts are computed at the motion's points, their changes every `period` [s].
    """
    assert limits.effort is not None
    curve, slower = motion.curve, 1.0
    every = np.minimum(np.arange(0.0, curve.x[-1] + period, period), curve.x[-1])
    for times, limit, order in ((curve.x, limits.effort, 2), (every, limits.torque_rate, 3)):
        if limit is None:
            continue
        states = [curve(times, k) for k in range(3)]
        weights = dynamics.weights(states[0], limits)
        moving = dynamics.efforts(*states) - weights
        if order == 3:
            moving, weights = (np.diff(x, axis=0) / period for x in (moving, weights))
            weights = np.abs(weights) * np.sign(moving)
        room = np.maximum((1.0 - spare) * limit - np.sign(moving) * weights, spare * limit)
        slower = max(slower, float((np.abs(moving) / room).max()) ** (1.0 / order))
    return slower


def squared_speeds(
    curve: SmoothCurve,
    limits: JointLimits,
    dynamics: Dynamics | None = None,
    flat: float = 1e-3,
    standstill: float = 1e-8,
) -> np.ndarray:
    """Squared speeds b = (ds/dt)^2 along a curve: the greatest sum within the limits.

    Args:
        curve: q(s).
        limits: |dq/ds| sqrt(b) <= velocity, |d2q/ds2 b + dq/ds (db/ds) / 2| <= acceleration.
        dynamics: |M (d2q/ds2 b + dq/ds (db/ds) / 2) + C(q, dq/ds) dq/ds b + g| <= effort, or None.
        flat: least |dq/ds| / velocity, as a share of the usual; 0 where all joints reverse.
        standstill: b, as a share of the usual, below which there is no motion.

    Returns:
        b (g,) [rad^2/s^2] on the grid, 0 at both ends.

    Raises InvalidInputError that names the joint that holds the motion up.
    """
    grid = curve.grid
    slope = np.abs(curve.spline(grid, 1))
    slowness = (slope / limits.velocity).max(axis=1)
    bound = np.maximum(slowness, flat * np.median(slowness)) ** -2
    bound = np.minimum(bound, _slow_at_corners(curve, limits, dynamics))
    typical = 1.0 / np.median((slope / limits.acceleration).max(axis=1))
    scale = min(np.median(bound), 2.0 * float(curve.marks[-1]) * typical)
    faster = _velocity_rows(curve, limits.velocity, bound)
    rows = [_acceleration_rows(curve, limits.acceleration, bound), faster]
    if dynamics is not None:
        rows.append(_effort_rows(curve, limits, dynamics, bound))
    rows = scale * sparse.vstack(rows, format="csr")
    bound = bound / scale
    bound[[0, -1]] = 0.0
    greatest = _greatest(rows, bound)
    shape = bound if greatest is None else np.minimum(greatest, bound)
    if greatest is None or shape[1:-1].min() <= standstill:
        raise InvalidInputError(_why_not(curve, limits, shape))
    return scale * np.maximum(shape, 0.0)


def _slow_at_corners(
    curve: SmoothCurve, limits: JointLimits, dynamics: Dynamics | None, share: float = 0.7
) -> np.ndarray:
    """Squared speeds b (g,) within jerk and torque rate at constant speed; inf where none limits.

    |d3q/ds3| b^(3/2) <= jerk and |M d3q/ds3| b^(3/2) <= torque rate. Without these bounds one
    sharp corner slows the whole motion down.

    share: of b that is left to corners; the rest is for changes of speed.
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
    """Rows (|dq/ds| / velocity)^2 (b_k + b_(k+1)) / 2 <= 1 where bounds (g,) imply none."""
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

    Between grid points d2q/ds2 b + dq/ds a, with a = (db/ds) / 2, is a parabola in s. Its three
    Bernstein coefficients enclose it: bounding them keeps the limits between grid points too.
    Rows implied by b <= bound (g,) are left out.
    """
    grid = curve.grid
    steps = np.diff(grid)[:, None]
    # factors of b at the two ends of each interval, (g - 1, n) each
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
    steps, lower, upper = np.diff(curve.grid), [], []
    for share in (0.0, 0.5, 1.0):
        s = curve.grid[:-1] + share * steps
        q, slope, bend = (curve.spline(s, order) for order in range(3))
        weights = dynamics.weights(q, limits)
        pull = dynamics.efforts(q, np.zeros_like(q), slope) - weights
        pull /= 2.0 * steps[:, None]
        swing = dynamics.efforts(q, slope, bend) - weights
        for sign in (1.0, -1.0):
            room = limits.effort - sign * weights
            lower.append(sign * ((1.0 - share) * swing - pull) / room)
            upper.append(sign * (share * swing + pull) / room)
    return _sparse_rows(np.concatenate(lower, axis=1), np.concatenate(upper, axis=1), bound)


def _sparse_rows(lower: np.ndarray, upper: np.ndarray, bound: np.ndarray) -> sparse.csr_matrix:
    """Rows lower b_k + upper b_(k+1) <= 1 (g - 1, r), without those that others imply."""
    interval, column = np.nonzero(_binding(lower, upper, bound[:-1]))
    row = np.arange(len(interval))
    values = np.concatenate([lower[interval, column], upper[interval, column]])
    places = (np.concatenate([row, row]), np.concatenate([interval, interval + 1]))
    return sparse.csr_matrix((values, places), shape=(len(row), len(bound)))


def _binding(lower: np.ndarray, upper: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Which constraints lower x + upper y <= 1 (g - 1, r) no other one of their row implies.

    For x in 0..bound (g - 1,) and y >= 0, as upper limits of y they are lines in x: one that is
    looser than another at both ends is looser everywhere.
    """
    size = np.maximum(np.abs(upper), 1e-12)
    at_zero, at_bound = 1.0 / size, (1.0 - lower * bound[:, None]) / size
    above = upper > 0.0
    # others ask y to exceed something negative
    binding = above | (at_bound < 0.0)
    for r in range(lower.shape[1]):
        zero, end = at_zero[:, [r]], at_bound[:, [r]]
        tighter = (zero <= at_zero) & (end <= at_bound) & (above[:, [r]] == above)
        binding &= ~(tighter & ((zero < at_zero) | (end < at_bound)))
    return binding


def _greatest(
    rows: sparse.csr_matrix, bound: np.ndarray, tolerance: float = 1e-10
) -> np.ndarray | None:
    """The b (g,) that maximises sum_i b_i with rows b <= 1 and 0 <= b <= bound, or None."""
    # it takes half a second to import, which planning without timing need not wait for
    import cvxpy as cp

    b = cp.Variable(len(bound))
    problem = cp.Problem(cp.Maximize(cp.sum(b)), [rows @ b <= 1.0, b >= 0.0, b <= bound])
    options = {"primal_feasibility_tolerance": tolerance, "dual_feasibility_tolerance": tolerance}
    try:
        with warnings.catch_warnings():
            # of inaccurate solutions: limits are checked afterwards
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.HIGHS, highs_options=options)
    except cp.SolverError:
        return None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or b.value is None:
        return None
    return np.asarray(b.value)


def _why_not(curve: SmoothCurve, limits: JointLimits, shape: np.ndarray) -> str:
    """The joint and the inner grid point with the lowest speed."""
    s = curve.grid[1 + int(np.argmin(shape[1:-1]))]
    by_velocity = (np.abs(curve.spline(s, 1)) / limits.velocity) ** 2
    by_acceleration = np.abs(curve.spline(s, 2)) / limits.acceleration
    j = int(np.argmax(np.maximum(by_velocity, by_acceleration)))
    kind = "velocity" if by_velocity[j] > by_acceleration[j] else "acceleration"
    waypoint = int(np.argmin(np.abs(curve.marks - s)))
    return (
        f"the path cannot be timed: joint {limits.joint_names[j]!r}, {kind} limit "
        f"{getattr(limits, kind)[j]:.3g}, holds it up at {s:.3f} of {curve.marks[-1]:.3f} rad "
        f"(waypoint {waypoint}); raise that limit, or plan a path without that turn"
    )
