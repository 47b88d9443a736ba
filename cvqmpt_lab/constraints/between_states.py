"""The largest violation of task-space regions along a path, between its states as well."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.constraints.report import displacements
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
    more than BEND / 8 D^2 (or RATE / 2 D near angle pi, where its sign changes).

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
        q, use = begin, _use(robot, region, begin, displacements(robot, region, begin))
        for _ in range(ROUNDS):
            doubtful = use.highest + use.between > tolerance
            if use.outside.max() > tolerance or not doubtful.any():
                break
            allowed = np.maximum(tolerance - use.highest, 1e-3 * use.between)
            ratio = use.between / allowed
            parts = np.clip(
                np.ceil(np.where(use.flips, ratio, np.sqrt(ratio))), 2, most_parts
            ).astype(int)
            counts = np.where(doubtful, parts, 1)
            known, q = np.concatenate([[0], np.cumsum(counts)]), _cut(q, counts)
            x, new = np.empty((len(q), 6)), np.ones(len(q), dtype=bool)
            new[known] = False
            x[known], x[new] = use.x, displacements(robot, region, q[new])
            use = _use(robot, region, q, x)
        radians, metres = max(radians, use.radians), max(metres, use.metres)
        highest = max(highest, float((use.highest + use.between).max(initial=use.outside.max())))
        if use.outside.max() > most:
            most, at = float(use.outside.max()), q[int(use.outside.argmax())]
    return Violation(radians, metres, highest, at)


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


class _Use(NamedTuple):
    """A region along m states, and the m - 1 stretches between them."""

    x: np.ndarray  # (m, 6) displacements [m, rad]
    outside: np.ndarray  # (m,) distance outside the bounds, negative inside [m, rad]
    radians: float  # Largest of the rotation entries [rad]
    metres: float  # Largest of the positions [m]
    highest: np.ndarray  # (m - 1,) the larger `outside` of a stretch's ends [m, rad]
    between: np.ndarray  # (m - 1,) what may be added inside the stretch [m, rad]
    # (m - 1,) bool, whether the rotation vector may change its sign: `between` is linear
    flips: np.ndarray


def _use(robot: Robot, region: TaskSpaceRegion, q: np.ndarray, x: np.ndarray) -> _Use:
    """The region along states q (m, n) with displacements x (m, 6)."""
    (lower, upper), rows = region.Bw.T, region.bounded_rows
    excess = np.full_like(x, -np.inf)
    excess[:, rows] = np.maximum(lower - x, x - upper)[:, rows]
    outside = excess.max(axis=1)
    change = np.abs(np.diff(q, axis=0))
    slides = robot.kinematics.prismatic
    turn, slide = change[:, ~slides].sum(1), change[:, slides].sum(1)
    angle = np.linalg.norm(x[:, 3:], axis=1)
    flips = np.maximum(angle[:-1], angle[1:]) + RATE * turn > np.pi
    rotation = np.where(flips, 0.5 * RATE * turn, BEND / 8.0 * turn**2)
    lever = 2.0 * robot.reach + np.linalg.norm(np.linalg.inv(region.Tw_e)[:3, 3])
    position = 0.25 * turn * (lever * turn + slide)
    between = np.maximum(rotation * bool((rows >= 3).any()), position * bool((rows < 3).any()))
    return _Use(
        x,
        outside,
        max(float(excess[:, 3:].max()), 0.0),
        max(float(excess[:, :3].max()), 0.0),
        np.maximum(outside[:-1], outside[1:]),
        between,
        flips,
    )
