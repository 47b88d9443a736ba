"""Time a path: a fast motion within the limits of velocity, acceleration, jerk and effort.

`squared_speeds` computes the motion s(t) along a curve q(s) with rounded corners. Its squared
speeds b = (ds/dt)^2 have the largest sum within the limits of velocity and acceleration:

    q' = dq/ds sqrt(b),    q'' = d2q/ds2 b + dq/ds a,    a = (db/ds) / 2.

The path acceleration a of this motion jumps. The motion averaged over a window of T seconds,

    S(t) = 1/T int_{t-T}^{t} s(u) du,    S''(t) = (s'(t) - s'(t - T)) / T,

has a continuous acceleration and takes T longer. The window is the one with the shortest motion
within the jerk limits. If the averaged motion exceeds a limit, all of it is slowed down.

At an end with a given velocity, s(t) has a constant speed for T / 2, and goes on with it outside of
the path. S(t) then passes this end with that speed and without acceleration, so the motion begins
or ends there. Its speed at such an end is chosen so large that slowing makes it the given one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.interpolate import PPoly

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.polyline import step_lengths
from cvqmpt_lab.features.motion.frame_speeds import FrameSpeeds
from cvqmpt_lab.features.motion.linear_program import cvxpy_solver
from cvqmpt_lab.features.motion.squared_speeds import (
    HeldSpeed,
    SmoothCurve,
    smooth_curve,
    squared_speeds,
)
from cvqmpt_lab.features.motion.trajectory import Trajectory, extremes, quintic
from cvqmpt_lab.robot.dynamics import Dynamics
from cvqmpt_lab.robot.robot import SLOW_SPEED, JointLimits


@dataclass(frozen=True)
class TimingSettings:
    """Settings of `time_path`."""

    speed: float = SLOW_SPEED  # factor on velocity and acceleration limits, above 0 and at most 1
    deviation: float = 1e-3  # largest distance from the polyline at rounded corners [rad]
    duration: float | None = None  # of the motion [s]; None: as short as the limits allow
    # (n,) of the joints where the motion begins, along the path [rad/s or m/s]; None: at rest
    start_velocity: Sequence[float] | None = None
    end_velocity: Sequence[float] | None = None  # the same where it ends
    solver: str = "highs"  # of the linear program, or "cvxpy", see `linear_program.greatest`

    def __post_init__(self) -> None:
        cvxpy_solver(self.solver)  # refuses one that is not installed before anything is planned


def time_path(
    waypoints: np.ndarray,
    limits: JointLimits,
    settings: TimingSettings | None = None,
    check: Callable[[Trajectory], Sequence[str]] | None = None,
    dynamics: Dynamics | None = None,
    frames: FrameSpeeds | None = None,
) -> Trajectory:
    """Compute a fast motion along waypoints within the limits, with given velocities at its ends.

    Args:
        waypoints: (m, n) [rad or m]; neighbours differ.
        limits: velocity, acceleration, jerk and effort limits of the n joints.
        settings: speed factor, largest deviation at corners, duration and velocities at the ends;
            None: the defaults, at rest at both ends.
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
    ends = (
        _speed_along("start", states[1] - states[0], settings.start_velocity, limits),
        _speed_along("end", states[-1] - states[-2], settings.end_velocity, limits),
    )
    limits = limits.scaled(settings.speed)
    reasons: Sequence[str] = ()
    for k in range(6):
        curve = smooth_curve(states, settings.deviation / 2**k)
        timer = _Timer(curve, limits, dynamics, frames, settings.solver)
        motion = timer.shortest(*ends)
        if settings.duration is not None:
            motion = timer.lasting(motion, settings.duration, *ends)
        reasons = check(motion) if check else ()
        if not reasons:
            return motion
    raise InvalidInputError(
        f"the path with rounded corners is refused even {curve.deviation:.1e} rad from it: "
        f"{'; '.join(reasons)}; plan with another seed"
    )


