"""Check of a motion before it is executed: limits, start, rest at both ends, and the certificate of its curve.

Between its points a trajectory is cubic, through positions and velocities, as a robot's controller interpolates.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.certificate import Certificate, Fault, FaultKind, certify
from cvqmpt_lab.collision.exact import reach_with
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import JointLimits
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.trajectory.trajectory import Trajectory
from cvqmpt_lab.trajectory.trajectory_files import Motion

FLAT = 1e-6  # [rad or m] that a joint's cubic may leave the straight pieces it is certified by
# Share by which limits may be exceeded: cubic pieces between the points of a motion that `time_path` timed to its
# limits have accelerations up to 4 % above the stated ones.
OVERSHOOT = {FaultKind.VELOCITY: 1e-3, FaultKind.ACCELERATION: 0.05}
MOST_PIECES = 100_000
HARDEST = 1e3  # times its acceleration limit, beyond which units must be wrong


class DryRun(NamedTuple):
    """A certificate that includes faults in time."""

    certificate: Certificate  # places of faults are numbers of `states`
    states: (
        np.ndarray
    )  # (m, n) [rad or m] that were certified: of a trajectory, straight pieces within FLAT of it
    times: np.ndarray | None = None  # (m,) of the states [s], or None for a path
    apart: float = (
        0.0  # distance of the robot's points on the motion from those on the straight pieces, at most [m]
    )


def dry_run(
    problem: PlanningProblem,
    motion: Motion,
    current: np.ndarray | None = None,
    tolerance: float = 0.01,
) -> DryRun:
    """Judge a path or trajectory before it is sent to an arm that stands at current (n,).

    InvalidInputError: joints of another robot, times without velocities, or times that do not increase.
    """
    motion = motion.of_joints(problem.robot.joint_names)
    states, times, faults, apart = motion.positions, None, [], 0.0
    usable = states.ndim == 2 and states.shape[1] == problem.robot.dof and np.isfinite(states).all()
    if motion.times is not None and usable:
        trajectory = _trajectory(motion, problem.robot.joint_names)
        limits = problem.robot.joint_limits
        times = _moments(trajectory, limits)
        states = trajectory.at(times).positions
        faults = [*_limit_faults(trajectory, motion, limits, times), *_rest_faults(trajectory, limits, times)]
        apart = 2.0 * reach_with(problem.robot, problem.attachments) * problem.robot.dof * FLAT
    if current is not None and usable:
        faults += _start_fault(problem, states[0], current, tolerance)
    certificate = certify(problem, JointPath(states), problem.collision_checker(apart))
    return DryRun(replace(certificate, faults=(*faults, *certificate.faults)), states, times, apart)


def _trajectory(motion: Motion, names: tuple[str, ...]) -> Trajectory:
    assert motion.times is not None
    if motion.velocities is None:
        raise InvalidInputError(
            "a trajectory needs velocities at its times; leave the times out to judge the path"
        )
    for what, values in (("time", motion.times), ("velocity", motion.velocities)):
        if not np.isfinite(values).all():
            raise InvalidInputError(f"a {what} is not finite")
    if len(motion.times) < 2 or motion.times[0] < 0.0 or not (np.diff(motion.times) > 0.0).all():
        raise InvalidInputError("times must begin at 0 or later and increase, at two points or more")
    zeros = np.zeros_like(motion.velocities)
    return Trajectory(names, motion.times - motion.times[0], motion.positions, motion.velocities, zeros)


def _moments(trajectory: Trajectory, limits: JointLimits) -> np.ndarray:
    """Times (m,) between which each joint is within FLAT of straight, by the largest acceleration of each piece."""
    most = np.maximum(*map(np.abs, _accelerations(trajectory)))
    if not (most <= HARDEST * limits.acceleration).all():
        worst, joint = np.unravel_index(int(np.argmax(most / limits.acceleration)), most.shape)
        raise InvalidInputError(
            f"from point {worst} on {limits.joint_names[joint]} accelerates by {most[worst, joint]:.3g} rad/s^2, "
            f"its limit is {limits.acceleration[joint]:.3g}: too much to follow; are units right?"
        )
    spans = np.diff(trajectory.times)
    pieces = np.maximum(np.ceil(spans * np.sqrt(most.max(axis=1) / (8.0 * FLAT))), 1.0)
    if pieces.sum() > MOST_PIECES:
        raise InvalidInputError(
            f"a motion of {spans.sum():.3g} s that would be followed in {pieces.sum():.3g} straight pieces; at most "
            f"{MOST_PIECES} are: certify it in parts; are times in seconds?"
        )
    cuts = [
        t + span * np.arange(count) / count
        for t, span, count in zip(trajectory.times, spans, pieces.astype(int), strict=False)
    ]
    return np.concatenate([*cuts, trajectory.times[-1:]])


def _accelerations(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """At the begin and the end of every cubic piece, (k, n) each [rad/s^2]; inf or nan after an overflow."""
    h = np.diff(trajectory.times)[:, None]
    v0, v1 = trajectory.velocities[:-1], trajectory.velocities[1:]
    with np.errstate(all="ignore"):
        mean = np.diff(trajectory.positions, axis=0) / h
        return (6.0 * mean - 4.0 * v0 - 2.0 * v1) / h, (2.0 * v0 + 4.0 * v1 - 6.0 * mean) / h


def _limit_faults(
    trajectory: Trajectory, motion: Motion, limits: JointLimits, times: np.ndarray
) -> list[Fault]:
    """Joints above their limits, at the points and at extrema of the velocity between them."""
    begins, ends = _accelerations(trajectory)
    spans = np.diff(trajectory.times)[:, None]
    change = ends - begins
    turn = np.clip(np.divide(-begins, change, out=np.zeros_like(begins), where=change != 0.0), 0.0, 1.0)
    between = trajectory.velocities[:-1] + spans * turn * (begins + 0.5 * turn * change)
    turning = trajectory.times[:-1, None] + spans * turn
    points = np.broadcast_to(trajectory.times[:, None], trajectory.positions.shape)
    velocities = np.concatenate([trajectory.velocities, between]), np.concatenate([points, turning])
    accelerations = np.concatenate([begins, ends]), np.concatenate([points[:-1], points[1:]])
    if motion.accelerations is not None:
        stated = np.concatenate([accelerations[0], motion.accelerations])
        accelerations = stated, np.concatenate([accelerations[1], points])
    faults = []
    for kind, unit, limit, (values, moments) in (
        (FaultKind.VELOCITY, "rad/s", limits.velocity, velocities),
        (FaultKind.ACCELERATION, "rad/s^2", limits.acceleration, accelerations),
    ):
        share = np.nan_to_num(np.abs(values) / limit, nan=np.inf)
        k, joint = np.unravel_index(int(share.argmax()), share.shape)
        if share[k, joint] > 1.0 + OVERSHOOT[kind]:
            name, reached = limits.joint_names[joint], abs(values[k, joint])
            text = f"{name} reaches {reached:.4g} {unit}, its {kind} limit is {limit[joint]:.4g}"
            state = float(np.interp(moments[k, joint], times, np.arange(len(times))))
            faults.append(Fault(kind, text, state))
    return faults


def _rest_faults(trajectory: Trajectory, limits: JointLimits, times: np.ndarray) -> list[Fault]:
    """Joints that do not rest where the motion begins or ends."""
    faults = []
    for what, end, at in (("begins", 0, 0.0), ("ends", -1, len(times) - 1.0)):
        share = np.abs(trajectory.velocities[end]) / limits.velocity
        joint = int(share.argmax())
        if share[joint] > OVERSHOOT[FaultKind.VELOCITY]:
            name, speed = limits.joint_names[joint], abs(trajectory.velocities[end, joint])
            text = f"{name} moves at {speed:.4g} rad/s where the motion {what}"
            faults.append(Fault(FaultKind.VELOCITY, text, at))
    return faults


def _start_fault(
    problem: PlanningProblem, first: np.ndarray, current: np.ndarray, tolerance: float
) -> list[Fault]:
    if current.shape != first.shape or not np.isfinite(current).all():
        raise InvalidInputError(
            f"current configuration of {len(current)} values: give {len(first)} finite numbers, one each for "
            f"{', '.join(problem.robot.joint_names)}"
        )
    off = np.abs(first - current)
    if off.max() <= tolerance:
        return []
    name = problem.robot.joint_names[int(off.argmax())]
    text = f"{name} stands {off.max():.4g} from where the motion begins, tolerance {tolerance:g}"
    return [Fault(FaultKind.CURRENT, text, 0.0)]
