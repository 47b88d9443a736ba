"""The largest violation of task-space regions along a path, between its states as well."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.constraints.report import displacements, excess
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.robot.robot import Robot

# Bound on the second derivative of a rotation vector's entry per D^2, D = sum_j |dq_j|: |Jl^-1| is
# at most pi / 2, its derivative 1.29, and the angular velocity changes by half.
BEND = 2.81
# Bound on the first derivative per D, up to angle pi, where the rotation vector changes its sign.
RATE = 0.5 * np.pi
ROUNDS = 4  # how often stretches are cut


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
) -> Violation:
    """How far straight joint motions leave regions, between states too, by pinocchio.

    On a stretch with turns D = sum_j |dq_j|, no rotation entry exceeds the larger of its ends by
    more than BEND / 8 D^2 (or RATE / 2 D near angle pi, where its sign changes), and no tilt by
    more than D^2 / 8 (see `_between_tilts`).

    Args:
        robot: the robot.
        regions: the constraint.
        states: (m, n), m >= 1 [rad or m].
        spacing: between states checked at first [rad].
        tolerance: stretches are cut where the bound exceeds it and no state does [m, rad].
        most_parts: into how many a stretch is cut at once, up to ROUNDS times.
    """
    radians = metres = highest = 0.0
    at, most = None, -np.inf
    begin = evenly_spaced(states, spacing)
    for region in regions:
        q, x = begin, displacements(robot, region, begin)
        for rounds_left in range(ROUNDS, -1, -1):
            beyond = excess(region, x)
            outside = beyond.max(axis=1)
            at_ends = np.maximum(outside[:-1], outside[1:])
            between, flips = _between(robot, region, q, x)
            doubtful = at_ends + between > tolerance
            if rounds_left == 0 or outside.max() > tolerance or not doubtful.any():
                break
            ratio = between / np.maximum(tolerance - at_ends, 1e-3 * between)
            parts = np.ceil(np.where(flips, ratio, np.sqrt(ratio)))
            counts = np.where(doubtful, np.clip(parts, 2, most_parts).astype(int), 1)
            known, q = np.concatenate([[0], np.cumsum(counts)]), _cut(q, counts)
            new, before = np.ones(len(q), dtype=bool), x
            new[known], x = False, np.empty((len(q), 7))
            x[known], x[new] = before, displacements(robot, region, q[new])
        radians, metres = max(radians, beyond[:, 3:].max()), max(metres, beyond[:, :3].max())
        highest = max(highest, (at_ends + between).max(initial=outside.max()))
        if outside.max() > most:
            most, at = outside.max(), q[outside.argmax()]
    return Violation(float(radians), float(metres), float(highest), at)


def least_slack(
    robot: Robot,
    regions: Sequence[TaskSpaceRegion],
    states: np.ndarray,
    spacing: float,
    resolution: float = 2e-4,
) -> tuple[float, float]:
    """Proven slack [rad] and [m] of straight joint motions: a hand turned or moved by it stays in.

    Rows of width 0 have none and are left out; inf without others. Entries of the rotation vector
    change by up to RATE times the turn of the hand, and change signs at angle pi: where a path may
    come there and bounds are not symmetric, the slack is 0.

    Args: as `largest_violation`; resolution: what the proof may lose [m, rad].
    """
    slack = np.array([np.inf, np.inf])
    q = evenly_spaced(states, spacing)
    for region in regions:
        lower, upper = region.bounds.T
        thin = ~np.isin(np.arange(7), region.bounded_rows) | ~region.wide
        x = displacements(robot, region, q)
        inside = np.where(thin, np.inf, -excess(region, x).max(axis=0))
        seen = np.array([inside[3:].min(), inside[:3].min()]).clip(min=0.0)
        free = np.where(thin[:6, None], [-np.inf, np.inf], 0.0)
        for _ in range(ROUNDS if np.isfinite(seen).any() else 0):
            radians, metres = np.where(np.isinf(seen), 0.0, seen).tolist()
            moved = region.inset(metres, radians, share=0.5)
            moved = moved.changed(Bw=frozen(np.where(thin[:6, None], free, moved.Bw)))
            found = largest_violation(robot, (moved,), states, spacing, resolution)
            if max(found.radians, found.metres) <= resolution:
                seen -= found.largest
                break
            # less than at the states looked at first
            seen = (seen - max(found.radians, found.metres)).clip(min=0.0)
        else:
            seen = np.where(np.isinf(seen), seen, 0.0)
        turns = ~thin[3:6]
        if turns.any():
            furthest = np.linalg.norm(x[:, 3:6], axis=1).max() + RATE * spacing * robot.dof
            flips = furthest + seen[0] > np.pi and (lower[3:6] != -upper[3:6])[turns].any()
            seen[0] = 0.0 if flips else seen[0] / RATE
        slack = np.minimum(slack, seen.clip(min=0.0))
    return float(slack[0]), float(slack[1])


def evenly_spaced(states: np.ndarray, spacing: float) -> np.ndarray:
    """States (m, n) with segments cut into pieces of at most `spacing` [rad]."""
    lengths = np.linalg.norm(np.diff(states, axis=0), axis=1)
    counts = np.maximum(1, np.ceil(lengths / spacing)).astype(int)
    return _cut(states, counts)


def _cut(states: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """States (m, n) with segment k between them cut into counts[k] pieces."""
    segment = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + 1) / counts[
        segment
    ]
    cut = states[segment] + share[:, None] * (states[segment + 1] - states[segment])
    return np.concatenate([states[:1], cut])


def _between(
    robot: Robot, region: TaskSpaceRegion, q: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What may be added between m states q (m, n) to the larger `excess` of both.

    Args:
        robot: the robot.
        region: the region.
        q: (m, n) [rad or m].
        x: (m, 7), displacements [m, rad].

    Returns:
        The bound (m - 1,) [m, rad], and whether it is linear in the length of the stretch (m - 1,):
        where the rotation vector may change its sign, or the tilt comes close to pi.
    """
    change, rows = np.abs(np.diff(q, axis=0)), region.bounded_rows
    slides = robot.kinematics.prismatic
    turn, slide = change[:, ~slides].sum(1), change[:, slides].sum(1)
    angle = np.linalg.norm(x[:, 3:6], axis=1)
    flips = np.maximum(angle[:-1], angle[1:]) + RATE * turn > np.pi
    rotation = np.where(flips, 0.5 * RATE * turn, BEND / 8.0 * turn**2)
    lever = 2.0 * robot.reach + np.linalg.norm(np.linalg.inv(region.Tw_e)[:3, 3])
    position = 0.25 * turn * (lever * turn + slide)
    turns = bool(((rows >= 3) & (rows < 6)).any())
    between = np.maximum(rotation * turns, position * bool((rows < 3).any()))
    if 6 not in rows:
        return between, flips
    tilting, linear = _between_tilts(turn, x[:, 6])
    return np.maximum(between, tilting), linear | (flips & turns)


