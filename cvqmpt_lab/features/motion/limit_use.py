"""The share of every limit that a motion q(t) uses: velocity, acceleration, jerk, effort.

Shares are largest over all times, not only over the points of the motion: rates are extremes of
polynomials, efforts are bounded between the times at which they are computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cvqmpt_lab.base.polyline import numbered_parts
from cvqmpt_lab.certificate.certificate import Fault, FaultKind
from cvqmpt_lab.features.motion.frame_speeds import FrameSpeeds
from cvqmpt_lab.features.motion.motion_curves import rates
from cvqmpt_lab.features.motion.trajectory import bounds, extremes
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot

if TYPE_CHECKING:
    from scipy.interpolate import PPoly  # half a second to import, needed for trajectories alone

# share by which limits may be exceeded: the cubics through points of `time_path` do so by 0.5 %
LIMIT_OVERSHOOT = {
    FaultKind.VELOCITY: 1e-3,
    FaultKind.VELOCITY_JUMP: 0.01,
    FaultKind.ACCELERATION: 0.01,
    FaultKind.JERK: 0.01,
    FaultKind.EFFORT: 0.01,
    FaultKind.TORQUE_RATE: 0.01,
    FaultKind.FRAME_SPEED: 1e-3,
    FaultKind.FRAME_TURNING_SPEED: 1e-3,
}

# allowed jump of a joint's velocity between straight lines: this share of its velocity limit, or
# what its acceleration limit gives in this time, a period of a controller at 100 Hz
JUMP_SHARE = 0.1
JUMP_PERIOD_S = 0.01
# of velocity and acceleration, where nobody states a limit [rad/s, rad/s^2 or m/s, m/s^2]
UNKNOWN_LIMIT = 1e9


class LimitUse(NamedTuple):
    """The largest share of a limit that a motion uses."""

    kind: FaultKind
    of: str  # joint that uses the largest share, or frame
    value: float  # its largest rate or effort
    limit: float
    unit: str
    time: float  # of that value, counted as those of the motion [s]

    @property
    def share(self) -> float:
        """Value over limit; above 1 the limit is exceeded."""
        return self.value / self.limit

    @property
    def known(self) -> bool:
        """Whether the limit was stated, or follows from limits that were."""
        return self.limit < JUMP_PERIOD_S * UNKNOWN_LIMIT

    @property
    def exceeded(self) -> bool:
        """Whether the limit is exceeded by more than LIMIT_OVERSHOOT allows."""
        # positions are checked by the certificate itself
        return self.kind in LIMIT_OVERSHOOT and not self.share <= 1.0 + LIMIT_OVERSHOOT[self.kind]

    @property
    def text(self) -> str:
        """The use in words, as of a fault."""
        if self.kind is FaultKind.VELOCITY_JUMP:
            return (
                f"the velocity of {self.of} jumps by {self.value:.4g} {self.unit} between straight "
                f"lines, at most {self.limit:.4g} is allowed: give velocities, or more points"
            )
        needs = self.kind in (FaultKind.EFFORT, FaultKind.TORQUE_RATE)
        does = "needs up to" if needs else "reaches"
        return (
            f"{self.of} {does} {self.value:.4g} {self.unit}, its {self.words} limit is "
            f"{self.limit:.4g}"
        )

    @property
    def words(self) -> str:
        """The kind of limit in words."""
        return "position" if self.kind is FaultKind.LIMITS else self.kind.replace("_", " ")

    def fault(self, times: np.ndarray) -> Fault:
        """Return the fault of exceeding the limit; times (m,) [s] of the certified states."""
        return Fault(
            self.kind, self.text, float(np.interp(self.time, times, np.arange(len(times))))
        )


def share_text(uses: Iterable[LimitUse]) -> str:
    """Return the largest share of limits of velocity and acceleration in words, or ""."""
    kinds = (FaultKind.VELOCITY, FaultKind.ACCELERATION)
    shares = [use.share for use in uses if use.kind in kinds]
    return f" at {max(shares):.2g} of the limits" if shares else ""


class Ends(NamedTuple):
    """The begin and end of a motion; the default is at rest, at the start and at a goal."""

    # (n,), present configuration of the arm [rad or m]; None: it is not checked
    current: np.ndarray | None = None
    tolerance: float = 0.01  # largest difference of `current` from the begin [rad or m]
    start_velocity: np.ndarray | None = None  # (n,) [rad/s or m/s]; None: at rest
    end_velocity: np.ndarray | None = None  # (n,); None: at rest, or any of a part of a motion
    # a part of a longer motion, such as a chunk of a policy: it begins at the current state, and
    # need not end at a goal
    part: bool = False
    # whether it may begin and end anywhere: start and goals of the problem say nothing
    anywhere: bool = False
    # whether a part may already move at its begin, at any velocity; without `start_velocity`
    moving: bool = False
    # whether straight lines between positions without velocities are checked beside the spline
    lines: bool = True


def position_use(robot: Robot, states: np.ndarray, times: np.ndarray) -> Iterator[LimitUse]:
    """Yield the use of the joint limits, as the share of half of a joint's range.

    Joints that turn without end have none.

    Args:
        robot: the robot.
        states: (m, n) [rad or m].
        times: (m,) of the states [s].
    """
    half = np.where(robot.endless, np.inf, 0.5 * (robot.upper - robot.lower))
    off = np.abs(states - 0.5 * (robot.upper + robot.lower))
    k, joint = np.unravel_index(int((off / half).argmax()), off.shape)
    if np.isfinite(half[joint]):
        value, name = float(off[k, joint]), robot.joint_names[joint]
        limit, unit = float(half[joint]), robot.unit_of(int(joint), "rad")
        yield LimitUse(FaultKind.LIMITS, name, value, limit, unit, float(times[k]))


def rate_uses(
    name: str, curve: PPoly, given: np.ndarray | None, robot: Robot
) -> Iterator[LimitUse]:
    """Yield the use of the limits of velocity, acceleration and jerk.

    Jerk is that of quintics alone: accelerations of cubics jump between their pieces. Velocities
    of lines jump, see `jump_uses`, so that neither is judged.

    Args:
        name: name of the curve, see `curves_of`.
        curve: q(t).
        given: accelerations at the points of the motion (k, n), counted in addition, or None.
        robot: the robot with the limits of its joints.
    """
    limits = robot.joint_limits
    judged = {"linear": 1, "quintic": 3}.get(name, 2)
    every = (
        (1, FaultKind.VELOCITY, "rad/s", limits.velocity),
        (2, FaultKind.ACCELERATION, "rad/s^2", limits.acceleration),
        (3, FaultKind.JERK, "rad/s^3", limits.jerk),
    )
    for order, kind, unit, limit in every[:judged]:
        if limit is None:
            continue
        shares, found = extremes(curve, order)
        if order == 2 and given is not None:
            found = np.concatenate([found, given[None, :-1], given[None, 1:]])
            shares = np.concatenate([shares, shares[[0, -1]]])
        sizes = np.abs(found)
        if order == 3:
            sizes = np.maximum(sizes - _rounded_jerk(curve), 0.0)
        used = np.nan_to_num(sizes / limit, nan=np.inf)
        share, k, joint = np.unravel_index(int(used.argmax()), used.shape)
        moment = curve.x[k] + shares[share, k, joint] * (curve.x[k + 1] - curve.x[k])
        value = float(used[share, k, joint] * limit[joint])
        name, own = limits.joint_names[joint], robot.unit_of(int(joint), unit)
        yield LimitUse(kind, name, value, float(limit[joint]), own, float(moment))


def jump_uses(curve: PPoly, robot: Robot, ends: Ends) -> Iterator[LimitUse]:
    """Yield the largest jump of velocity between straight lines, as a share of what is allowed.

    A joint with limits v and a of velocity and acceleration may change its velocity at a point at
    once by JUMP_SHARE v, or by JUMP_PERIOD_S a if this is more. Positions of a smooth motion every
    h [s] have jumps of at most h a.

    Args:
        curve: the straight lines.
        robot: the robot with the limits of its joints.
        ends: the velocities before the begin and after the end; by default joints are at rest.
    """
    limits = robot.joint_limits
    allowed = np.maximum(JUMP_SHARE * limits.velocity, JUMP_PERIOD_S * limits.acceleration)
    slopes = curve.c[-2]
    still = np.zeros_like(slopes[0])
    before = still if ends.start_velocity is None else ends.start_velocity
    if ends.moving and ends.start_velocity is None:
        before = slopes[0]
    after = still if ends.end_velocity is None else ends.end_velocity
    if ends.part and ends.end_velocity is None:
        after = slopes[-1]
    jumps = np.abs(np.diff(slopes, axis=0, prepend=before[None], append=after[None]))
    k, joint = np.unravel_index(int((jumps / allowed).argmax()), jumps.shape)
    name, unit = limits.joint_names[joint], robot.unit_of(int(joint), "rad/s")
    value, limit = float(jumps[k, joint]), float(allowed[joint])
    yield LimitUse(FaultKind.VELOCITY_JUMP, name, value, limit, unit, float(curve.x[k]))


def _rounded_jerk(curve: PPoly) -> np.ndarray:
    """Return how exactly a quintic's jerk (k, n) follows from numbers of 52 bits.

    Its jerk has the term 60 (q1 - q0) / h^3. Positions are rounded to 2^-52 |q|, and times to
    2^-52 t, which moves positions by 2^-52 t |v|: with h of a microsecond, by 10^4 rad/s^3.
    """
    size = bounds(curve, 0) + curve.x[-1] * bounds(curve, 1)
    rounded: np.ndarray = 60.0 * 2.0**-52 * size / np.diff(curve.x)[:, None] ** 3
    return rounded


class _Parts:
    """Equal parts of every piece of a curve, so short that a value hardly bends within one.

    On a part h [s] long a value is at most the larger one of its ends plus h^2 / 8 times its bend.

    Args:
        curve: q(t) of k pieces.
        bend: bounds (k, f) of the second derivatives of f values over time.
        flat: (f,) largest h^2 / 8 times the bend.
        most: largest number of parts; with more, the values are not proven, which is a fault.
    """

    def __init__(
        self, curve: PPoly, bend: np.ndarray, flat: np.ndarray, most: int = 200_000
    ) -> None:
        self._curve, self._bend, self._spans = curve, bend, np.diff(curve.x)
        counts = np.sqrt((bend / (8.0 * flat)).max(axis=1)) * self._spans
        self._counts = np.maximum(np.ceil(counts), 1.0)
        self._total, self._most = float(self._counts.sum()), most
        self.too_many = not self._total <= most  # whether there are too many to be cut

    def not_proven(self, what: str) -> Fault:
        """Return the fault of values of too many parts; `what` names them."""
        checks = f"that takes {self._total:.3g} checks, more than {self._most}"
        return Fault(FaultKind.NOT_PROVEN, f"{what} are not proven: {checks}")

    @cached_property
    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Piece of each end of a part, and its time after the begin of the piece [s]."""
        piece, number = numbered_parts(self._counts.astype(int) + 1)
        return piece, number * (self._spans / self._counts)[piece]

    @property
    def times(self) -> np.ndarray:
        """Times (e,) of the ends [s]."""
        piece, after = self._ends
        return self._curve.x[piece] + after

    @property
    def beyond(self) -> np.ndarray:
        """Largest excess (e, f) of values within a part over its ends."""
        piece, _ = self._ends
        return ((self._spans / self._counts) ** 2 / 8.0)[piece, None] * self._bend[piece]

    def at(self, order: int) -> np.ndarray:
        """Return a derivative (e, n) of q at the ends."""
        piece, after = self._ends
        return np.polyval(self._curve.derivative(order).c[:, piece], after[:, None])


