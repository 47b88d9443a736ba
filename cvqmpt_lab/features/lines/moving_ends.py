"""Paths that begin or end in the direction in which the arm moves there.

Such a path goes straight on from the start as far as the arm needs to stop, and only then where the
planner leads it; in the same way it reaches the goal.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.polyline import cut, step_lengths
from cvqmpt_lab.certificate.certificate import certify
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.usable import with_projected_start
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.robot import JointLimits
from cvqmpt_lab.search.result import JointPath


def solve_on_the_move(
    problem: PlanningProblem,
    velocities: tuple[np.ndarray | None, np.ndarray | None],
    limits: JointLimits,
    solve: Callable[[PlanningProblem], Solution],
    exact_clearance: bool = False,
) -> Solution:
    """Solve a problem by a path that begins, and ends, in the direction of given velocities.

    Args:
        problem: the problem.
        velocities: (n,) of the joints at the start and at the goal [rad/s or m/s]; None: at rest.
        limits: limits that the motion along the path will keep.
        solve: plans between the places where the arm can stop.
        exact_clearance: as in `certify`.

    Raises InvalidInputError if the problem has no goal configurations for a velocity at the end.
    """
    begin, end = (_stopping(velocity, limits) for velocity in velocities)
    if end.any() and len(problem.goals) == 0:
        raise InvalidInputError(
            "an end velocity goes with goal configurations; this problem has a goal region: give "
            "--goal, or leave --end-velocity out"
        )
    between = problem.changed(start=problem.start + begin, goals=problem.goals - end)
    if begin.any():
        between = with_projected_start(between)
    found = solve(between)
    if found.path is None or found.simplified is None:
        return found
    states = found.path.states
    last = states[-1] + end
    # the first and last waypoints lie exactly in the directions of motion
    whole = [problem.start, problem.start + 0.7 * begin, *states, last - 0.7 * end, last]
    moving = np.array(whole)[np.append(True, step_lengths(np.array(whole)) > 1e-8)]
    path = JointPath(cut(moving, np.ceil(step_lengths(moving) / 0.1).astype(int)))
    return replace(
        found,
        problem=problem,
        simplified=replace(found.simplified, path=path),
        certificate=certify(problem, path, exact_clearance=exact_clearance),
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
