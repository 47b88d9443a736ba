"""Paths that begin or end in the direction in which the arm moves there.

Such a path goes straight on from the start as far as the arm needs to stop, and only then where the
planner leads it; in the same way it reaches the goal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.polyline import cut, step_lengths
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.usable import with_projected_start
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import JointLimits
from cvqmpt_lab.search.result import JointPath

Velocity = Sequence[float] | np.ndarray


@dataclass(frozen=True, eq=False)
class MovingEnds:
    """Straight pieces at both ends of a path, on which the arm gets up to speed and stops."""

    problem: PlanningProblem  # of the whole path
    begin: np.ndarray  # (n,) from the start [rad or m]; 0: the arm starts at rest
    end: np.ndarray  # (n,) to the goal [rad or m]; 0: it ends at rest

    @classmethod
    def of(
        cls, problem: PlanningProblem, velocities: Sequence[Velocity | None], speed: float
    ) -> Self:
        """Return the pieces for given velocities.

        Args:
            problem: the problem.
            velocities: (n,) of the joints at the start and at the goal [rad/s or m/s]; None: at
                rest.
            speed: fraction of the limits that the motion along the path will use.

        Raises InvalidInputError if the problem has no goal configurations for a velocity at the
        end, or velocities are not one number a joint.
        """
        names, limits = problem.robot.joint_names, problem.robot.joint_limits.scaled(speed)
        pieces = []
        for which, velocity in zip(("start", "end"), velocities, strict=True):
            if velocity is not None and len(velocity) != len(names):
                raise InvalidInputError(
                    f"the {which} velocity has {len(velocity)} numbers; give {len(names)}, one "
                    f"each for {', '.join(names)}"
                )
            pieces.append(_stopping(None if velocity is None else np.array(velocity), limits))
        begin, end = pieces
        if end.any() and len(problem.goals) == 0:
            raise InvalidInputError(
                "an end velocity goes with goal configurations; this problem has a goal region: "
                "give --goal, or leave --end-velocity out"
            )
        return cls(problem, begin, end)

    @property
    def between(self) -> PlanningProblem:
        """The problem between the places where the arm can stop."""
        problem, begin, end = self.problem, self.begin, self.end
        between = problem.changed(start=problem.start + begin, goals=problem.goals - end)
        return with_projected_start(between) if begin.any() else between

    def joined(self, found: Solution, exact_clearance: bool = False) -> Solution:
        """Return a solution of `between` with the straight pieces at its ends, certified.

        exact_clearance: as in `certify`.
        """
        if found.path is None or found.simplified is None:
            return found
        states, begin, end = found.path.states, self.begin, self.end
        last, start = states[-1] + end, self.problem.start
        # the first and last waypoints lie exactly in the directions of motion
        whole = [start, start + 0.7 * begin, *states, last - 0.7 * end, last]
        moving = np.array(whole)[np.append(True, step_lengths(np.array(whole)) > 1e-8)]
        path = JointPath(cut(moving, np.ceil(step_lengths(moving) / 0.1).astype(int)))
        return replace(
            found,
            problem=self.problem,
            simplified=replace(found.simplified, path=path),
            certificate=certify(self.problem, path, exact_clearance=exact_clearance),
        )


def _stopping(
    velocity: np.ndarray | None, limits: JointLimits, spare: float = 1.5, corner: float = 0.01
) -> np.ndarray:
    """Return the straight displacement (n,) on which joints can stop.

    Args:
        velocity: (n,) of the joints [rad/s or m/s]; None: at rest.
        limits: limits of the joints.
        spare: factor on its length, for what slows the motion besides acceleration and jerk.
        corner: length that is added for the rounded corner behind it [rad or m].
    """
    speed = 0.0 if velocity is None else float(np.linalg.norm(velocity))
    if velocity is None or speed == 0.0:
        return np.zeros(len(limits.joint_names))
    direction = velocity / speed
    share = np.abs(direction)
    most = 1.0 / (share / limits.acceleration).max()
    seconds = speed / (2.0 * most)
    if limits.jerk is not None:
        seconds += most * (share / limits.jerk).max()
    return (spare * seconds * speed + corner) * direction