def _between_tilts(turn: np.ndarray, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far the tilt b may exceed the larger one of both ends of stretches.

    b is the angle between a fixed unit vector and z(s), which turns with angular velocity w(s), 0
    <= s <= 1. With |w| <= D = sum_j |dq_j|, |b'| <= D: b exceeds the larger end by at most D / 2.

    For the other bound let (b, p) be the polar angles of z on the sphere. The acceleration of z in
    the sphere has the part b'' - sin(b) cos(b) p'^2 along b. It is the part of w' x z + (w . z) w
    across z, at most |w'| + |w|^2 / 2. The axis of a joint is turned by the joints before it, so
    |w'| <= sum_{i < j} |dq_i| |dq_j| <= D^2 / 2. As sin(b) p' <= D, with c = max(0, -cot b),

        b'' >= -(1 + c) D^2,    b <= larger end + (1 + c) D^2 / 8,

    c at the largest tilt possible, the larger end + D / 2. At b = 0, where b has no derivative, b'
    only jumps upwards, which leaves the second bound true.

    Args:
        turn: D (m - 1,) [rad].
        tilt: (m,), at the ends [rad].

    Returns:
        The smaller one of both bounds (m - 1,) [rad], and whether it is the linear one (m - 1,).
    """
    largest = np.maximum(tilt[:-1], tilt[1:]) + 0.5 * turn
    c = np.maximum(0.0, -1.0 / np.tan(largest.clip(0.5 * np.pi, np.pi)))
    linear, bent = 0.5 * turn, (1.0 + c) / 8.0 * turn**2
    return np.minimum(linear, bent), linear < bent
