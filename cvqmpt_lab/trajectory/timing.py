"""Time a path: a fast motion within the limits of velocity, acceleration, jerk and effort.

`squared_speeds` computes the motion s(t) along a curve q(s) with rounded corners. Its squared
speeds b = (ds/dt)^2 have the largest sum within the limits of velocity and acceleration:

    q' = dq/ds sqrt(b),    q'' = d2q/ds2 b + dq/ds a,    a = (db/ds) / 2.

The path acceleration a of this motion jumps. The motion averaged over a window of T seconds,

    S(t) = 1/T int_{t-T}^{t} s(u) du,    S''(t) = (s'(t) - s'(t - T)) / T,

has a continuous acceleration and takes T longer. The window is the one with the shortest motion
within the jerk limits. If the averaged motion exceeds a limit, all of it is slowed down.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PPoly

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.geometry.polyline import step_lengths
from cvqmpt_lab.robot.dynamics import Dynamics
from cvqmpt_lab.robot.frame_speeds import FrameSpeeds
from cvqmpt_lab.robot.robot import SLOW_SPEED, JointLimits
from cvqmpt_lab.trajectory.squared_speeds import SmoothCurve, smooth_curve, squared_speeds
from cvqmpt_lab.trajectory.trajectory import Trajectory, extremes, quintic


@dataclass(frozen=True)
class TimingSettings:
    """Settings of `time_path`."""

    speed: float = SLOW_SPEED  # factor on velocity and acceleration limits, above 0 and at most 1
    deviation: float = 1e-3  # largest distance from the polyline at rounded corners [rad]
    duration: float | None = None  # of the motion [s]; None: as short as the limits allow


def time_path(
    waypoints: np.ndarray,
    limits: JointLimits,
    settings: TimingSettings | None = None,
    check: Callable[[Trajectory], Sequence[str]] | None = None,
    dynamics: Dynamics | None = None,
    frames: FrameSpeeds | None = None,
) -> Trajectory:
    """Compute a fast motion along waypoints within the limits, at rest at both ends.

    Args:
        waypoints: (m, n) [rad or m]; neighbours differ.
        limits: velocity, acceleration, jerk and effort limits of the n joints.
        settings: speed factor and largest deviation at corners; None: the defaults.
        check: returns the faults of a motion, see `motion_check.certified_motion`. As long as
            there are any, the deviation is halved, at most five times.
        dynamics: dynamics of the arm and its loads; None: efforts are not limited.
        frames: limits of the speeds of frames, which the speed factor leaves as they are; None:
            they are not limited.

    Raises InvalidInputError for invalid waypoints and for a path that cannot be timed; the message
    then names the joint and the limit.
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
    for k in range(6):
        curve = smooth_curve(states, settings.deviation / 2**k)
        squared = squared_speeds(curve, limits, dynamics, frames)
        motion = _trajectory(curve, squared, limits, dynamics, frames)
        if settings.duration is not None:
            motion = _lasting(motion, settings.duration)
        reasons = check(motion) if check else ()
        if not reasons:
            return motion
    raise InvalidInputError(
        f"the path with rounded corners is refused even {curve.deviation:.1e} rad from it: "
        f"{'; '.join(reasons)}; plan with another seed"
    )


def _lasting(motion: Trajectory, duration: float) -> Trajectory:
    """Return a motion at a lower speed, so that it takes `duration` [s]; refuse a higher one."""
    if not duration >= motion.duration:
        raise InvalidInputError(
            f"the motion takes {motion.duration:.4f} s at least, {duration:g} s is too short: give "
            "a longer duration or higher limits (or a higher speed factor on them)"
        )
    slower = duration / motion.duration
    # controllers read whole nanoseconds
    times = np.round(slower * motion.times, 9)
    at = np.minimum(times / slower, motion.duration)
    velocities = motion.curve(at, 1) / slower
    accelerations = motion.curve(at, 2) / slower**2
    velocities[[0, -1]] = accelerations[[0, -1]] = 0.0
    return replace(
        motion,
        times=times,
        positions=motion.curve(at),
        velocities=velocities + 0.0,  # + 0.0 turns -0.0 into 0.0
        accelerations=accelerations + 0.0,
    )


def _checked_waypoints(waypoints: np.ndarray) -> np.ndarray:
    """Return the waypoints (m, n) as floats; refuse m < 2, nan, inf and equal neighbours."""
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
    for k in np.flatnonzero(step_lengths(states) < 1e-9):
        raise InvalidInputError(f"waypoint {k + 1} repeats waypoint {k}: leave one of the two out")
    return states


