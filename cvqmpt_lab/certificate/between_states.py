"""The largest violation of task-space regions along a path, between its states as well."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.polyline import numbered_parts, parts_within, states_between
from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.constraints.bounds_between import ROTATION_RATE, bound_between, longest_lever
from cvqmpt_lab.constraints.constraint import Constraint, real_values
from cvqmpt_lab.constraints.task_space_region import UNITS, TaskSpaceRegion, displaced, excess
from cvqmpt_lab.robot.joint_frames import poses_at_once
from cvqmpt_lab.robot.robot import Robot

CUTS = 4  # times that stretches are cut at most
RADIANS = UNITS == "rad"  # rows (10,) of displacements that are angles; others are lengths


@dataclass(frozen=True)
class Violation:
    """Largest distance outside the bounds of regions, at the states checked."""

    radians: float  # [rad]
    metres: float  # [m]
    largest: float  # bound on either at any state, checked or not [m, rad]
    at: np.ndarray | None  # (n,), the worst state, or None without regions


def largest_violation(
    robot: Robot,
    regions: Sequence[TaskSpaceRegion],
    states: np.ndarray,
    spacing: float,
    tolerance: float,
    most_parts: int = 8,
    at_first: Sequence[np.ndarray] = (),
) -> Violation:
    """Compute how far straight joint motions leave regions, also between states.

    Between states the violation is bounded, see `bounds_between`.

    Args:
        robot: the robot.
        regions: the constraint.
        states: (m, n), m >= 1 [rad or m].
        spacing: largest distance between the states checked at first [rad].
        tolerance: stretches are cut where the bound exceeds it and no state does [m, rad].
        most_parts: largest number of parts that a stretch is cut into at once, up to CUTS times.
        at_first: displacements (k, 10) of each region at the states checked at first, if they are
            known [m, rad].
    """
    radians = metres = highest = 0.0
    at, most = None, -np.inf
    begin = evenly_spaced(states, spacing)
    for number, region in enumerate(regions):
        q = begin
        x = at_first[number] if at_first else _displacements(robot, region, q)
        for rounds_left in range(CUTS, -1, -1):
            beyond = excess(region, x)
            outside = beyond.max(axis=1)
            at_ends = np.maximum(outside[:-1], outside[1:])
            between, flips = bound_between(robot, region, q, x)
            doubtful = at_ends + between > tolerance
            if rounds_left == 0 or outside.max() > tolerance or not doubtful.any():
                break
            ratio = between / np.maximum(tolerance - at_ends, 1e-3 * between)
            parts = np.ceil(np.where(flips, ratio, np.sqrt(ratio)))
            counts = np.where(doubtful, np.clip(parts, 2, most_parts).astype(int), 1)
            known, q = np.concatenate([[0], np.cumsum(counts)]), _cut(q, counts)
            new, before = np.ones(len(q), dtype=bool), x
            new[known], x = False, np.empty((len(q), x.shape[1]))
            x[known], x[new] = before, _displacements(robot, region, q[new])
        farthest = beyond.max(axis=0)
        radians = max(radians, farthest[RADIANS].max())
        metres = max(metres, farthest[~RADIANS].max())
        highest = max(highest, (at_ends + between).max(initial=outside.max()))
        if outside.max() > most:
            most, at = outside.max(), q[outside.argmax()]
    return Violation(float(radians), float(metres), float(highest), at)


@dataclass(frozen=True)
class FunctionViolation:
    """Largest |F_i| of a function of the user's own, at the states checked."""

    largest: float  # in units of F
    at: np.ndarray  # (n,), that state
    unproven_states: int  # number of states, where no bound proves the motion between them; else 0
    text: str  # why it is refused; "" if it is not


def function_violation(
    function: Constraint,
    states: np.ndarray,
    spacing: float,
    tolerance: float,
    fine: float = 1e-3,
    most_states: int = 1_000_000,
) -> FunctionViolation:
    """Compute how far straight joint motions leave F = 0, by the user's own function.

    With a bound it is proven between states, too: stretches are cut until the bound allows it.
    Without, states every `fine` are checked.

    Args:
        function: the constraint.
        states: (m, n), m >= 1 [rad or m].
        spacing: largest distance between the states checked at first [rad].
        tolerance: of |F_i|.
        fine: largest distance between states where there is no bound [rad].
        most_states: with more, it is not proven.
    """
    q = evenly_spaced(states, spacing)
    between = function.proven_between(q)
    if between is None:
        q = evenly_spaced(states, fine)
    while True:
        largest = np.abs(_values(function, q)).max(axis=1, initial=0.0)
        largest[~np.isfinite(largest)] = np.inf
        worst = int(largest.argmax())
        if between is None or largest[worst] > tolerance:
            break
        at_ends = np.maximum(largest[:-1], largest[1:])
        doubtful = at_ends + between > tolerance
        if not doubtful.any():
            break
        # a Lipschitz bound falls with the length, another one perhaps with its square
        parts = np.ceil(between / np.maximum(tolerance - at_ends, 1e-3 * between)).clip(2, 16)
        counts = np.where(doubtful, parts, 1).astype(int)
        if counts.sum() > most_states:
            break
        q = _cut(q, counts)
        between = function.proven_between(q)
    text = ""
    if largest[worst] > tolerance:
        text = f"off the constraint {function.describe()} by {largest[worst]:.3g}"
    elif between is not None:
        proven = (np.maximum(largest[:-1], largest[1:]) + between).max(initial=largest[worst])
        if proven > tolerance:
            text = (
                f"{function.describe()} is at most {largest[worst]:.2g} at the checked states, not "
                f"proven to be less than {proven:.2g} between them"
            )
    unproven = len(q) if between is None else 0
    return FunctionViolation(float(largest[worst]), q[worst], unproven, text)


