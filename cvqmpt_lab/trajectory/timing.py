"""Time a path: round its corners and find the fastest motion within speed and acceleration limits."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.robot import SLOW, JointLimits
from cvqmpt_lab.trajectory.curve import SmoothCurve, checked_waypoints, smooth_curve
from cvqmpt_lab.trajectory.trajectory import Trajectory

CHECKS = 5  # places in an interval, ends included, at which limits are checked
TIGHTENINGS = 3  # of a refused curve, each to a quarter of the deviation


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
) -> Trajectory:
    """The fastest motion along waypoints (m, n) [rad] within the limits, at rest at both ends.

    check: faults of the motion, see `motion_check.certified_motion`. While there are any, corners
        are cut less.
    """
    settings = settings or TimingSettings()
    states = checked_waypoints(waypoints)
    if states.shape[1] != len(limits.joint_names):
        raise InvalidInputError(
            f"waypoints have {states.shape[1]} joints, the limits {len(limits.joint_names)}: "
            f"{', '.join(limits.joint_names)}"
        )
    limits = limits.scaled(settings.speed)
    reasons: Sequence[str] = ()
    for k in range(TIGHTENINGS + 1):
        curve = smooth_curve(states, settings.deviation / 4**k)
        motion = _trajectory(curve, squared_speeds(curve, limits), limits)
        reasons = check(motion) if check else ()
        if not reasons:
            return motion
    raise InvalidInputError(
        f"the path with rounded corners is refused even {curve.deviation:.1e} rad from it: "
        f"{'; '.join(reasons)}; plan with another seed"
    )


def _trajectory(curve: SmoothCurve, squared: np.ndarray, limits: JointLimits) -> Trajectory:
    """Joint states on the curve's grid, slowed down where limits are exceeded between its points."""
    speeds, grid = np.sqrt(squared), curve.grid
    steps = np.diff(grid)
    times = np.concatenate([[0.0], np.cumsum(2.0 * steps / (speeds[1:] + speeds[:-1]))])
    path_acceleration = np.diff(squared) / (2.0 * steps)
    slower = _excess(curve, squared, path_acceleration, limits)
    first, second = curve.spline(grid, 1), curve.spline(grid, 2)
    a = np.append(path_acceleration, path_acceleration[-1])
    return Trajectory(
        joint_names=limits.joint_names,
        times=slower * times,
        positions=curve.spline(grid),
        velocities=first * speeds[:, None] / slower + 0.0,  # no -0.0
        accelerations=(second * squared[:, None] + first * a[:, None]) / slower**2,
        deviation=curve.deviation,
    )


def _excess(
    curve: SmoothCurve, squared: np.ndarray, path_acceleration: np.ndarray, limits: JointLimits
) -> float:
    """Factor on time (1 to about 1.002) that brings every joint within its limits between grid
    points.
    """
    grid = curve.grid
    share = np.linspace(0.0, 1.0, CHECKS)
    s = (grid[:-1, None] + share * np.diff(grid)[:, None]).ravel()
    b = (squared[:-1, None] + share * np.diff(squared)[:, None]).ravel()
    a = np.repeat(path_acceleration, CHECKS)
    first, second = curve.spline(s, 1), curve.spline(s, 2)
    velocity = np.abs(first) * np.sqrt(b)[:, None] / limits.velocity
    acceleration = np.abs(second * b[:, None] + first * a[:, None]) / limits.acceleration
    return float(max(1.0, velocity.max(), np.sqrt(acceleration.max())))


# The fastest motion along a curve q(s): maximise the sum of b = (ds/dt)^2 over the grid, a linear
# program. least |q'| / velocity limit, relative to the typical one: it is 0 where all joints
# reverse
FLAT = 1e-3
TOLERANCE = 1e-10  # of the linear program, whose numbers are about 1
STANDSTILL = 1e-8  # squared speed, relative to the typical one, below which there is no motion


def squared_speeds(curve: SmoothCurve, limits: JointLimits) -> np.ndarray:
    """Squared speeds b (g,) [rad^2/s^2] on the grid, 0 at both ends;
    InvalidInputError names a joint without motion.
    """
    grid = curve.grid
    slope = np.abs(curve.spline(grid, 1))
    slowness = (slope / limits.velocity).max(axis=1)  # least time per arc length
    bound = np.maximum(slowness, FLAT * np.median(slowness)) ** -2
    typical = 1.0 / np.median((slope / limits.acceleration).max(axis=1))
    scale = min(np.median(bound), 2.0 * curve.length * typical)
    faster = _velocity_rows(curve, limits.velocity, bound)
    rows = [_acceleration_rows(curve, limits.acceleration, bound), faster]
    rows = scale * sparse.vstack(rows, format="csr")
    bound = bound / scale
    bound[[0, -1]] = 0.0
    solved, shape = _greatest(rows, bound)
    shape = np.minimum(shape, bound)
    if not solved or shape[1:-1].min() <= STANDSTILL:
        raise InvalidInputError(_why_not(curve, limits, shape if solved else bound))
    return scale * np.maximum(shape, 0.0)