def _speed_along(
    what: str, step: np.ndarray, velocity: Sequence[float] | None, limits: JointLimits
) -> float:
    """Return the speed [rad/s] along a path at one of its ends; refuse another direction.

    Args:
        what: "start" or "end".
        step: (n,) direction of the path there [rad or m].
        velocity: given velocity (n,) of the joints [rad/s or m/s]; None: at rest.
        limits: limits of the joints.
    """
    if velocity is None:
        return 0.0
    given = np.array(velocity, dtype=float)
    if given.shape != step.shape or not np.isfinite(given).all():
        raise InvalidInputError(
            f"{what} velocity has {given.size} values: give {len(step)} finite numbers, one each "
            f"for {', '.join(limits.joint_names)}"
        )
    direction, small = step / np.linalg.norm(step), 5e-4 * limits.velocity
    speed = float(direction @ given)
    if (np.abs(given) <= small).all():
        return 0.0
    if speed > 0.0 and (np.abs(given - speed * direction) <= small).all():
        return speed
    angle = np.degrees(np.arccos(np.clip(speed / np.linalg.norm(given), -1.0, 1.0)))
    cure = "let the arm stop first"
    if speed > 0.0:
        along = " ".join(f"{x:.4g}" for x in speed * direction + 0.0)
        cure = f"give one along it, such as {along!r}"
    raise InvalidInputError(
        f"the {what} velocity is {angle:.2g} degrees off the direction of the path there: {cure}, "
        f"or a path that {what}s in that direction"
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


class _Timer:
    """Motions along one curve within the limits."""

    def __init__(
        self,
        curve: SmoothCurve,
        limits: JointLimits,
        dynamics: Dynamics | None,
        frames: FrameSpeeds | None,
        solver: str,
    ) -> None:
        self._curve, self._limits, self._dynamics, self._frames = curve, limits, dynamics, frames
        self._solver = solver
        self._fastest = cache(self._fastest_of)

    def shortest(self, begin: float, end: float) -> Trajectory:
        """The averaged motion with the best window: from 4 ms on, doubled while it is shorter.

        Without jerk limits the window is 0.25 ms, which makes the accelerations continuous.

        begin, end: speeds at the ends [rad/s].
        """
        jerk = self._limits.jerk
        window = 0.00025 if jerk is None else 0.004
        # `_average` needs steps above 0.01 windows; those of tiny motions are shorter
        longest = float(np.diff(self._fastest(*_held(begin, end, window)).x).max())
        if longest <= 0.01 * window:
            window = 50.0 * longest
        motion = self._averaged(begin, end, window)
        while jerk is not None and longest > 0.02 * window:
            window *= 2.0
            try:
                other = self._averaged(begin, end, window)
            except InvalidInputError:  # the ends are too close for so long a window
                break
            if other.duration >= motion.duration:
                break
            motion = other
        return motion

    def lasting(self, motion: Trajectory, duration: float, begin: float, end: float) -> Trajectory:
        """Return a motion that takes `duration` [s], with the same speeds at its ends.

        Args:
            motion: the shortest motion.
            duration: duration [s]; shorter ones are refused.
            begin: speed where it begins [rad/s].
            end: speed where it ends [rad/s].
        """
        if not duration >= motion.duration:
            raise InvalidInputError(
                f"the motion takes {motion.duration:.4f} s at least, {duration:g} s is too short: "
                "give a longer duration or higher limits (or a higher speed factor on them)"
            )
        slower = duration / motion.duration
        while begin or end:
            # a motion that is `slower` times faster at its ends is shorter
            try:
                motion = self.shortest(slower * begin, slower * end)
            except InvalidInputError as error:
                raise InvalidInputError(
                    f"no motion of {duration:g} s keeps the velocities at its ends: {error}"
                ) from error
            before, slower = slower, duration / motion.duration
            if abs(slower - before) <= 1e-6 * before:
                break
        return _slowed(motion, duration)

    def _fastest_of(self, begin: HeldSpeed, end: HeldSpeed) -> PPoly:
        """S(t) (1,) of the fastest motion, with speeds that are held at its ends."""
        curve = self._curve
        if begin.speed or end.speed:
            held = begin.distance, curve.grid[-1] - end.distance
            curve = replace(curve, grid=np.union1d(curve.grid, held))
        squared = squared_speeds(
            curve, self._limits, self._dynamics, self._frames, (begin, end), solver=self._solver
        )
        speeds, steps = np.sqrt(squared), np.diff(curve.grid)
        times = np.concatenate([[0.0], np.cumsum(2.0 * steps / (speeds[1:] + speeds[:-1]))])
        return PPoly([np.diff(squared) / (4.0 * steps), speeds[:-1], curve.grid[:-1]], times)

    def _averaged(self, begin: float, end: float, window: float) -> Trajectory:
        """The fastest motion averaged over a window [s], slowed down until it keeps the limits."""
        curve, limits, slower = self._curve, self._limits, 1.0
        while True:
            ends = slower * begin, slower * end
            average = _average(self._fastest(*_held(*ends, window)), window, *ends)
            # times at the knots, where the third derivative of the curve jumps, by Newton's
            # method; it starts from linear interpolation
            knots = np.unique(curve.spline.t)[1:-1]
            passed = np.interp(knots, average(average.x)[:, 0], average.x)
            for _ in range(4):
                passed -= (average(passed)[:, 0] - knots) / average.derivative()(passed)[:, 0]
            moments = _apart(np.concatenate([average.x, passed]), 0.01 * window)
            motion = _along(curve, average, moments, limits.joint_names, ends)
            excess = _excess(motion, limits)
            if self._dynamics is not None:
                excess = max(excess, _excess_of_efforts(motion, limits, self._dynamics))
            if self._frames is not None:
                excess = max(excess, _excess_of_frames(motion, self._frames))
            if not any(ends):
                return _along(curve, average, moments, limits.joint_names, ends, excess)
            if excess <= slower:
                return _along(curve, average, moments, limits.joint_names, ends, slower)
            slower = 1.0001 * excess


def _held(begin: float, end: float, window: float) -> tuple[HeldSpeed, HeldSpeed]:
    """Return the speeds at the ends with the distances of half a window [s] at these speeds."""
    return HeldSpeed(begin, 0.5 * window * begin), HeldSpeed(end, 0.5 * window * end)


def _slowed(motion: Trajectory, duration: float) -> Trajectory:
    """Return a motion at a lower speed, so that it takes `duration` [s]."""
    slower = duration / motion.duration
    # controllers read whole nanoseconds
    times = np.round(slower * motion.times, 9)
    at = np.minimum(times / slower, motion.duration)
    velocities = motion.curve(at, 1) / slower
    accelerations = motion.curve(at, 2) / slower**2
    velocities[[0, -1]] = motion.velocities[[0, -1]] / slower
    accelerations[[0, -1]] = 0.0
    return replace(
        motion,
        times=times,
        positions=motion.curve(at),
        velocities=velocities + 0.0,  # + 0.0 turns -0.0 into 0.0
        accelerations=accelerations + 0.0,
    )


def _average(s: PPoly, window: float, begin: float, end: float) -> PPoly:
    """S(t) (1,), the mean of s(t) over a window before t; quintics without jumps of S''.

    Args:
        s: s(t) from t = 0 on [rad]; before, and after its end, it has constant speeds.
        window: the window [s].
        begin: the speed before [rad/s].
        end: the speed after the end [rad/s].
    """
    first, last = s.x[[0, -1]]
    before = np.array([[0.0], [begin], [-begin * window]])
    after = np.array([[0.0], [end], [s(last)]])
    whole = PPoly(np.hstack([before, s.c, after]), [first - window, *s.x, last + window])
    # S(t) passes an end with a speed half a window later than s(t)
    ends = first + (0.5 * window if begin else 0.0), last + (0.5 if end else 1.0) * window
    times = _apart(np.clip(np.concatenate([s.x, s.x + window]), *ends), 0.01 * window)
    speed = (whole(times) - whole(times - window)) / window
    ds = whole.derivative()
    rate = (ds(times) - ds(times - window)) / window
    speed[[0, -1]], rate[[0, -1]] = (begin, end), 0.0
    # a sum of gains: a difference of integrals loses digits that the jerk of short pieces needs
    h = np.diff(times)
    gains = h * (speed[:-1] + speed[1:]) / 2.0 + h**2 * (rate[:-1] - rate[1:]) / 12.0
    place = np.concatenate([[0.0], np.cumsum(gains)])
    place *= s(last) / place[-1]
    return quintic(times - ends[0], place[:, None], speed[:, None], rate[:, None])


def _along(
    curve: SmoothCurve,
    average: PPoly,
    moments: np.ndarray,
    joint_names: tuple[str, ...],
    ends: tuple[float, float],
    slower: float = 1.0,
) -> Trajectory:
    """The motion q(S(t / slower)); times are whole nanoseconds.

    Args:
        curve: q(s).
        average: S(t) (1,) [rad].
        moments: (k,) times of S that become times of the motion [s].
        joint_names: names of the n joints.
        ends: speeds of S at its begin and end [rad/s].
        slower: factor on the times.
    """
    times = np.round(slower * moments, 9)
    at = np.minimum(times / slower, average.x[-1])
    place, speed, rate = (average.derivative(order)(at) / slower**order for order in range(3))
    speed[[0, -1], 0], rate[[0, -1]] = np.array(ends) / slower, 0.0
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