def _trajectory(
    curve: SmoothCurve,
    squared: np.ndarray,
    limits: JointLimits,
    dynamics: Dynamics | None,
    frames: FrameSpeeds | None,
) -> Trajectory:
    """The averaged motion with the best window: from 4 ms on, doubled while the motion is shorter.

    Without jerk limits the window is 0.25 ms, which makes the accelerations continuous.
    """
    # s(t) of the fastest motion
    speeds, steps = np.sqrt(squared), np.diff(curve.grid)
    times = np.concatenate([[0.0], np.cumsum(2.0 * steps / (speeds[1:] + speeds[:-1]))])
    fastest = PPoly([np.diff(squared) / (4.0 * steps), speeds[:-1], curve.grid[:-1]], times)
    window = 0.00025 if limits.jerk is None else 0.004
    # `_average` needs steps above 0.01 windows; those of tiny motions are shorter
    longest = float(np.diff(times).max())
    if longest <= 0.01 * window:
        window = 50.0 * longest
    motion = _averaged(curve, fastest, limits, dynamics, frames, window)
    while limits.jerk is not None and longest > 0.02 * window:
        window *= 2.0
        other = _averaged(curve, fastest, limits, dynamics, frames, window)
        if other.duration >= motion.duration:
            break
        motion = other
    return motion


def _averaged(
    curve: SmoothCurve,
    fastest: PPoly,
    limits: JointLimits,
    dynamics: Dynamics | None,
    frames: FrameSpeeds | None,
    window: float,
) -> Trajectory:
    """The fastest motion s(t) averaged over a window [s], slowed down until it keeps the limits."""
    average = _average(fastest, window)
    # times at the knots, where the third derivative of the curve jumps, by Newton's method; it
    # starts from linear interpolation
    knots = np.unique(curve.spline.t)[1:-1]
    passed = np.interp(knots, average(average.x)[:, 0], average.x)
    for _ in range(4):
        passed -= (average(passed)[:, 0] - knots) / average.derivative()(passed)[:, 0]
    moments = _apart(np.concatenate([average.x, passed]), 0.01 * window)
    motion = _along(curve, average, moments, limits.joint_names)
    slower = _excess(motion, limits)
    if dynamics is not None:
        slower = max(slower, _excess_of_efforts(motion, limits, dynamics))
    if frames is not None:
        slower = max(slower, _excess_of_frames(motion, frames))
    return _along(curve, average, moments, limits.joint_names, slower)


def _average(s: PPoly, window: float) -> PPoly:
    """S(t) (1,), the mean of s(t) over the window [s] before t; quintics without jumps of S''."""
    first, last = s.x[[0, -1]]
    still = np.array([[0.0], [0.0], [s(last)]])
    rest = PPoly(np.hstack([0.0 * still, s.c, still]), [first - window, *s.x, last + window])
    times = _apart(np.concatenate([s.x, s.x + window]), 0.01 * window)
    speed = (rest(times) - rest(times - window)) / window
    ds = rest.derivative()
    rate = (ds(times) - ds(times - window)) / window
    speed[[0, -1]] = rate[[0, -1]] = 0.0
    # a sum of gains: a difference of integrals loses digits that the jerk of short pieces needs
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
    """The motion q(S(t / slower)); moments (k,) [s] of S become times in whole nanoseconds."""
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
    """Sorted times without those that follow another by at most `least` [s]; the last one stays."""
    ordered = np.sort(times)
    kept = ordered[np.append(True, np.diff(ordered) > least)]
    kept[-1] = ordered[-1]
    return kept


def _excess(motion: Trajectory, limits: JointLimits, spare: float = 1e-6) -> float:
    """Factor on the times, at least 1, so that the motion keeps velocity, acceleration and jerk."""
    slower = 1.0
    for order, limit in enumerate((limits.velocity, limits.acceleration, limits.jerk), start=1):
        if limit is not None:
            most = float((np.abs(extremes(motion.curve, order)[1]) / limit).max())
            slower = max(slower, (1.0 + spare) * most ** (1.0 / order))
    return slower


def _excess_of_frames(
    motion: Trajectory, frames: FrameSpeeds, spare: float = 1e-4, period: float = 1e-3
) -> float:
    """Factor on the times, at least 1, so that frames keep their speeds every `period` [s]."""
    curve = motion.curve
    times = np.union1d(curve.x, np.arange(0.0, curve.x[-1], period))
    return max(1.0, (1.0 + spare) * float(frames.shares(curve(times), curve(times, 1)).max()))


def _excess_of_efforts(
    motion: Trajectory,
    limits: JointLimits,
    dynamics: Dynamics,
    spare: float = 1e-3,
    period: float = 1e-3,
) -> float:
    """Factor c on the times, at least 1, so that the motion keeps effort and torque rate.

    With c times the duration the efforts are (tau - g) / c^2 + g, and their rates are at most
    (tau - g)' / c^3 + g'. Efforts are computed at the motion's points, rates every `period` [s].
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
        left = np.maximum((1.0 - spare) * limit - np.sign(moving) * weights, spare * limit)
        slower = max(slower, float((np.abs(moving) / left).max()) ** (1.0 / order))
    return slower