def effort_uses(
    problem: PlanningProblem,
    curve: PPoly,
    resolution: float = 0.005,
) -> Iterator[LimitUse | Fault]:
    """Yield the use of the effort limits at any time, and of the torque rates at 1 kHz.

    On a part of a piece, h [s] long, |tau| is at most the larger one of its ends plus
    h^2 / 8 max |tau''|, see `Dynamics.curvature`; parts are so short that this is less than
    `resolution` of the limit.

    Args:
        problem: the robot and its load.
        curve: q(t).
        resolution: see above.
    """
    limits, dynamics = problem.robot.joint_limits, problem.dynamics
    if dynamics is None or limits.effort is None:
        return
    most = np.array([bounds(curve, order) for order in range(5)])
    bent = dynamics.curvature(most[0], most[1:])
    parts = _Parts(curve, bent, resolution * limits.effort)
    if parts.too_many:
        yield parts.not_proven("efforts")
        return
    largest = np.abs(dynamics.efforts(*(parts.at(k) for k in range(3)))) + parts.beyond
    found = [(FaultKind.EFFORT, "Nm", largest, parts.times)]
    if limits.torque_rate is not None:
        every = np.minimum(np.arange(0.0, curve.x[-1] + 1e-3, 1e-3), curve.x[-1])
        efforts = dynamics.efforts(*(curve(every, order) for order in range(3)))
        found.append(
            (FaultKind.TORQUE_RATE, "Nm/s", np.abs(np.diff(efforts, axis=0)) / 1e-3, every[:-1])
        )
    for kind, unit, values, moments in found:
        limit = getattr(limits, kind)
        k, joint = np.unravel_index(int((values / limit).argmax()), values.shape)
        value, name = float(values[k, joint]), limits.joint_names[joint]
        own = problem.robot.unit_of(int(joint), unit)
        yield LimitUse(kind, name, value, float(limit[joint]), own, float(moments[k]))


