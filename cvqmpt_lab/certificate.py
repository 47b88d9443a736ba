"""The certificate of a path: an independent check of every state, also between the path's own.

It uses no compiled function of the planners: pinocchio gives poses, coal distances.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.collision.exact import CollisionChecker, Nearest
from cvqmpt_lab.collision.motion_proof import MotionProof, prove_free
from cvqmpt_lab.constraints.between_states import largest_violation
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
    CURRENT = "current"


class Fault(NamedTuple):
    """A fault of a path."""

    kind: FaultKind
    text: str
    # number of a state; 12.5 is half-way from state 12 to 13. None: the whole path
    at: float | None = None


@dataclass(frozen=True)
class Certificate:
    """The result of `certify`."""

    faults: tuple[Fault, ...]
    max_violation_rad: float  # largest rotation outside the constraint's bounds [rad]
    max_violation_m: float  # largest translation outside them [m]
    # smallest distance at the states with the least room [m]; nan when not asked for
    min_clearance_m: float
    states_checked: int  # configurations at which distances were compared
    min_clearance_pair: str = ""  # the two pieces it is between
    min_clearance_at: float | None = None  # where it was found, as `Fault.at`
    unproven_rad: float = 0.0  # longest stretch not proven free although its middle is free [rad]
    # the furthest that a point of the robot can move in half of that stretch [m]
    unproven_m: float = 0.0

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
        clearance: whether the smallest distance is measured.
    """
    checker = checker or problem.collision_checker()
    unusable = _unusable(problem, path.states)
    if unusable:
        return Certificate(unusable, np.nan, np.nan, np.nan, 0)
    violation = largest_violation(
        problem.robot, problem.constraint, path.states, SPACING, TOLERANCE
    )
    proof = prove_free(checker, path.states)
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
    near, where = _closest(checker, proof) if clearance else (Nearest(np.nan, None), path.states[0])
    return Certificate(
        faults=tuple(faults),
        max_violation_rad=violation.radians,
        max_violation_m=violation.metres,
        min_clearance_m=near.distance,
        states_checked=proof.looks,
        min_clearance_pair=str(near.pair or ""),
        min_clearance_at=_place(path.states, where) if near.pair else None,
        unproven_rad=proof.unproven.length if proof.unproven else 0.0,
        unproven_m=moved,
    )


def _place(states: np.ndarray, q: np.ndarray) -> float:
    """Where on a path (m, n) a configuration (n,) lies, as `Fault.at`."""
    steps = np.diff(states, axis=0)
    squared = np.maximum(np.einsum("kj,kj->k", steps, steps), np.finfo(float).tiny)
    share = np.clip(np.einsum("kj,kj->k", q - states[:-1], steps) / squared, 0.0, 1.0)
    off = np.linalg.norm(states[:-1] + share[:, None] * steps - q, axis=1)
    return float(off.argmin() + share[off.argmin()])


def _closest(
    checker: CollisionChecker, proof: MotionProof, most: int = 8
) -> tuple[Nearest, np.ndarray]:
    """The smallest distance at up to `most` states with the least room, and its state (n,)."""
    places = proof.tightest[:most] if proof.colliding is None else [proof.colliding]
    return min(((checker.nearest(q), q) for q in places), key=lambda found: found[0].distance)


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
    steps = np.linalg.norm(np.diff(states, axis=0), axis=1)
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
