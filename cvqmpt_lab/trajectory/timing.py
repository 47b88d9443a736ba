"""Path in, trajectory out: `time_path`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.limits import SLOW, JointLimits
from cvqmpt_lab.trajectory.curve import SmoothCurve, checked_waypoints, smooth_curve
from cvqmpt_lab.trajectory.speed_profile import squared_speeds
from cvqmpt_lab.trajectory.trajectory import Trajectory

CHECKS = 5  # places an interval, ends included, at which limits are looked at again
TIGHTENINGS = 3  # how often a refused curve is drawn closer to the path, each time to a quarter


@dataclass(frozen=True)
class TimingSettings:
    """How a path is timed."""

    speed: float = SLOW
    """Factor on velocity and acceleration limits, above 0 and at most 1 (full speed)."""
    deviation: float = 1e-3
    """How far the motion may leave the polyline to round its corners [rad]."""


def time_path(
    waypoints: np.ndarray,
    limits: JointLimits,
    settings: TimingSettings | None = None,
    check: Callable[[np.ndarray], Sequence[str]] | None = None,
) -> Trajectory:
    """The fastest motion along waypoints (m, n) [rad] within the limits, at rest at both ends.

    check: reasons against states (k, n) of the rounded path, none when they are fine, such as
        ``lambda states: certify(problem, JointPath(states)).reasons``. While there are any, corners are cut less.

    Raises
    ------
    InvalidInputError: waypoints, limits or settings that cannot be used; a path that stays refused.
    """
    settings = settings or TimingSettings()
    states = checked_waypoints(waypoints)
    if states.shape[1] != len(limits.joint_names):
        raise InvalidInputError(
            f"waypoints have {states.shape[1]} joints, the limits {len(limits.joint_names)}: "
            f"{', '.join(limits.joint_names)}"
        )
    limits = limits.scaled(settings.speed)
    curve = _accepted_curve(states, settings.deviation, check)
    return _trajectory(curve, squared_speeds(curve, limits), limits)


def _accepted_curve(
    states: np.ndarray, deviation: float, check: Callable[[np.ndarray], Sequence[str]] | None
) -> SmoothCurve:
    reasons: Sequence[str] = ()
    for k in range(TIGHTENINGS + 1):
        curve = smooth_curve(states, deviation / 4**k)
        reasons = check(curve.spline(curve.grid)) if check else ()
        if not reasons:
            return curve
    raise InvalidInputError(
        f"the path with rounded corners is refused even {curve.deviation:.1e} rad from it: "
        f"{'; '.join(reasons)}; plan with another seed"
    )


def _trajectory(curve: SmoothCurve, squared: np.ndarray, limits: JointLimits) -> Trajectory:
    """Joint states on the curve's grid, slowed down by the little that limits are exceeded between its points."""
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
    """Factor (1 or more) on time that brings every joint within its limits throughout: 1.002 is a large one."""
    grid = curve.grid
    share = np.linspace(0.0, 1.0, CHECKS)
    s = (grid[:-1, None] + share * np.diff(grid)[:, None]).ravel()
    b = (squared[:-1, None] + share * np.diff(squared)[:, None]).ravel()
    a = np.repeat(path_acceleration, CHECKS)
    first, second = curve.spline(s, 1), curve.spline(s, 2)
    velocity = np.abs(first) * np.sqrt(b)[:, None] / limits.velocity
    acceleration = np.abs(second * b[:, None] + first * a[:, None]) / limits.acceleration
    return float(max(1.0, velocity.max(), np.sqrt(acceleration.max())))
