"""Judgement of a motion that somebody else made: whole, or in parts as a policy sends them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.polyline import distances_along, states_at
from cvqmpt_lab.certificate.certificate import Fault
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.features.motion.checked_curves import DryRun
from cvqmpt_lab.features.motion.limit_use import Ends
from cvqmpt_lab.features.motion.motion_check import (
    StateFaults,
    dry_run,
    speed_within_limits,
)
from cvqmpt_lab.features.motion.trajectory import JointState, Motion
from cvqmpt_lab.problem import PlanningProblem


class Judgement(NamedTuple):
    """The check of a motion, and the speed that would keep every limit."""

    check: DryRun  # certificate, and the share of every limit that is used
    # factor on the motion's speed at which it is certified, with the same velocities at its ends:
    # 1.0 of a certified motion; None where slowing alone is no cure
    speed: float | None

    @property
    def certified(self) -> bool:
        """Whether the motion is certified."""
        return self.check.certificate.valid

    @property
    def first_fault(self) -> Fault | None:
        """The fault that comes first on the motion; None of a certified one."""
        faults = self.check.certificate.faults
        return min(faults, key=lambda fault: fault.at or 0.0, default=None)

    @property
    def clearance_m(self) -> float:
        """Least proven distance from obstacles [m]; -inf without a proof, inf without obstacles."""
        clearance = self.check.certificate.obstacle_clearance
        return float("inf") if clearance is None else clearance.at_least_m


class ClearanceAt(NamedTuple):
    """Distances at one state of a motion."""

    at: float  # time of the motion [s], or length along a path [rad or m]
    obstacles_m: float  # least distance from obstacles [m]; inf without any
    obstacles: str  # the nearest pair
    itself_m: float  # least distance of the robot's own pieces [m]
    itself: str  # the nearest pair


def clearance_along(
    problem: PlanningProblem, check: DryRun, count: int = 200
) -> Iterator[ClearanceAt]:
    """Yield the distances at `count` states, evenly in time, or along a path without times.

    Of a motion that stands for several curves, these are the least distances of all of them.
    """
    checker, (moments, states) = checker_of(problem), evenly(check, count)
    every = [states, *(evenly(other, count)[1] for other in check.others)]
    for k, moment in enumerate(moments.tolist()):
        obstacle, own = (
            min((nearest(rows[k]) for rows in every), key=lambda found: found.distance)
            for nearest in (checker.nearest_obstacle, checker.nearest_of_itself)
        )
        pairs = (str(found.pair or "") for found in (obstacle, own))
        yield ClearanceAt(moment, obstacle.distance, next(pairs), own.distance, next(pairs))


def evenly(check: DryRun, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return `count` times of a checked motion, or lengths along a path, and the states there."""
    marks = distances_along(check.states) if check.times is None else check.times
    at = np.linspace(marks[0], marks[-1], count)
    return at, states_at(check.states, marks, at)


def judge(
    motion: Motion,
    problem: PlanningProblem,
    last: JointState | None = None,
    ends: Ends | None = None,
    exact_clearance: bool = False,
    more_faults: StateFaults | None = None,
) -> Judgement:
    """Judge a path or trajectory: free, on the manifold, within limits, start and goal right.

    Args:
        motion: the motion, see `read_motion`.
        problem: start, goals, constraint, robot and scene.
        last: positions and velocities (n,) of the arm where a part of a longer motion begins, such
            as a chunk of a policy; it need not end at a goal. None: the motion is whole.
        ends: begin and end of the motion, instead of `last`; None: at rest, at the start and at a
            goal.
        exact_clearance: whether least distances are measured; this takes two to three times as
            long. Else they are lower bounds.
        more_faults: as in `dry_run`.

    Raises InvalidInputError as `dry_run`.
    """
    if last is not None:
        ends = Ends(last.positions, start_velocity=last.velocities, part=True)
    found = dry_run(problem, motion, ends, exact_clearance, more_faults)
    speed = 1.0 if found.certificate.valid else None
    if speed is None and found.limits_alone:
        speed = speed_within_limits(problem, motion, ends)
    return Judgement(found, speed)