def frame_uses(robot: Robot, curve: PPoly, resolution: float = 5e-4) -> Iterator[LimitUse | Fault]:
    """Yield the use of the speed limits of the robot's frames, at any time.

    On a part of a piece, h [s] long, a speed is at most the larger one of its ends plus h^2 / 8
    times the bound of `FrameSpeeds.bend`; parts are so short that this is less than `resolution`
    of the limit.

    Args:
        robot: the robot with its limits.
        curve: q(t).
        resolution: see above.
    """
    frames = FrameSpeeds(robot)
    if not frames.limits:
        return
    limits = np.array([limit for _, _, limit in frames.limits])
    bend = frames.bend(np.array([bounds(curve, order) for order in (1, 2, 3)]))
    parts = _Parts(curve, bend, resolution * limits)
    if parts.too_many:
        yield parts.not_proven("speeds of frames")
        return
    most = frames.speeds(parts.at(0), parts.at(1)) + parts.beyond
    for k, (name, turning, limit) in enumerate(frames.limits):
        at = int(most[:, k].argmax())
        kind = FaultKind.FRAME_TURNING_SPEED if turning else FaultKind.FRAME_SPEED
        unit = "rad/s" if turning else "m/s"
        yield LimitUse(kind, name, float(most[at, k]), limit, unit, float(parts.times[at]))