def _velocity_rows(
    curve: SmoothCurve, velocity: np.ndarray, bound: np.ndarray
) -> sparse.csr_matrix:
    """Velocity limits in the middle of intervals, where bounds (g,) at their ends do not imply
    them.
    """
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

    Between grid points q'' b + q' a, with a = b' / 2, is a parabola in s. Its three Bernstein
    coefficients, which enclose it, are bounded, so limits hold between grid points too. Rows
    implied by b <= bound (g,) are left out.
    """
    grid = curve.grid
    steps = np.diff(grid)[:, None]
    left, right = [], []  # factors of b at the two ends of each interval, (g - 1, n) each
    for share in (0.0, 0.5, 1.0):
        s = grid[:-1] + share * np.diff(grid)
        change = curve.spline(s, 1) / acceleration / (2.0 * steps)
        bend = curve.spline(s, 2) / acceleration
        left.append((1.0 - share) * bend - change)
        right.append(share * bend + change)
    for side in (left, right):
        side[1] = 2.0 * side[1] - 0.5 * (side[0] + side[2])
    lower, upper = (np.concatenate([*side, *(-x for x in side)], axis=1) for side in (left, right))
    interval, column = np.nonzero(_binding(lower, upper, bound[:-1]))
    row = np.arange(len(interval))
    values = np.concatenate([lower[interval, column], upper[interval, column]])
    places = (np.concatenate([row, row]), np.concatenate([interval, interval + 1]))
    return sparse.csr_matrix((values, places), shape=(len(row), len(grid)))


def _binding(lower: np.ndarray, upper: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Which constraints lower x + upper y <= 1 (g - 1, r) no other one of their row implies.

    For x between 0 and bound (g - 1,) and y >= 0, as upper limits of y these are straight lines in
    x: one that is looser than another at both ends is looser everywhere.
    """
    size = np.maximum(np.abs(upper), 1e-12)
    at_zero, at_bound = 1.0 / size, (1.0 - lower * bound[:, None]) / size
    above = upper > 0.0
    binding = above | (at_bound < 0.0)  # others ask y to exceed something negative
    for r in range(lower.shape[1]):
        tighter = (
            (at_zero[:, [r]] <= at_zero) & (at_bound[:, [r]] <= at_bound) & (above[:, [r]] == above)
        )
        binding &= ~(tighter & ((at_zero[:, [r]] < at_zero) | (at_bound[:, [r]] < at_bound)))
    return binding


def _greatest(rows: sparse.csr_matrix, bound: np.ndarray) -> tuple[bool, np.ndarray]:
    """Whether there is a solution, and the greatest b (g,), nan without one."""
    import cvxpy as cp  # takes half a second, which planning without timing need not wait for

    b = cp.Variable(len(bound))
    problem = cp.Problem(cp.Maximize(cp.sum(b)), [rows @ b <= 1.0, b >= 0.0, b <= bound])
    options = {"primal_feasibility_tolerance": TOLERANCE, "dual_feasibility_tolerance": TOLERANCE}
    try:
        with warnings.catch_warnings():  # of inaccurate solutions: limits are checked afterwards
            warnings.simplefilter("ignore", UserWarning)
            problem.solve(solver=cp.HIGHS, highs_options=options)
    except cp.SolverError:
        return False, np.full(b.shape, np.nan)
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or b.value is None:
        return False, np.full(b.shape, np.nan)
    return True, np.asarray(b.value)


def _why_not(curve: SmoothCurve, limits: JointLimits, shape: np.ndarray) -> str:
    """The joint and the inner grid point with the lowest speed."""
    grid = curve.grid
    k = 1 + int(np.argmin(shape[1:-1]))
    by_velocity = (np.abs(curve.spline(grid[k], 1)) / limits.velocity) ** 2
    by_acceleration = np.abs(curve.spline(grid[k], 2)) / limits.acceleration
    j = int(np.argmax(np.maximum(by_velocity, by_acceleration)))
    kind = "velocity" if by_velocity[j] > by_acceleration[j] else "acceleration"
    return (
        f"the path cannot be timed: joint {limits.joint_names[j]!r}, {kind} limit "
        f"{getattr(limits, kind)[j]:.3g}, holds it up at {grid[k]:.3f} of {curve.length:.3f} rad "
        f"(waypoint "
        f"{curve.waypoint(grid[k])}); raise that limit, or plan a path without that turn"
    )
