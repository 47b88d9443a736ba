"""Check of a motion before it is executed: limits, start, both ends, certificate.

`motion_curves` says which curves between its points are checked. Jerk is that of the quintic, also
where it is a cubic; without accelerations it is not judged: between cubics they jump.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_kind
from cvqmpt_lab.base.polyline import step_lengths
from cvqmpt_lab.base.values import FULL_TURN_RAD, NORMALISED, other_units
from cvqmpt_lab.certificate.certificate import Certificate, Fault, FaultKind, certify
from cvqmpt_lab.collision.carried import reach_with
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.features.motion.checked_curves import DryRun, worst_of
from cvqmpt_lab.features.motion.frame_speeds import FrameSpeeds
from cvqmpt_lab.features.motion.limit_use import (
    Ends,
    LimitUse,
    effort_uses,
    frame_uses,
    jump_uses,
    position_use,
    rate_uses,
    rest_faults,
)
from cvqmpt_lab.features.motion.motion_curves import curves_of, refuse_other_units, straight_moments
from cvqmpt_lab.features.motion.trajectory import Motion, Trajectory
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.search.result import JointPath

if TYPE_CHECKING:
    from scipy.interpolate import PPoly  # half a second to import, needed for trajectories alone

    from cvqmpt_lab.features.motion.timing import TimingSettings

# largest distance of a joint from the straight pieces that are certified in its place [rad or m]
CURVE_TOLERANCE = 1e-6
# function of states (m, n), straight motions between them: faults, whose places count these states
StateFaults = Callable[[np.ndarray], Iterable[Fault]]


def certified_motion(
    problem: PlanningProblem,
    path: JointPath,
    settings: TimingSettings | None = None,
    also: Callable[[Trajectory], Sequence[str]] = lambda motion: (),
) -> Trajectory:
    """Compute the fastest certified motion along a path, with the velocities of `settings` at ends.

    The quintics between its points are certified, and the cubics.

    Args:
        problem: the problem.
        path: the path.
        settings: speed, deviation, duration and velocities at the ends; None: the defaults.
        also: returns further faults of a motion.

    Raises InvalidInputError if the path does not move, the robot has no acceleration limits, or no
    motion is certified.
    """

    def faults(motion: Trajectory) -> Sequence[str]:
        return also(motion) or trajectory_faults(problem, motion, settings)

    return timed_motion(problem, path, settings, faults)


def timed_motion(
    problem: PlanningProblem,
    path: JointPath,
    settings: TimingSettings | None = None,
    faults: Callable[[Trajectory], Sequence[str]] | None = None,
) -> Trajectory:
    """Compute the fastest motion along a path within the robot's limits; it is not certified.

    Args:
        problem: the problem.
        path: the path.
        settings: as in `certified_motion`.
        faults: returns the faults that a motion must not have, see `timing.time_path`.

    Raises InvalidInputError if the path does not move, or the robot has no acceleration limits.
    """
    from cvqmpt_lab.features.motion.timing import time_path  # half a second to import

    # OMPL repeats some states, which cannot be timed
    states = path.states[np.append(True, step_lengths(path.states) > 1e-8)]
    if len(states) < 2:
        raise InvalidInputError("the path does not move: there is nothing to time")
    states[-1] = path.states[-1]
    frames = FrameSpeeds(problem.robot) if problem.robot.frame_limits else None
    limits = problem.robot.joint_limits
    return time_path(states, limits, settings, faults, problem.dynamics, frames)


def trajectory_faults(
    problem: PlanningProblem, motion: Trajectory, settings: TimingSettings | None = None
) -> Sequence[str]:
    """Return why a trajectory with these settings is not certified for a problem; empty: it is."""
    states = (motion.positions, motion.times, motion.velocities, motion.accelerations)
    ends = Ends()
    if settings is not None:
        start, end = (
            None if velocity is None else np.array(velocity)
            for velocity in (settings.start_velocity, settings.end_velocity)
        )
        ends = Ends(start_velocity=start, end_velocity=end)
    return dry_run(problem, Motion(motion.joint_names, *states), ends).certificate.reasons


def with_limits_of(problem: PlanningProblem, motion: Motion) -> PlanningProblem:
    """Return the problem with the limits in a motion's file of the kinds that its robot lacks."""
    robot = problem.robot
    given = motion.of_joints(robot.joint_names).limits if "articulated" not in robot.source else {}
    lacking = {"acceleration", "jerk", "torque_rate"} - robot.limits.keys()
    if not (robot.velocity_limits > 0.0).all():
        lacking.add("velocity")
    taken = {
        kind: given[kind] for kind in given if kind in lacking and np.isfinite(given[kind]).all()
    }
    if not taken:
        return problem
    source = {f"{kind}_limits": values.tolist() for kind, values in taken.items()}
    limited = robot_from_source({**robot.source, **source})
    said = f"limits of {' and '.join(taken)} are those in the file of the motion"
    return replace(problem, robot=replace(limited, remarks=(*limited.remarks, said)))


