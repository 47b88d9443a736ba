"""An independent judgement of a path: shares no code with planners or kernels.

Poses come from pinocchio, distances from coal, rotation vectors from scipy. A path that fails is a
failure, whatever the planner says.
"""

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.constraints.report import displacements
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.planning.result import Path
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.exact_checker import CollisionChecker

RESOLUTION = 0.01  # [rad] between checked states
TOLERANCE = 1e-3  # [m, rad] constraint violation allowed between states
LARGEST_STEP = 0.11  # [rad] between neighbouring states of the path itself
END_TOLERANCE = 1e-6  # [rad] at start and goal
CLEARANCE_STATES = 64  # distances are measured at this many states, evenly spread


class FaultKind(StrEnum):
    """What can be wrong with a path."""

    SHAPE = "shape"
    START = "start"
    GOAL = "goal"
    STEP = "step"
    LIMITS = "limits"
    MANIFOLD = "manifold"
    COLLISION = "collision"


class Fault(NamedTuple):
    """One thing that is wrong with a path, and the sentence that says so."""

    kind: FaultKind
    text: str


@dataclass(frozen=True)
class Certificate:
    """Findings on one path; valid when there is no fault."""

    faults: tuple[Fault, ...]
    """What is wrong."""
    max_violation_rad: float
    """Largest turn outside the constraint's bounds [rad]."""
    max_violation_m: float
    """Largest shift outside them [m]."""
    min_clearance_m: float
    """Smallest distance found, at up to CLEARANCE_STATES states [m]; nan when not asked for."""
    states_checked: int
    """Configurations looked at."""

    @property
    def valid(self) -> bool:
        """Whether the path may be counted."""
        return not self.faults

    @property
    def reasons(self) -> tuple[str, ...]:
        """The faults in words."""
        return tuple(fault.text for fault in self.faults)


def certify(
    problem: PlanningProblem,
    path: Path,
    checker: CollisionChecker | None = None,
    clearance: bool = True,
    resolution: float = RESOLUTION,
) -> Certificate:
    """Check a path at `resolution` [rad]: collision, limits, constraint, step size, start and goal."""
    checker = checker or problem.collision_checker()
    unusable = _unusable(problem, path.states)
    if unusable:
        return Certificate((Fault(FaultKind.SHAPE, unusable),), np.nan, np.nan, np.nan, 0)
    states = _resampled(path.states, resolution)
    radians, metres = _violations(problem.robot, problem.constraint, states)
    faults = [*_end_faults(problem, path), *_motion_faults(problem, path, states)]
    if max(radians, metres) > TOLERANCE:
        faults.append(Fault(FaultKind.MANIFOLD, f"off the manifold by {radians:.2g} rad, {metres:.2g} m"))
    colliding = next((q for q in states if checker.in_collision(q)), None)
    if colliding is not None:
        faults.append(Fault(FaultKind.COLLISION, f"in collision: {checker.colliding_pair(colliding)}"))
    closest = np.nan
    if clearance:
        picks = np.unique(np.linspace(0, len(states) - 1, CLEARANCE_STATES).astype(int))
        closest = min(checker.clearance(states[i]) for i in picks)
    return Certificate(tuple(faults), radians, metres, closest, len(states))


def _unusable(problem: PlanningProblem, states: np.ndarray) -> str | None:
    """Why states are no path at all, or None."""
    if np.ndim(states) != 2 or np.shape(states)[1] != problem.robot.dof or len(states) < 2:
        return f"states have shape {np.shape(states)}, a path needs (2 or more, {problem.robot.dof})"
    return None if np.isfinite(states).all() else "a state is not finite"


def _resampled(states: np.ndarray, resolution: float) -> np.ndarray:
    """Path states (m, n) with straight segments cut into pieces of at most resolution."""
    pieces = [states[:1]]
    for a, b in pairwise(states):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / resolution)))
        pieces.append(a + np.arange(1, count + 1)[:, None] / count * (b - a))
    return np.concatenate(pieces)


def _violations(
    robot: Robot, regions: tuple[TaskSpaceRegion, ...], states: np.ndarray
) -> tuple[float, float]:
    """Largest distance outside the bounds over states (m, n), in [rad] and [m]."""
    radians = metres = 0.0
    for region in regions:
        x, (lower, upper) = displacements(robot, region, states), region.Bw.T
        free_turn = (lower[3:] <= -np.pi) & (upper[3:] >= np.pi)
        excess = np.maximum(lower - x, x - upper)
        radians = max(radians, float(excess[:, 3:][:, ~free_turn].max(initial=0.0)))
        metres = max(metres, float(excess[:, :3].max(initial=0.0)))
    return radians, metres


def _end_faults(problem: PlanningProblem, path: Path) -> list[Fault]:
    faults = []
    if np.abs(path.states[0] - problem.start).max() > END_TOLERANCE:
        faults.append(Fault(FaultKind.START, "does not begin at the start"))
    end = path.states[-1]
    at_goal = len(problem.goals) > 0 and np.abs(problem.goals - end).max(axis=1).min() <= END_TOLERANCE
    if not at_goal and problem.goal_region is not None:
        at_goal = max(_violations(problem.robot, (problem.goal_region,), end[None])) <= TOLERANCE
    return faults if at_goal else [*faults, Fault(FaultKind.GOAL, "does not end at a goal")]


def _motion_faults(problem: PlanningProblem, path: Path, states: np.ndarray) -> list[Fault]:
    faults = []
    largest = np.linalg.norm(np.diff(path.states, axis=0), axis=1).max(initial=0.0)
    if largest > LARGEST_STEP:
        faults.append(Fault(FaultKind.STEP, f"a step of {largest:.3f} rad"))
    for q in (states.min(axis=0), states.max(axis=0)):
        outside = problem.robot.joint_outside_limits(q)
        if outside is not None:
            faults.append(Fault(FaultKind.LIMITS, f"{outside[0]} leaves its limits by {outside[1]:.2g}"))
    return faults