def rest_faults(name: str, curve: PPoly, robot: Robot, last: float, ends: Ends) -> Iterator[Fault]:
    """Yield joints that do not begin or end a motion at the given velocity, as a rule at rest.

    If jerk is limited, accelerations of quintics must be 0 at rest, too: they would jump. Lines
    are left out: their velocities jump at every point.

    Args:
        name: name of the curve, see `curves_of`.
        curve: q(t).
        robot: the robot with the limits of its joints.
        last: place of the end, see `Fault.at`.
        ends: the given velocities.
    """
    if name == "linear":
        return
    limits = robot.joint_limits
    velocity, acceleration = rates(curve, 1), rates(curve, 2)
    for what, at, row, given in (
        ("begins", 0.0, (0, 0), ends.start_velocity),
        ("ends", last, (-1, -1), ends.end_velocity),
    ):
        unasked = ends.part if what == "ends" else ends.moving
        if unasked and given is None:
            continue
        asked = np.zeros(len(limits.joint_names)) if given is None else given
        kinds = [(FaultKind.VELOCITY, "moves at", "rad/s", limits.velocity, velocity[row] - asked)]
        if limits.jerk is not None and given is None and name == "quintic":
            words = "accelerates at once by"
            kinds += [(FaultKind.JERK, words, "rad/s^2", limits.acceleration, acceleration[row])]
        for kind, words, unit, limit, off in kinds:
            share = np.abs(off) / limit
            joint = int(share.argmax())
            if share[joint] > LIMIT_OVERSHOOT[FaultKind.VELOCITY]:
                value = abs(off[joint] + (asked[joint] if kind is FaultKind.VELOCITY else 0.0))
                own = robot.unit_of(joint, unit)
                does = f"{limits.joint_names[joint]} {words} {value:.4g} {own}"
                given_as = "" if given is None else f", given is {asked[joint]:.4g}"
                yield Fault(kind, f"{does} where the motion {what}{given_as}", at)
