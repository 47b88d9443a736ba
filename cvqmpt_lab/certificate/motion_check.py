"""Check of a motion before it is executed: limits, start, rest at both ends, certificate.

Between its points a trajectory is the cubic through positions and velocities, as controllers
interpolate. If accelerations are given, a controller may interpolate by the quintic through these,
too: then both curves are checked. Jerk is that of the quintic, also where it is a cubic; without
accelerations it is not judged: between cubics they jump.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.certificate.certificate import Certificate, Fault, FaultKind, certify
from cvqmpt_lab.collision.carried import reach_with
from cvqmpt_lab.geometry.polyline import cut, numbered_parts, step_lengths
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import JointLimits
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.trajectory.trajectory import Motion, Trajectory, bounds, extremes

if TYPE_CHECKING:
    from scipy.interpolate import PPoly  # half a second to import, needed for trajectories alone

    from cvqmpt_lab.trajectory.timing import TimingSettings

# largest distance of a joint from the straight pieces that are certified in its place [rad or m]
CURVE_TOLERANCE = 1e-6
# share by which limits may be exceeded: the cubics through points of `time_path` do so by 0.5 %
LIMIT_OVERSHOOT = {
    FaultKind.VELOCITY: 1e-3,
    FaultKind.ACCELERATION: 0.01,
    FaultKind.JERK: 0.01,
    FaultKind.EFFORT: 0.01,
    FaultKind.TORQUE_RATE: 0.01,
}


class DryRun(NamedTuple):
    """Certificate of a path or trajectory, with the faults of velocities, efforts and the like."""

    certificate: Certificate  # places of faults are numbers of `states`
    # (m, n) the certified states; of a trajectory, within CURVE_TOLERANCE of it [rad or m]
    states: np.ndarray
    times: np.ndarray | None = None  # (m,) of the states [s], or None for a path
    # largest distance of the robot's points from those on straight pieces between the states
    deviation_m: float = 0.0
    curve: str = ""  # "cubic" or "quintic", the worse one of those checked; "" for a path


def certified_motion(
    problem: PlanningProblem, path: JointPath, settings: TimingSettings | None = None
) -> Trajectory:
    """Compute the fastest certified motion along a path.

    The quintics between its points are certified, and the cubics. Raises InvalidInputError if the
    path does not move, the robot has no acceleration limits, or no motion is certified.
    """
    from cvqmpt_lab.trajectory.timing import time_path  # half a second to import

    # OMPL repeats some states, which cannot be timed
    states = path.states[np.append(True, step_lengths(path.states) > 1e-8)]
    if len(states) < 2:
        raise InvalidInputError("the path does not move: there is nothing to time")
    states[-1] = path.states[-1]

    faults = partial(trajectory_faults, problem)
    return time_path(states, problem.robot.joint_limits, settings, faults, problem.dynamics)


def trajectory_faults(problem: PlanningProblem, motion: Trajectory) -> Sequence[str]:
    """Return why a trajectory is not certified for a problem; empty: it is."""
    states = (motion.positions, motion.times, motion.velocities, motion.accelerations)
    return dry_run(problem, Motion(motion.joint_names, *states)).certificate.reasons


def dry_run(
    problem: PlanningProblem,
    motion: Motion,
    current: np.ndarray | None = None,
    tolerance: float = 0.01,
    exact_clearance: bool = False,
) -> DryRun:
    """Check a path or trajectory before it is sent to an arm.

    Args:
        problem: start, goals, constraint, robot and scene.
        motion: the path or trajectory.
        current: (n,), present configuration of the arm [rad or m]; None: it is not checked.
        tolerance: largest difference of `current` from the begin of the motion [rad or m].
        exact_clearance: as in `certify`.

    Raises InvalidInputError for joints of another robot, for a trajectory without velocities, and
    for times that do not increase.
    """
    motion = motion.of_joints(problem.robot.joint_names)
    states, robot = motion.positions, problem.robot
    usable = states.ndim == 2 and states.shape[1] == robot.dof and np.isfinite(states).all()
    faults = (
        _start_fault(problem, states[0], current, tolerance)
        if current is not None and usable
        else []
    )
    if motion.times is None or not usable:
        certificate = certify(problem, JointPath(states), exact_clearance=exact_clearance)
        return DryRun(replace(certificate, faults=(*faults, *certificate.faults)), states)
    # a hinge moves points by at most the diameter times dq, a slider by dq [m]
    deviation_m = (
        max(2.0 * reach_with(robot, problem.attachments), 1.0)
        * float(np.abs(robot.kinematics.multiplier).sum())
        * CURVE_TOLERANCE
    )
    curves, gap = _curves(motion)
    together = gap <= 0.5 * CURVE_TOLERANCE
    runs: list[DryRun] = []
    for name, curve in curves.items():
        if not (runs and together):  # else the certified pieces are close to this curve, too
            times = _moments(curve, robot.joint_limits, CURVE_TOLERANCE - gap * together)
            states = curve(times)
            checker = problem.collision_checker(deviation_m)
            certificate = certify(problem, JointPath(states), checker, exact_clearance)
        # the quintic has these accelerations at its points
        given = motion.accelerations if name == "cubic" else None
        limits = robot.joint_limits
        if name == "cubic":  # its accelerations jump between its pieces
            limits = replace(limits, jerk=None)
        every = (
            *_limit_faults(curve, given, limits, times),
            *_effort_faults(problem, curve, times),
            *_rest_faults(curve, limits, times),
            *faults,
            *certificate.faults,
        )
        runs.append(DryRun(replace(certificate, faults=every), states, times, deviation_m, name))
        if every:
            return runs[-1]
    return min(runs, key=lambda run: (run.certificate.valid, _least(run.certificate)))


def _least(certificate: Certificate) -> float:
    """Return the least distance that a certificate knows [m]: measured, else proven."""
    if not np.isnan(certificate.min_clearance_m):
        return certificate.min_clearance_m
    clearances = filter(None, (certificate.obstacle_clearance, certificate.self_clearance))
    return min((item.at_least_m for item in clearances), default=np.inf)


def _curves(motion: Motion) -> tuple[dict[str, PPoly], float]:
    """Return the quintic q(t) (n,) through given accelerations, the cubic, and their distance.

    With h the length of a piece, s = t / h its share and d0, d1 the given accelerations less the
    cubic's at its ends: quintic - cubic = h^2 / 2 (d0 s^2 (1 - s)^3 + d1 s^3 (1 - s)^2), at most
    h^2 / 32 max(|d0|, |d1|).
    """
    assert motion.times is not None
    q, v, a = motion.positions, motion.velocities, motion.accelerations
    if v is None:
        raise InvalidInputError(
            "a trajectory needs velocities at its times; leave the times out to judge the path"
        )
    for what, values in (("time", motion.times), ("velocity", v), ("acceleration", a)):
        if values is not None and not np.isfinite(values).all():
            raise InvalidInputError(f"a value of {what} is not finite")
    if len(motion.times) < 2 or motion.times[0] < 0.0 or not (np.diff(motion.times) > 0.0).all():
        raise InvalidInputError(
            "times must begin at 0 or later and increase, at two points or more"
        )
    from scipy.interpolate import PPoly

    times = motion.times - motion.times[0]
    h = np.diff(times)[:, None]
    with np.errstate(all="ignore"):  # overflow is refused by `_moments`
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


def _rates(curve: PPoly, order: int) -> np.ndarray:
    """Return a derivative [rad/s, rad/s^2] at 33 points of every piece (33, k, n), or inf, nan."""
    after = np.linspace(0.0, 1.0, 33)[:, None, None] * np.diff(curve.x)[:, None]
    with np.errstate(all="ignore"):
        return np.polyval(curve.derivative(order).c, after)


def _moments(
    curve: PPoly,
    limits: JointLimits,
    flat: float,
    hardest: float = 1e3,
    most_pieces: int = 100_000,
) -> np.ndarray:
    """Return times (m,) between which joints move nearly straight: |q''| dt^2 / 8 <= flat.

    Args:
        curve: q(t).
        limits: limits of the joints.
        flat: largest distance from straight [rad or m].
        hardest: accelerations above this multiple of a limit are refused: units must be wrong.
        most_pieces: largest number of times.
    """
    # between these points a cubic is at most 1.2 % larger (Markov: |p''| <= 24 max |p| on [-1, 1])
    most = 1.02 * np.abs(_rates(curve, 2)).max(axis=0)
    if not (most <= hardest * limits.acceleration).all():
        worst, joint = np.unravel_index(int(np.argmax(most / limits.acceleration)), most.shape)
        raise InvalidInputError(
            f"from point {worst} on {limits.joint_names[joint]} accelerates by "
            f"{most[worst, joint]:.3g} rad/s^2, its limit is {limits.acceleration[joint]:.3g}: "
            "too much to follow; are units right?"
        )
    spans = np.diff(curve.x)
    pieces = np.maximum(np.ceil(spans * np.sqrt(most.max(axis=1) / (8.0 * flat))), 1.0)
    if pieces.sum() > most_pieces:
        raise InvalidInputError(
            f"a motion of {spans.sum():.3g} s that would be followed in {pieces.sum():.3g} "
            f"straight pieces; at most {most_pieces} are: certify it in parts; are times in "
            "seconds?"
        )
    return cut(curve.x[:, None], pieces.astype(int))[:, 0]


def _limit_faults(
    curve: PPoly, given: np.ndarray | None, limits: JointLimits, times: np.ndarray
) -> Iterator[Fault]:
    """Find the joint most above each limit of velocity, acceleration and jerk.

    Args:
        curve: q(t).
        given: accelerations at the points of the motion (k, n), checked in addition, or None.
        limits: limits of the joints.
        times: times of the certified states (m,) [s].
    """
    for order, kind, unit, limit in (
        (1, FaultKind.VELOCITY, "rad/s", limits.velocity),
        (2, FaultKind.ACCELERATION, "rad/s^2", limits.acceleration),
        (3, FaultKind.JERK, "rad/s^3", limits.jerk),
    ):
        if limit is None:
            continue
        shares, rates = extremes(curve, order)
        if order == 2 and given is not None:
            rates = np.concatenate([rates, given[None, :-1], given[None, 1:]])
            shares = np.concatenate([shares, shares[[0, -1]]])
        used = np.nan_to_num(np.abs(rates) / limit, nan=np.inf)
        share, k, joint = np.unravel_index(int(used.argmax()), used.shape)
        if used[share, k, joint] > 1.0 + LIMIT_OVERSHOOT[kind]:
            reached = (
                f"{limits.joint_names[joint]} reaches {used[share, k, joint] * limit[joint]:.4g} "
                f"{unit}"
            )
            moment = curve.x[k] + shares[share, k, joint] * (curve.x[k + 1] - curve.x[k])
            state = float(np.interp(moment, times, np.arange(len(times))))
            yield Fault(kind, f"{reached}, its {kind} limit is {limit[joint]:.4g}", state)


def _effort_faults(
    problem: PlanningProblem,
    curve: PPoly,
    times: np.ndarray,
    resolution: float = 0.005,
    most_parts: int = 200_000,
) -> Iterator[Fault]:
    """Find the joint most above its effort limit, at any time, and above its torque rate at 1 kHz.

    On a part of a piece, h [s] long, |tau| is at most the larger one of its ends plus
    h^2 / 8 max |tau''|, see `Dynamics.curvature`; parts are so short that this is less than
    `resolution` of the limit.

    Args:
        problem: the robot and its load.
        curve: q(t).
        times: times of the certified states (m,) [s].
        resolution: see above.
        most_parts: largest number of parts; with more, efforts are not proven.
    """
    limits, dynamics = problem.robot.joint_limits, problem.dynamics
    if dynamics is None or limits.effort is None:
        return
    spans, rates = np.diff(curve.x), np.array([bounds(curve, order) for order in range(5)])
    bent = dynamics.curvature(rates[0], rates[1:])
    parts = np.sqrt((bent / (8.0 * resolution * limits.effort)).max(axis=1)) * spans
    parts = np.maximum(np.ceil(parts), 1.0)
    if not parts.sum() <= most_parts:
        text = (
            f"efforts are not proven: that takes {parts.sum():.3g} checks, more than {most_parts}"
        )
        yield Fault(FaultKind.NOT_PROVEN, text)
        return
    piece, number = numbered_parts(parts.astype(int) + 1)
    after = number * (spans / parts)[piece]
    states = [np.polyval(curve.derivative(k).c[:, piece], after[:, None]) for k in range(3)]
    most = (
        np.abs(dynamics.efforts(*states)) + ((spans / parts) ** 2 / 8.0)[piece, None] * bent[piece]
    )
    found = [(FaultKind.EFFORT, "Nm", most, curve.x[piece] + after)]
    if limits.torque_rate is not None:
        every = np.minimum(np.arange(0.0, curve.x[-1] + 1e-3, 1e-3), curve.x[-1])
        efforts = dynamics.efforts(*(curve(every, order) for order in range(3)))
        rates = np.abs(np.diff(efforts, axis=0)) / 1e-3
        found.append((FaultKind.TORQUE_RATE, "Nm/s", rates, every[:-1]))
    for kind, unit, values, moments in found:
        limit = getattr(limits, kind)
        k, joint = np.unravel_index(int((values / limit).argmax()), values.shape)
        if values[k, joint] > (1.0 + LIMIT_OVERSHOOT[kind]) * limit[joint]:
            state = float(np.interp(moments[k], times, np.arange(len(times))))
            what = f"{limits.joint_names[joint]} needs up to {values[k, joint]:.4g} {unit}"
            words = kind.replace("_", " ")
            yield Fault(kind, f"{what}, its {words} limit is {limit[joint]:.4g}", state)


def _rest_faults(curve: PPoly, limits: JointLimits, times: np.ndarray) -> Iterator[Fault]:
    """Find joints that do not rest where the motion begins or ends.

    If jerk is limited, accelerations must be 0 there, too: they would jump.
    """
    rates = [(FaultKind.VELOCITY, "moves at", "rad/s", limits.velocity, _rates(curve, 1))]
    if limits.jerk is not None:
        accelerations = _rates(curve, 2)
        words = "accelerates at once by"
        rates += [(FaultKind.JERK, words, "rad/s^2", limits.acceleration, accelerations)]
    for kind, words, unit, limit, values in rates:
        last = len(times) - 1.0
        for what, value, at in (("begins", values[0, 0], 0.0), ("ends", values[-1, -1], last)):
            share = np.abs(value) / limit
            joint = int(share.argmax())
            if share[joint] > LIMIT_OVERSHOOT[FaultKind.VELOCITY]:
                does = f"{limits.joint_names[joint]} {words} {abs(value[joint]):.4g} {unit}"
                yield Fault(kind, f"{does} where the motion {what}", at)


def _start_fault(
    problem: PlanningProblem, first: np.ndarray, current: np.ndarray, tolerance: float
) -> list[Fault]:
    """Compare the begin of a motion (n,) with the current configuration (n,) of the arm."""
    if current.shape != first.shape or not np.isfinite(current).all():
        raise InvalidInputError(
            f"current configuration of {len(current)} values: give {len(first)} finite numbers, "
            f"one each for {', '.join(problem.robot.joint_names)}"
        )
    off = np.abs(problem.robot.differences(first, current))
    if off.max() <= tolerance:
        return []
    name = problem.robot.joint_names[int(off.argmax())]
    text = f"{name} stands {off.max():.4g} from where the motion begins, tolerance {tolerance:g}"
    return [Fault(FaultKind.CURRENT, text, 0.0)]
