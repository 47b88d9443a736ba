"""The certificate of a path: an independent check of all states, also between waypoints.

It uses no compiled function of the planners: pinocchio computes poses, coal distances.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.base.polyline import nearest_places, step_lengths
from cvqmpt_lab.base.values import bound_text
from cvqmpt_lab.certificate.between_states import (
    function_violation,
    largest_violation,
    least_slack,
)
from cvqmpt_lab.certificate.motion_proof import LeastDistance, prove_free
from cvqmpt_lab.collision.carried import reach_with
from cvqmpt_lab.collision.exact import CollisionChecker, checker_of
from cvqmpt_lab.constraints.bounds_between import longest_lever
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegionChain
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import JointPath

CHECK_SPACING_RAD = 0.11  # largest distance of states at which the constraint is evaluated first
CERTIFICATE_TOLERANCE = 5e-4  # allowed violation of the constraint, also between states [m, rad]
MAX_STEP_RAD = 0.11  # largest distance of neighbouring states of the path
END_TOLERANCE_RAD = 1e-6  # at start and goal


class Verdict(StrEnum):
    """Verdict of a certificate; a path is certified only if it is VALID."""

    VALID = "certified"  # no fault, and every state is proven
    REFUSED = "refused"  # a fault was found
    NOT_PROVEN = "not proven"  # no fault was found, but a stretch could not be proven


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
    VELOCITY_JUMP = "velocity_jump"
    ACCELERATION = "acceleration"
    JERK = "jerk"
    EFFORT = "effort"
    TORQUE_RATE = "torque_rate"
    FRAME_SPEED = "frame_speed"
    FRAME_TURNING_SPEED = "frame_turning_speed"
    CURRENT = "current"


class Fault(NamedTuple):
    """A fault of a path."""

    kind: FaultKind
    text: str
    # place on the path: number of a state, 12.5 is between states 12 and 13. None: the whole path
    at: float | None = None


class Clearance(NamedTuple):
    """Least distance of pieces on a path: at_least_m <= true least distance <= distance_m.

    Without exact clearances, `at_least_m` alone is known.
    """

    distance_m: float  # the least that was found; negative in collision; nan if not measured
    at_least_m: float  # proven of every state; -inf if nothing is proven
    pair: str  # names of the two pieces; "" if not measured
    at: float  # place on the path, as `Fault.at`; nan if not measured

    @property
    def measured(self) -> bool:
        """Whether the least distance was measured, with its pair and place."""
        return not np.isnan(self.distance_m)


class Deviation(NamedTuple):
    """Deviations of a motion, of which each alone breaks no bound of positive width.

    With both of the first two at once no bound is broken, either.
    """

    # deviation of every point of the robot and its load: no collision, no bound of position broken
    points_m: float
    hand_rad: float  # rotation of the hand about its origin: no bound broken
    joints: float  # deviation of all joints at once: no collision, no bound broken [rad or m]

    def __str__(self) -> str:
        """Return the deviation in words."""
        hand, joints = bound_text(self.hand_rad, up=False), bound_text(self.joints, up=False)
        turn = f", a hand turned by {hand} rad" if np.isfinite(self.hand_rad) else ""
        if not np.isfinite(self.points_m):
            return f"any position of its points{turn}"
        points = bound_text(1e3 * self.points_m, up=False)
        return f"points {points} mm off{turn}; joints {joints} rad off"


@dataclass(frozen=True)
class Certificate:
    """Result of `certify`."""

    faults: tuple[Fault, ...]
    max_violation_rad: float  # largest rotation outside the constraint's bounds
    max_violation_m: float  # largest translation outside the constraint's bounds
    # the smaller one of the two clearances; inf without pairs, nan if they were not measured
    min_clearance_m: float
    states_checked: int  # number of states at which distances were compared
    unproven_rad: float = 0.0  # length of the longest stretch not proven free with a free middle
    unproven_m: float = 0.0  # largest motion of a point of the robot in half of that stretch
    # from obstacles, and of the robot's own pieces; None without pairs
    obstacle_clearance: Clearance | None = None
    self_clearance: Clearance | None = None
    # None without exact clearances, and where the constraint has functions
    tolerated: Deviation | None = None
    max_violation_function: float = 0.0  # largest |F_i| of functions of the user's own
    # states at which functions without a bound were checked; 0: the constraint is proven everywhere
    constraint_states: int = 0

    @property
    def verdict(self) -> Verdict:
        """Verdict: VALID without faults, NOT_PROVEN if only proofs are missing, else REFUSED."""
        if not self.faults:
            return Verdict.VALID
        missing = all(fault.kind is FaultKind.NOT_PROVEN for fault in self.faults)
        return Verdict.NOT_PROVEN if missing else Verdict.REFUSED

    @property
    def valid(self) -> bool:
        """Whether there is no fault and every state is proven."""
        return self.verdict is Verdict.VALID

    @property
    def constraint_gap(self) -> str:
        """Says at how many states a constraint without a bound was checked; "" if all is proven."""
        if not self.constraint_states:
            return ""
        return f"constraint checked at {self.constraint_states} states, not proven between"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Texts of the faults."""
        return tuple(fault.text for fault in self.faults)

    @property
    def closest(self) -> Clearance | None:
        """The smaller one of the two clearances; None without pairs, or if not measured."""
        clearances = filter(None, (self.obstacle_clearance, self.self_clearance))
        measured = [clearance for clearance in clearances if clearance.measured]
        return min(measured, key=lambda clearance: clearance.distance_m, default=None)


