"""The certificate of a path: an independent check of every state, also between the path's own.

It uses no compiled function of the planners: pinocchio gives poses, coal distances.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.certificate.between_states import largest_violation, least_slack
from cvqmpt_lab.certificate.motion_proof import Least, prove_free
from cvqmpt_lab.collision.carried import reach_with
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegionChain
from cvqmpt_lab.geometry.polyline import nearest_places, step_lengths
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import JointPath

SPACING = 0.11  # [rad] between states at which the constraint is evaluated first
TOLERANCE = 5e-4  # [m, rad] constraint violation allowed, between states too
LARGEST_STEP = 0.11  # [rad] between neighbouring states of the path itself
END_TOLERANCE = 1e-6  # [rad] at start and goal
FAR = 100.0  # [rad or m] beyond limits, or of length beyond LARGEST_STEP a step: no proof is tried


class Verdict(StrEnum):
    """Result of a certificate; a path is certified only if it is VALID."""

    VALID = "valid"  # no fault, and every state proven
    REFUSED = "refused"  # a fault was found
    NOT_PROVEN = "not proven"  # none was found, but a stretch could not be proven


class FaultKind(StrEnum):
    """Kinds of faults of a path."""

    SHAPE = "shape"
    START = "start"
    GOAL = "goal"
    STEP = "step"
    LIMITS = "limits"
    MANIFOLD = "manifold"
    COLLISION = "collision"
    NOT_PROVEN = "not_proven"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    JERK = "jerk"
    EFFORT = "effort"
    TORQUE_RATE = "torque_rate"
    CURRENT = "current"


class Fault(NamedTuple):
    """A fault of a path."""

    kind: FaultKind
    text: str
    # number of a state; 12.5 is half-way from state 12 to 13. None: the whole path
    at: float | None = None


class Clearance(NamedTuple):
    """The least distance of pieces on a path: at_least_m <= true least distance <= distance_m."""

    distance_m: float  # [m], the least one found; negative in collision
    at_least_m: float  # [m], what every state is proven to keep; -inf where nothing is proven
    pair: str  # the two pieces it is between
    at: float  # where it was found, as `Fault.at`


class Deviation(NamedTuple):
    """How far a motion may be off without a collision or a broken bound of positive width."""

    points_m: float  # every point of the robot and of what it carries [m]
    hand_rad: float  # turn of the hand [rad]
    joints: float  # all joints at once; points and hand then stay within the above [rad or m]

    def __str__(self) -> str:
        """In words."""
        turn = f", a hand turned by {self.hand_rad:.2g} rad" if np.isfinite(self.hand_rad) else ""
        if not np.isfinite(self.points_m):
            return f"any position of its points{turn}"
        return f"points {1e3 * self.points_m:.2g} mm off{turn}; joints {self.joints:.2g} rad off"


@dataclass(frozen=True)
class Certificate:
    """The result of `certify`."""

    faults: tuple[Fault, ...]
    max_violation_rad: float  # largest rotation outside the constraint's bounds [rad]
    max_violation_m: float  # largest translation outside them [m]
    # the smaller one of the two clearances below [m]; inf without pairs, nan when not asked for
    min_clearance_m: float
    states_checked: int  # configurations at which distances were compared
    min_clearance_pair: str = ""  # the two pieces it is between
    min_clearance_at: float | None = None  # where it was found, as `Fault.at`
    unproven_rad: float = 0.0  # longest stretch not proven free although its middle is free [rad]
    # the furthest that a point of the robot can move in half of that stretch [m]
    unproven_m: float = 0.0
    # from obstacles, and of the robot's own pieces; None without pairs, or when not asked for
    obstacle_clearance: Clearance | None = None
    self_clearance: Clearance | None = None
    tolerated: Deviation | None = None  # None when not asked for

    @property
    def verdict(self) -> Verdict:
        """VALID without faults, NOT_PROVEN if only proofs are missing, else REFUSED."""
        if not self.faults:
            return Verdict.VALID
        missing = all(fault.kind is FaultKind.NOT_PROVEN for fault in self.faults)
        return Verdict.NOT_PROVEN if missing else Verdict.REFUSED

    @property
    def valid(self) -> bool:
        """Whether there is no fault and every state is proven."""
        return self.verdict is Verdict.VALID

    @property
    def reasons(self) -> tuple[str, ...]:
        """The faults in words."""
        return tuple(fault.text for fault in self.faults)


def certify(
    problem: PlanningProblem,
    path: JointPath,
    checker: CollisionChecker | None = None,
    clearance: bool = True,
) -> Certificate:
    """Check all states of a path q(s): collisions, limits, `|F(q(s))|` <= TOLERANCE; and its ends.

    Args:
        problem: start, goals, constraint, robot and scene.
        path: straight joint motions between states.
        checker: the exact checker; None for the problem's own.
        clearance: whether the least distances are found and proven.
    """
    checker = checker or problem.collision_checker()
    unusable = _unusable(problem, path.states)
    if unusable:
        return Certificate(unusable, np.nan, np.nan, np.nan, 0)
    violation = largest_violation(
        problem.robot, problem.constraint, path.states, SPACING, TOLERANCE
    )
    proof = prove_free(checker, path.states, clearance)
    faults = [*_end_faults(problem, path), *_motion_faults(problem, path)]
    if violation.at is not None and violation.largest > TOLERANCE:
        seen = max(violation.radians, violation.metres) > TOLERANCE
        kind = FaultKind.MANIFOLD if seen else FaultKind.NOT_PROVEN
        text = f"off the manifold by {violation.radians:.2g} rad, {violation.metres:.2g} m"
        if not seen:
            text += (
                f" where it was looked at, not shown to be less than {violation.largest:.2g} in "
                "between"
            )
        faults.append(Fault(kind, text, _place(path.states, violation.at)))
    if proof.colliding is not None:
        text = f"in collision: {checker.contact(proof.colliding)}"
        faults.append(Fault(FaultKind.COLLISION, text, _place(path.states, proof.colliding)))
    moved = 0.0
    if proof.unproven is not None:
        length, q, hull = proof.unproven
        moved, (gap, pair) = checker.moved(q, hull), checker.nearest(q)
        text = (
            f"not proven free over {length:.1g} rad, {1e3 * moved:.1g} mm to each side of the "
            f"middle, where {pair} are {1e3 * gap:.2g} mm apart"
        )
        faults.append(Fault(FaultKind.NOT_PROVEN, text, _place(path.states, q)))
    proven_free = proof.colliding is None and proof.unproven is None
    kept = (problem.clearance if proven_free else -np.inf, -np.inf)
    rooms = [
        _clearance(path.states, *of)
        for of in zip((proof.obstacles, proof.itself), kept, strict=True)
    ]
    closest = min(filter(None, rooms), key=lambda room: room.distance_m, default=None)
    least_m = np.inf if clearance else np.nan
    return Certificate(
        faults=tuple(faults),
        max_violation_rad=violation.radians,
        max_violation_m=violation.metres,
        min_clearance_m=closest.distance_m if closest else least_m,
        states_checked=proof.looks,
        min_clearance_pair=closest.pair if closest else "",
        min_clearance_at=closest.at if closest else None,
        unproven_rad=proof.unproven.length if proof.unproven else 0.0,
        unproven_m=moved,
        obstacle_clearance=rooms[0],
        self_clearance=rooms[1],
        tolerated=deviation_tolerated(problem, path.states, rooms, checker.margin)
        if clearance
        else None,
    )


def deviation_tolerated(
    problem: PlanningProblem,
    states: np.ndarray,
    rooms: Sequence[Clearance | None],
    apart: float = 0.0,
) -> Deviation:
    """How far a motion may be off.

    Args:
        problem: its constraint, and the robot with what it carries.
        states: the path (m, n) [rad or m].
        rooms: distances from obstacles, and of the robot's own pieces.
        apart: of the motion from straight lines between states [m].
    """
    robot, regions = problem.robot, problem.constraint
    turned, moved = least_slack(robot, regions, states, SPACING)
    # both pieces of a pair of the robot's own may come closer
    free = [room.at_least_m / k for k, room in enumerate(rooms, start=1) if room]
    points = max(min([moved, *free]) - apart, 0.0)
    hand = max(turned - apart, 0.0)
    carried = reach_with(robot, problem.attachments) - robot.reach
    arms = [float(np.linalg.norm(np.linalg.inv(region.Tw_e)[:3, 3])) for region in regions]
    levers = robot.levers(max([carried, *arms]))
    if any(isinstance(region, TaskSpaceRegionChain) for region in regions):
        # seen from what it hangs on, which turns too, the hand is no further away than this
        levers = np.maximum(levers, 2.0 * robot.reach)
    hinges = (~robot.kinematics.prismatic).sum()
    return Deviation(points, hand, float(min(points / levers.sum(), hand / max(hinges, 1))))


def _place(states: np.ndarray, q: np.ndarray) -> float:
    """Where on a path (m, n) a configuration (n,) lies, as `Fault.at`."""
    return float(nearest_places(states, q[None])[0][0])


def _clearance(states: np.ndarray, least: Least | None, kept: float) -> Clearance | None:
    """The least distance along a path (m, n) for people; None without a pair.

    kept: distance [m] that the proof has shown beside.
    """
    if least is None or least.pair is None:
        return None
    proven = max(least.distance - least.bound, kept)
    return Clearance(least.distance, proven, str(least.pair), _place(states, least.q))


def _unusable(problem: PlanningProblem, states: np.ndarray) -> tuple[Fault, ...]:
    """Faults of states that are no path of this robot, or too far away for a proof."""
    if np.ndim(states) != 2 or np.shape(states)[1] != problem.robot.dof or len(states) < 2:
        text = (
            f"states have shape {np.shape(states)}, a path needs (2 or more, {problem.robot.dof})"
        )
        return (Fault(FaultKind.SHAPE, text),)
    finite = np.isfinite(states).all(axis=1)
    if not finite.all():
        return (Fault(FaultKind.SHAPE, "a state is not finite", float(finite.argmin())),)
    with np.errstate(over="ignore"):
        too_long = JointPath(states).length > LARGEST_STEP * (len(states) - 1) + FAR
        beyond = np.maximum(problem.robot.lower - states, states - problem.robot.upper).max()
        return tuple(_motion_faults(problem, JointPath(states))) if too_long or beyond > FAR else ()


def _end_faults(problem: PlanningProblem, path: JointPath) -> list[Fault]:
    faults = []
    if np.abs(path.states[0] - problem.start).max() > END_TOLERANCE:
        faults.append(Fault(FaultKind.START, "does not begin at the start", 0.0))
    end = path.states[-1]
    at_goal = np.abs(problem.goals - end).max(axis=1).min(initial=np.inf) <= END_TOLERANCE
    if not at_goal and problem.goal_region is not None:
        there = largest_violation(
            problem.robot, (problem.goal_region,), end[None], SPACING, TOLERANCE
        )
        at_goal = there.largest <= TOLERANCE
    if not at_goal:
        faults.append(Fault(FaultKind.GOAL, "does not end at a goal", len(path.states) - 1.0))
    return faults


def _motion_faults(problem: PlanningProblem, path: JointPath) -> list[Fault]:
    faults, states = [], path.states
    steps = step_lengths(states)
    if steps.max() > LARGEST_STEP:
        faults.append(
            Fault(FaultKind.STEP, f"a step of {steps.max():.3g} rad", float(steps.argmax()))
        )
    beyond = np.maximum(problem.robot.lower - states, states - problem.robot.upper).max(axis=1)
    worst = int(beyond.argmax())
    outside = problem.robot.joint_outside_limits(states[worst])
    if outside is not None:
        text = f"{outside[0]} leaves its limits by {outside[1]:.2g}"
        faults.append(Fault(FaultKind.LIMITS, text, float(worst)))
    return faults