def dry_run(
    problem: PlanningProblem,
    motion: Motion,
    ends: Ends | None = None,
    exact_clearance: bool = False,
    more_faults: StateFaults | None = None,
) -> DryRun:
    """Check a path or trajectory before it is sent to an arm: every curve that it stands for.

    Args:
        problem: start, goals, constraint, robot and scene.
        motion: the path or trajectory.
        ends: begin and end of the motion; None: at rest, at the start and at a goal.
        exact_clearance: as in `certify`.
        more_faults: further faults of the states of every curve; None: there are none.

    Raises InvalidInputError for joints of another robot, positions in degrees, times that do not
    increase, and ones that are probably no seconds.
    """
    require_kind("motion", motion, Motion, "give Motion(joint_names, positions, times)")
    ends = ends or Ends()
    motion = motion.of_joints(problem.robot.joint_names)
    states, robot = motion.positions, problem.robot
    usable = states.ndim == 2 and states.shape[1] == robot.dof and np.isfinite(states).all()
    usable = usable and len(states) > 0
    _refuse_unnamed_times(robot, motion)
    if usable:
        _refuse_degrees(robot, states)
    faults = (
        _start_fault(problem, states[0], ends.current, ends.tolerance)
        if ends.current is not None and usable
        else []
    )
    if motion.times is None or not usable:
        certificate = certify(problem, JointPath(states), exact_clearance=exact_clearance)
        if usable and more_faults:
            faults += more_faults(states)
        return DryRun(_with_faults(certificate, faults, ends), states)
    curves, gap = _curves(motion, ends)
    if not ends.part:  # a part may hardly move
        refuse_other_units(motion, next(iter(curves.values())), robot)
    # curves that are so close to each other have the same straight pieces
    together = gap <= 0.5 * CURVE_TOLERANCE
    flat = CURVE_TOLERANCE - (gap if together else 0.0)
    runs: list[DryRun] = []
    for name, curve in curves.items():
        if not (runs and together):
            straight = _straight_run(problem, curve, flat, exact_clearance)
            asked = [*(more_faults(straight.states) if more_faults else ()), *faults]
        runs.append(_with_uses(problem, motion, ends, name, curve, straight, asked))
    return worst_of(runs)


def _curves(motion: Motion, ends: Ends) -> tuple[dict[str, PPoly], float]:
    """Return the curves of a motion by name that are checked, and their largest distance."""
    velocities = ends.start_velocity, ends.end_velocity
    curves, gap = curves_of(motion, *velocities, ends.part, ends.moving)
    if not ends.lines:
        curves.pop("linear", None)
    return curves, gap


def _straight_run(
    problem: PlanningProblem, curve: PPoly, flat: float, exact_clearance: bool
) -> DryRun:
    """Certify the straight pieces in the place of a curve, from which it is at most `flat` away."""
    robot = problem.robot
    # a hinge moves points by at most the diameter times dq, a slider by dq [m]
    deviation_m = (
        max(2.0 * reach_with(robot, problem.attachments), 1.0)
        * float(np.abs(robot.kinematics.multiplier).sum())
        * CURVE_TOLERANCE
    )
    times = straight_moments(curve, robot, flat)
    states = curve(times)
    checker = checker_of(problem, deviation_m)
    certificate = certify(problem, JointPath(states), checker, exact_clearance)
    return DryRun(certificate, states, times, deviation_m)


def _with_uses(
    problem: PlanningProblem,
    motion: Motion,
    ends: Ends,
    name: str,
    curve: PPoly,
    straight: DryRun,
    more: Sequence[Fault],
) -> DryRun:
    """Return the check of one curve of a motion, with its use of limits.

    Args:
        problem: the problem.
        motion: the trajectory.
        ends: begin and end of the motion.
        name: name of the curve, see `curves_of`.
        curve: q(t).
        straight: check of its straight pieces.
        more: further faults.
    """
    states, times = straight.states, straight.times
    assert times is not None and motion.times is not None
    uses, missing = _uses(problem, motion, name, curve, ends)
    own = [*missing, *(use.fault(times) for use in uses if use.exceeded)]
    own += rest_faults(name, curve, problem.robot, len(times) - 1.0, ends)
    certificate = _with_faults(straight.certificate, [*own, *more], ends)
    # curves begin at 0, the times of a motion may begin later
    begin = float(motion.times[0])
    uses = (*position_use(problem.robot, states, times), *uses)
    uses = tuple(use._replace(time=begin + use.time) for use in uses)
    return straight._replace(certificate=certificate, times=begin + times, curve=name, uses=uses)