def certify(
    problem: PlanningProblem,
    path: JointPath,
    checker: CollisionChecker | None = None,
    exact_clearance: bool = False,
) -> Certificate:
    """Check all states of a path q(s), and its ends.

    Checked are collisions, joint limits and `|F(q(s))|` <= CERTIFICATE_TOLERANCE.

    Args:
        problem: start, goals, constraint, robot and scene.
        path: straight joint motions between states.
        checker: the exact checker; None: the problem's checker.
        exact_clearance: whether the least distances and the tolerated deviation are computed;
            this takes two to three times as long. Else the clearances are lower bounds, which
            the proof of the motion shows anyway.
    """
    checker = checker or checker_of(problem)
    unusable = _unusable(problem, path.states)
    if unusable:
        return Certificate(unusable, np.nan, np.nan, np.nan, 0)
    violation = largest_violation(
        problem.robot, problem.regions, path.states, CHECK_SPACING_RAD, CERTIFICATE_TOLERANCE
    )
    functions = [
        function_violation(function, path.states, CHECK_SPACING_RAD, CERTIFICATE_TOLERANCE)
        for function in problem.manifold.functions
    ]
    proof = prove_free(checker, path.states, exact_clearance)
    faults = [*_end_faults(problem, path), *_motion_faults(problem, path)]
    if violation.at is not None and violation.largest > CERTIFICATE_TOLERANCE:
        kind = FaultKind.MANIFOLD
        text = f"off the manifold by {violation.radians:.2g} rad, {violation.metres:.2g} m"
        if max(violation.radians, violation.metres) <= CERTIFICATE_TOLERANCE:
            kind = FaultKind.NOT_PROVEN
            text += (
                f" at the checked states, not proven to be less than {violation.largest:.2g} "
                "between them"
            )
        faults.append(Fault(kind, text, _place(path.states, violation.at)))
    faults += [
        Fault(
            FaultKind.NOT_PROVEN if found.largest <= CERTIFICATE_TOLERANCE else FaultKind.MANIFOLD,
            found.text,
            _place(path.states, found.at),
        )
        for found in functions
        if found.text
    ]
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
    missing = problem.robot.nothing_collides
    if missing and problem.scene.obstacles:
        compared = "only what it carries" if problem.carried else "nothing"
        text = f"{compared} is compared with {len(problem.scene.obstacles)} obstacles: {missing}"
        faults.append(Fault(FaultKind.NOT_PROVEN, text))
    proven_free = proof.colliding is None and proof.unproven is None
    proven_m = problem.clearance if proven_free else -np.inf
    to_obstacles, to_itself = (
        _clearance(path.states, *found, checker.margin)
        for found in (
            (proof.obstacles, proof.kept[0], proven_m),
            (proof.itself, proof.kept[1], -np.inf),
        )
    )
    found = [item for item in (to_obstacles, to_itself) if item]
    tolerated = None
    if exact_clearance and not functions:
        clearances = (to_obstacles, to_itself)
        tolerated = deviation_tolerated(problem, path.states, clearances, checker.margin)
    return Certificate(
        faults=tuple(faults),
        max_violation_rad=violation.radians,
        max_violation_m=violation.metres,
        min_clearance_m=min((item.distance_m for item in found), default=np.inf),
        states_checked=proof.checks,
        unproven_rad=proof.unproven.length if proof.unproven else 0.0,
        unproven_m=moved,
        obstacle_clearance=to_obstacles,
        self_clearance=to_itself,
        tolerated=tolerated,
        max_violation_function=max((found.largest for found in functions), default=0.0),
        constraint_states=sum(found.unproven_states for found in functions),
    )


