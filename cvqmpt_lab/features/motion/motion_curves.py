"""The curves q(t) of a motion between its points, and their straight pieces.

With velocities it is the cubic through positions and velocities, as controllers interpolate; with
accelerations a controller may interpolate by the quintic through these, too. With positions alone
it is the cubic spline, or straight lines, as the trajectory controller of ROS 2 interpolates. All
of them are checked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.polyline import cut, step_lengths
from cvqmpt_lab.features.motion.trajectory import Motion
from cvqmpt_lab.robot.robot import Robot

if TYPE_CHECKING:
    from scipy.interpolate import PPoly  # half a second to import, needed for trajectories alone


def curves_of(
    motion: Motion,
    start_velocity: np.ndarray | None = None,
    end_velocity: np.ndarray | None = None,
    part: bool = False,
    moving: bool = False,
) -> tuple[dict[str, PPoly], float]:
    """Return the curves of a motion with times by name, and their largest distance.

    With h the length of a piece, s = t / h its share and d0, d1 the given accelerations less the
    cubic's at its ends: quintic - cubic = h^2 / 2 (d0 s^2 (1 - s)^3 + d1 s^3 (1 - s)^2), at most
    h^2 / 32 max(|d0|, |d1|).

    Args:
        motion: positions (m, n), times, perhaps velocities and accelerations.
        start_velocity: (n,) of a spline through positions alone [rad/s or m/s]; None: 0.
        end_velocity: the same at its end.
        part: whether an end without a velocity may have any.
        moving: whether a begin without a velocity may have any.
    """
    assert motion.times is not None
    q, v, a = motion.positions, motion.velocities, motion.accelerations
    wanted = (("time", motion.times, q.shape[:1]), ("velocity", v, q.shape))
    for what, values, shape in (*wanted, ("acceleration", a, q.shape)):
        if values is not None and np.shape(values) != shape:
            raise InvalidInputError(
                f"values of {what} have shape {np.shape(values)}; positions of {q.shape} need "
                f"{shape}"
            )
        if values is not None and not np.isfinite(values).all():
            raise InvalidInputError(f"a value of {what} is not finite")
    _check_times(motion.times)
    from scipy.interpolate import CubicSpline, PPoly

    times = motion.times - motion.times[0]
    if v is None:
        still = np.zeros(q.shape[1])
        first, last = (still if v is None else v for v in (start_velocity, end_velocity))
        # at an end with any velocity, the second derivative is 0: a natural spline
        begin = (2, still) if moving and start_velocity is None else (1, first)
        end = (2, still) if part and end_velocity is None else (1, last)
        spline = CubicSpline(times, q, bc_type=(begin, end))
        slopes = np.diff(q, axis=0) / np.diff(times)[:, None]
        lines = PPoly(np.array([slopes, q[:-1]]), times)
        return {"spline": PPoly(spline.c, times), "linear": lines}, np.inf
    h = np.diff(times)[:, None]
    with np.errstate(all="ignore"):  # overflow is refused by `straight_moments`
        mean = np.diff(q, axis=0) / h
        begins = (6.0 * mean - 4.0 * v[:-1] - 2.0 * v[1:]) / h
        ends = (2.0 * v[:-1] + 4.0 * v[1:] - 6.0 * mean) / h
        d0, d1 = np.zeros((2, *mean.shape)) if a is None else (a[:-1] - begins, a[1:] - ends)
        none = np.zeros_like(mean)
        cubic = np.array([none, none, (ends - begins) / (6.0 * h), 0.5 * begins, v[:-1], q[:-1]])
        factors = (
            (d1 - d0) / h**3,
            (3.0 * d0 - 2.0 * d1) / h**2,
            (d1 - 3.0 * d0) / h,
            d0,
            none,
            none,
        )
        curves = {
            "quintic": PPoly(cubic + 0.5 * np.array(factors), times),
            "cubic": PPoly(cubic, times),
        }
        gap = float((h**2 / 32.0 * np.maximum(np.abs(d0), np.abs(d1))).max())
        # if they are closer than a nanometre or nanoradian, one of them is checked
        if gap <= 1e-9:
            del curves["quintic" if a is None else "cubic"]
        return curves, gap


def _check_times(times: np.ndarray, longest: float = 1e5) -> None:
    """Refuse times (m,) of a motion that do not increase, or are no seconds.

    longest: duration beyond which they cannot be meant as seconds [s].
    """
    if len(times) < 2:
        raise InvalidInputError("a trajectory of one point does not move: give two or more")
    if times[0] < 0.0:
        raise InvalidInputError(f"it begins at {times[0]:g} s: times begin at 0 or later")
    steps = np.diff(times)
    if not (steps > 0.0).all():
        k = int((steps <= 0.0).argmax())
        what = "repeats" if steps[k] == 0.0 else "is before"
        raise InvalidInputError(
            f"time {times[k + 1]:.9g} s of point {k + 1} {what} that of point {k}: times must "
            "increase; leave one of two equal points out, or sort them"
        )
    if steps.sum() > longest:
        unit = "nanoseconds" if steps.sum() > 1e3 * longest else "milliseconds or microseconds"
        raise InvalidInputError(
            f"the motion lasts {steps.sum():.3g} s: are its times in {unit}? Give seconds, or call "
            "the column of a table time_ms, time_us or time_ns"
        )


def refuse_other_units(motion: Motion, curve: PPoly, robot: Robot, least: float = 0.01) -> None:
    """Refuse a trajectory whose times are probably no seconds.

    With positions alone, these are times with which a motion uses less than `least` of every limit
    of velocity and acceleration. With velocities, these are times with which they would move the
    joints about 10^3, 10^6 or 10^9 times as far as the positions say.

    Args:
        motion: the trajectory.
        curve: its first curve.
        robot: the robot with the limits of its joints.
        least: see above.
    """
    assert motion.times is not None
    names = ("milliseconds", "ms"), ("microseconds", "us"), ("nanoseconds", "ns")
    if motion.velocities is not None:
        factor = _moved_too_far(motion.times, motion.positions, motion.velocities)
        said = f"its velocities would move the joints {factor:.2g} times as far as its positions do"
        cure = ""
    else:
        factor = 0.0 if motion.in_seconds else _too_slow(curve, robot, least)
        said = f"no joint uses more than {1.0 / max(factor, 1.0):.2g} of its velocity limit"
        cure = (
            ", or call the column of the table time_{}; if they are seconds, call it time_s (in "
            "Python: Motion(..., in_seconds=True))"
        )
    if factor:
        unit, short = names[int(factor > 1e5) + int(factor > 1e8)]
        raise InvalidInputError(
            f"in {np.ptp(motion.times):.4g} s {said}: are its times in {unit}? Give seconds"
            f"{cure.format(short)}"
        )


def _too_slow(curve: PPoly, robot: Robot, least: float) -> float:
    """Return 1 over the used share of the velocity limits; 0.0 if a limit is used by `least`."""
    limits = robot.joint_limits
    share = float((np.abs(rates(curve, 1)) / limits.velocity).max())
    bent = float((np.abs(rates(curve, 2)) / limits.acceleration).max())
    return 1.0 / share if 0.0 < share < least and bent < least else 0.0


def _moved_too_far(times: np.ndarray, positions: np.ndarray, velocities: np.ndarray) -> float:
    """Return how often the way by velocities (m, n) is that by positions (m, n).

    It is 0.0 unless it is about 10^3, 10^6 or 10^9.
    """
    speeds = np.abs(velocities)
    far = float((0.5 * np.diff(times)[:, None] * (speeds[:-1] + speeds[1:])).sum())
    moved = float(np.abs(np.diff(positions, axis=0)).sum())
    factor = far / moved if moved > 0.0 else 0.0
    return factor if any(x / 3.0 < factor < 3.0 * x for x in (1e3, 1e6, 1e9)) else 0.0


def rates(curve: PPoly, order: int) -> np.ndarray:
    """Return a derivative [rad/s, rad/s^2] at 33 points of every piece (33, k, n), or inf, nan."""
    after = np.linspace(0.0, 1.0, 33)[:, None, None] * np.diff(curve.x)[:, None]
    with np.errstate(all="ignore"):
        return np.polyval(curve.derivative(order).c, after)


def straight_moments(
    curve: PPoly,
    robot: Robot,
    flat: float,
    longest: float = 0.1,
    hardest: float = 1e3,
    most_pieces: int = 100_000,
) -> np.ndarray:
    """Return times (m,) between which joints move nearly straight: |q''| dt^2 / 8 <= flat.

    Args:
        curve: q(t).
        robot: the robot with the limits of its joints.
        flat: largest distance from straight [rad or m].
        longest: largest distance between the states of a piece's ends [rad or m].
        hardest: if most pieces accelerate by more than this multiple of a limit, the motion is
            refused: units must be wrong.
        most_pieces: largest number of times.
    """
    limits = robot.joint_limits
    # between these points a cubic is at most 1.2 % larger (Markov: |p''| <= 24 max |p| on [-1, 1])
    most = 1.02 * np.abs(rates(curve, 2)).max(axis=0)
    hard = ~(most <= hardest * limits.acceleration).all(axis=1)
    if np.mean(hard) > 0.5 or not np.isfinite(most).all():
        worst, joint = np.unravel_index(int(np.argmax(most / limits.acceleration)), most.shape)
        unit = robot.unit_of(int(joint), "rad/s^2")
        raise InvalidInputError(
            f"from point {worst} on {limits.joint_names[joint]} accelerates by "
            f"{most[worst, joint]:.3g} {unit}, its limit is {limits.acceleration[joint]:.3g}: "
            "too much to follow; are units right?"
        )
    spans = np.diff(curve.x)
    pieces = np.ceil(spans * np.sqrt(most.max(axis=1) / (8.0 * flat)))
    # where joints move straight, a piece is at most as long as a certified step
    pieces = np.maximum(pieces, np.ceil(step_lengths(curve(curve.x)) / longest)).clip(min=1.0)
    if not pieces.sum() <= most_pieces:
        raise InvalidInputError(
            f"a motion of {spans.sum():.3g} s that would be followed in {pieces.sum():.3g} "
            f"straight pieces; at most {most_pieces} are: certify it in parts; are times in "
            "seconds?"
        )
    return cut(curve.x[:, None], pieces.astype(int))[:, 0]