def _values(function: Constraint, q: np.ndarray) -> np.ndarray:
    """Return F (m, dim) of a function at states (m, n); InvalidInputError for anything else."""
    try:
        F = real_values(function.own_residual(q))
    except TypeError as error:
        raise InvalidInputError(f"constraint {function.describe()}: F: {error}") from error
    if F.shape != (len(q), function.dim):
        raise InvalidInputError(
            f"constraint {function.describe()}: F of {len(q)} states has shape {F.shape}; needed: "
            f"({len(q)}, {function.dim})"
        )
    return F


def least_slack(
    robot: Robot,
    regions: Sequence[TaskSpaceRegion],
    states: np.ndarray,
    spacing: float,
    resolution: float = 2e-4,
) -> tuple[float, float]:
    """Compute the proven slack [rad] and [m] of straight joint motions in regions.

    A hand that is turned or moved by less stays inside. Rows of width 0 have no slack and are left
    out; the slack is inf without others. Entries of the rotation vector change by up to
    ROTATION_RATE times the turn of the hand, and change signs at angle pi: where a path may come
    there and bounds are not symmetric, the slack is 0. A bearing changes by up to the angle whose
    sine is the way of the hand over the distance, which limits the slack [m] too.

    Args:
        robot: the robot.
        regions: the constraint.
        states: (m, n), m >= 1 [rad or m].
        spacing: largest distance between the states checked at first [rad].
        resolution: what the proof may lose [m, rad].
    """
    slack = np.array([np.inf, np.inf])
    q = evenly_spaced(states, spacing)
    for region in regions:
        lower, upper = region.bounds.T
        thin = ~(region.bounded & region.wide)
        x = _displacements(robot, region, q)
        inside = np.where(thin, np.inf, -excess(region, x).max(axis=0))
        seen = np.array([inside[unit == UNITS].min() for unit in ("rad", "m")]).clip(min=0.0)
        free = np.where(thin[:6, None], [-np.inf, np.inf], 0.0)
        for _ in range(CUTS if np.isfinite(seen).any() else 0):
            radians, metres = np.where(np.isinf(seen), 0.0, seen).tolist()
            moved = region.inset(metres, radians, share=0.5)
            moved = moved.changed(
                Bw=frozen(np.where(thin[:6, None], free, moved.Bw)),
                distance=None if thin[7] else moved.distance,
                radius=None if thin[8] else moved.radius,
            )
            found = largest_violation(robot, (moved,), states, spacing, resolution, at_first=(x,))
            if max(found.radians, found.metres) <= resolution:
                seen -= found.largest
                break
            # less than at the first states
            seen = (seen - max(found.radians, found.metres)).clip(min=0.0)
        else:
            seen = np.where(np.isinf(seen), seen, 0.0)
        turns = ~thin[3:6]
        if turns.any():
            turned = spacing * max(robot.turn_rate, robot.dof)
            furthest = np.linalg.norm(x[:, 3:6], axis=1).max() + ROTATION_RATE * turned
            flips = furthest + seen[0] > np.pi and (lower[3:6] != -upper[3:6])[turns].any()
            seen[0] = 0.0 if flips else seen[0] / ROTATION_RATE
        if not thin[9]:
            turned = np.abs(np.diff(robot.kinematics.joint_values(q), axis=0)).sum(axis=1)
            moved_m = max(longest_lever(robot, region), 1.0) * turned
            nearest = (0.5 * (x[:-1, 7] + x[1:, 7] - moved_m)).min(initial=x[:, 7].min())
            seen[0] *= 0.5  # the other half is for what moves the hand
            seen[1] = min(seen[1], max(nearest, 0.0) * np.sin(min(seen[0], 0.5 * np.pi)))
        slack = np.minimum(slack, seen.clip(min=0.0))
    return float(slack[0]), float(slack[1])


def evenly_spaced(states: np.ndarray, spacing: float) -> np.ndarray:
    """Cut the segments between states (m, n) into pieces of at most `spacing` [rad]."""
    return _cut(states, parts_within(states, spacing))


def _displacements(robot: Robot, region: TaskSpaceRegion, states: np.ndarray) -> np.ndarray:
    """Return displacements (m, 10) as `report.displacements`, of all states (m, n) at once."""
    poses = poses_at_once(robot, states, region.end_effector)
    return displaced(region, poses, region.reference_poses(robot, states), needed=True)


def _cut(states: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Cut segment k between states (m, n) into counts[k] pieces."""
    segment, part = numbered_parts(counts)
    ends = states_between(states, segment, (part + 1) / counts[segment])
    return np.concatenate([states[:1], ends])