def deviation_tolerated(
    problem: PlanningProblem,
    states: np.ndarray,
    clearances: tuple[Clearance | None, Clearance | None],
    deviation: float = 0.0,
) -> Deviation:
    """Compute the largest deviation from a path that its clearances and its constraint tolerate.

    Args:
        problem: the constraint, and the robot with what it carries.
        states: the path (m, n) [rad or m].
        clearances: from obstacles, and of the robot's own pieces.
        deviation: deviation of the motion from straight lines between states [m].
    """
    from cvqmpt_lab.certificate.tolerated import levers_of  # for exact clearances alone

    robot, regions = problem.robot, problem.regions
    to_obstacles, to_itself = clearances
    free = [np.inf]
    if to_obstacles:
        free.append(to_obstacles.at_least_m)
    if to_itself:
        free.append(to_itself.at_least_m / 2)  # both pieces of the pair may move
    points, hand = max(min(free) - deviation, 0.0), np.inf
    # bounds on translation and rotation of a region's frame by all joints together
    moved, turned = points, hand
    arms = [float(np.linalg.norm(np.linalg.inv(region.Tw_e)[:3, 3])) for region in regions]
    for region, arm in zip(regions, arms, strict=True):
        radians, metres = least_slack(robot, (region,), states, CHECK_SPACING_RAD)
        frame = levers_of(robot, region)
        if deviation > 0.0:  # of the points, between the motion and the straight lines
            metres = max(metres - frame.way * deviation, 0.0)
            radians = max(radians - frame.turn * deviation, 0.0)
        moved, turned = min(moved, metres), min(turned, radians)
        # both links of a relative region move, so its lever is twice the reach
        links = 2 if isinstance(region, TaskSpaceRegionChain) else 1
        lever = arm if links == 1 else 2.0 * (robot.reach + arm)
        share = 0.5 if lever > 0.0 else 1.0  # the other half is for what turns through the lever
        if np.isfinite(metres):
            points = min(points, share * metres / links, metres / frame.way)
        hand = min(hand, radians / links, metres / (2.0 * lever) if lever > 0.0 else np.inf)
    carried = reach_with(robot, problem.attachments) - robot.reach
    levers = robot.levers(max([carried, *arms]))
    for region in regions:
        hand_moves = region.end_effector in (None, *robot.end_effectors)
        # a region that hangs on a link moves with it; other frames may lie outside of the bodies
        if isinstance(region, TaskSpaceRegionChain) or not hand_moves:
            levers = np.maximum(levers, longest_lever(robot, region))
    joints = min(moved / levers.sum(), turned / max(robot.turn_rate, 1.0))
    return Deviation(float(points), float(hand), float(joints))


def _place(states: np.ndarray, q: np.ndarray) -> float:
    """Return the place of a configuration (n,) on a path (m, n), as `Fault.at`."""
    return float(nearest_places(states, q[None])[0][0])


def _clearance(
    states: np.ndarray,
    least: LeastDistance | None,
    kept: float,
    proven_m: float,
    apart_m: float,
) -> Clearance | None:
    """Return the clearance on a motion; None without a pair.

    Args:
        states: (m, n) on the straight pieces that stand for the motion [rad or m].
        least: least distance on the straight pieces, or None if it was not measured.
        kept: distance that every state on the straight pieces keeps [m], see `MotionProof`.
        proven_m: distance that is proven of every state in addition [m].
        apart_m: largest distance of robot points in the motion from the straight pieces [m].
    """
    if least is None:
        proven = max(kept - apart_m, proven_m)
        return None if kept == np.inf else Clearance(np.nan, proven, "", np.nan)
    if least.pair is None:
        return None
    proven = max(least.distance - least.bound - apart_m, proven_m)
    return Clearance(least.distance, proven, str(least.pair), _place(states, least.q))


def _unusable(
    problem: PlanningProblem, states: np.ndarray, far: float = 100.0
) -> tuple[Fault, ...]:
    """Find faults of states that are no path of this robot, or too far away for a proof.

    Args:
        problem: the robot.
        states: (m, n) [rad or m], or an array of another shape.
        far: no proof is tried further than this outside the joint limits, or if the path is longer
            than this and MAX_STEP_RAD a step [rad or m].
    """
    if np.ndim(states) != 2 or np.shape(states)[1] != problem.robot.dof or len(states) < 2:
        text = (
            f"states have shape {np.shape(states)}, a path needs (2 or more, {problem.robot.dof})"
        )
        return (Fault(FaultKind.SHAPE, text),)
    finite = np.isfinite(states).all(axis=1)
    if not finite.all():
        return (Fault(FaultKind.SHAPE, "a state is not finite", float(finite.argmin())),)
    with np.errstate(over="ignore"):
        too_long = JointPath(states).length > MAX_STEP_RAD * (len(states) - 1) + far
        beyond = np.maximum(problem.robot.lower - states, states - problem.robot.upper).max()
        return tuple(_motion_faults(problem, JointPath(states))) if too_long or beyond > far else ()


def _end_faults(problem: PlanningProblem, path: JointPath) -> list[Fault]:
    """Find faults at the start and at the end of a path."""
    faults = []
    apart = problem.robot.differences
    if np.abs(apart(path.states[0], problem.start)).max() > END_TOLERANCE_RAD:
        faults.append(Fault(FaultKind.START, "does not begin at the start", 0.0))
    end = path.states[-1]
    off = np.abs(apart(problem.goals, end)).max(axis=1)
    at_goal = off.min(initial=np.inf) <= END_TOLERANCE_RAD
    if not at_goal and problem.goal_region is not None:
        region = (problem.goal_region,)
        at_end = largest_violation(
            problem.robot, region, end[None], CHECK_SPACING_RAD, CERTIFICATE_TOLERANCE
        )
        at_goal = at_end.largest <= CERTIFICATE_TOLERANCE
    if not at_goal:
        faults.append(Fault(FaultKind.GOAL, "does not end at a goal", len(path.states) - 1.0))
    return faults


def _motion_faults(problem: PlanningProblem, path: JointPath) -> list[Fault]:
    """Find long steps and states outside the joint limits."""
    faults, states = [], path.states
    steps = step_lengths(states)
    if steps.max() > MAX_STEP_RAD:
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