def speed_within_limits(
    problem: PlanningProblem, motion: Motion, ends: Ends | None = None
) -> float | None:
    """Compute the largest speed at which a trajectory keeps the limits of all joints.

    Returns:
        A factor on the speed, at most 1, rounded down to 0.01, so that rates and efforts keep
        their limits; None: none from 0.01 on does, joints do not rest at an end, or the spline of
        the slower motion is another curve that is not certified.
    """
    ends = ends or Ends()
    motion = motion.of_joints(problem.robot.joint_names)

    def kept(percent: int) -> bool:
        slowed = motion.at_speed(0.01 * percent)
        for name, curve in _curves(slowed, ends)[0].items():
            uses, missing = _uses(problem, slowed, name, curve, ends)
            faults = [*missing, *rest_faults(name, curve, problem.robot, 0.0, ends)]
            if faults or any(use.exceeded for use in uses):
                return False
        return True

    if kept(100):
        return 1.0
    low, high = 0, 100  # the limits hold at `low`, or it is 0; they do not at `high`
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if kept(middle) else (low, middle)
    if not low:
        return None
    # with a given velocity at an end, a slower spline through the same positions is another curve
    given = [v for v in (ends.start_velocity, ends.end_velocity) if v is not None]
    if motion.velocities is None and any(np.any(v) for v in given):
        slowed = dry_run(problem, motion.at_speed(0.01 * low), ends)
        return 0.01 * low if slowed.certificate.valid else None
    return 0.01 * low


def _refuse_unnamed_times(robot: Robot, motion: Motion) -> None:
    """Refuse a table without a header whose first column is probably the time."""
    states = motion.positions
    if motion.joint_names is not None or motion.times is not None or states.ndim != 2:
        return
    more = len(states) > 1 and states.shape[1] == robot.dof + 1
    if more and (np.diff(states[:, 0]) > 0.0).all():
        raise InvalidInputError(
            f"the motion has {robot.dof + 1} values a state, the robot {robot.dof} joints: is the "
            f"first one the time? Give a table with the header "
            f"{','.join(['time', *robot.joint_names])}"
        )


def _refuse_degrees(robot: Robot, states: np.ndarray) -> None:
    """Refuse states (m, n) that are far outside the joint limits: in other units.

    As degrees they are inside; or they are LeRobot's normalised values, if most hinges have more
    than a turn.
    """
    hinges = ~robot.kinematics.prismatic[robot.kinematics.order[: robot.dof]]
    beyond = np.maximum(robot.lower - states, states - robot.upper).max(axis=0)
    turned = np.where(hinges, np.radians(states), states)
    # joints may stand beyond their limits in a motion with a fault
    inside = (turned >= robot.lower - 0.1) & (turned <= robot.upper + 0.1)
    j = int(np.where(hinges, beyond, -np.inf).argmax())
    most = np.abs(states).max(axis=0)
    normalised = (
        most.max() <= NORMALISED and (most[hinges] > FULL_TURN_RAD).sum() > 0.5 * hinges.sum()
    )
    if hinges[j] and beyond[j] > FULL_TURN_RAD and (inside.all() or normalised):
        k = int(np.abs(states[:, j]).argmax())
        raise InvalidInputError(
            f"{robot.joint_names[j]} is at {states[k, j]:.4g}, its limits are "
            f"{robot.lower[j]:.4g} to {robot.upper[j]:.4g}: {other_units(states)}"
        )


def _uses(
    problem: PlanningProblem, motion: Motion, name: str, curve: PPoly, ends: Ends
) -> tuple[tuple[LimitUse, ...], list[Fault]]:
    """Return the use of every limit on a curve of a motion, and why one is not known."""
    # the quintic has these accelerations at its points
    given = motion.accelerations if name == "cubic" else None
    found = [*rate_uses(name, curve, given, problem.robot)]
    proven = [*frame_uses(problem.robot, curve)]
    if name == "linear":
        found += jump_uses(curve, problem.robot, ends)
    else:
        proven += effort_uses(problem, curve)
    missing = [item for item in proven if isinstance(item, Fault)]
    every = (*found, *(item for item in proven if isinstance(item, LimitUse)))
    return tuple(use for use in every if use.known), missing


def _with_faults(certificate: Certificate, faults: Sequence[Fault], ends: Ends) -> Certificate:
    """Return a certificate with more faults; without those of ends that are not asked for."""
    kinds = (FaultKind.START, FaultKind.GOAL) if ends.part or ends.anywhere else ()
    left = (fault for fault in certificate.faults if fault.kind not in kinds)
    return replace(certificate, faults=(*faults, *left))


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
