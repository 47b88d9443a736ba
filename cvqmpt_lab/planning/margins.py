"""Planning with a margin for tracking error: to obstacles, and to the bounds of the constraint."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, InvalidProblemError, few
from cvqmpt_lab.certificate.certificate import certify, deviation_tolerated
from cvqmpt_lab.collision.exact import checker_of
from cvqmpt_lab.constraints.goals import Goals, goals_of
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.task_space_region import UNITS, TaskSpaceRegion, displacements, excess
from cvqmpt_lab.planning.solution import Solution
from cvqmpt_lab.planning.usable import usable_goals
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import JointPath


class Margin(NamedTuple):
    """Margin for tracking error of the robot and its hand."""

    metres: float = 0.002  # distance to obstacles and to bounds of position [m]
    radians: float = 0.005  # distance to bounds of rotation, tilt and bearing [rad]

    def check(self) -> Self:
        """Return this margin; refuse one below 0, above 0.1 m or above 0.2 rad."""
        limits = (("margin", self.metres, 0.1, "m"), ("margin angle", self.radians, 0.2, "rad"))
        for name, value, most, unit in limits:
            if not 0.0 <= value <= most:
                raise InvalidInputError(f"{name} {value}: give a number from 0 to {most} {unit}")
        return self


NO_MARGIN = Margin(0.0, 0.0)


class Kept(NamedTuple):
    """The margin that a path keeps."""

    used: Margin | None  # None: none is kept
    asked: Margin
    why: str = ""  # the reason if less is kept than was asked for
    without: str = ""  # functions of the constraint, to whose bounds no margin is kept, in words

    def __str__(self) -> str:
        """Return the margin in words, with the reason if it is smaller."""
        if self.asked == NO_MARGIN:
            return "none requested"
        if self.used is None:
            return f"none of {_text(self.asked)}: {self.why}"
        used = _text(self.used)
        text = f"{used} of {_text(self.asked)}: {self.why}" if self.why else used
        return f"{text}; none to the bounds of {self.without}" if self.without else text


def with_margin(
    problem: PlanningProblem, goals: np.ndarray, margin: Margin
) -> tuple[PlanningProblem, Margin, str]:
    """Tighten bounds by a margin, limited by the slack of start and goals.

    Bounds of width 0 do not change, such as those of a hand that holds a door.

    Args:
        problem: the problem.
        goals: its goals (k, n) [rad or m].
        margin: for tracking error.

    Returns:
        The tighter problem, the margin used, and the reason if it is smaller.
    """
    reasons, clearances, slacks = [], [], []
    checker = checker_of(problem)
    for name, states in (("start", problem.start[None]), ("best goal", goals)):
        # distance to obstacles [m] and slack in bounds [rad, m] of the best state
        found = (checker.nearest_obstacle(q) for q in states)
        nearest = max(found, key=lambda it: it.distance)
        clearance = max(nearest.distance - 1e-4, 0.0)  # 0.1 mm for rounding errors of the kernels
        slack = _slack(problem, states)
        clearances.append(clearance)
        slacks.append(slack)
        if clearance < margin.metres:
            reasons.append(f"the {name} is {1e3 * clearance:.1f} mm from {nearest.pair}")
        if slack[0] < margin.radians or slack[1] < margin.metres:
            reasons.append(f"the {name} is near a bound")
    radians, moved = np.minimum(np.min(slacks, axis=0), (margin.radians, margin.metres)).tolist()
    clearance = min(margin.metres, *clearances)
    inner = problem.changed(
        clearance=max(problem.clearance, clearance),
        constraint=tuple(
            member.inset(moved, radians) if isinstance(member, TaskSpaceRegion) else member
            for member in problem.constraint
        ),
    )
    return inner, Margin(min(clearance, moved), radians), "; ".join(reasons)


def _slack(problem: PlanningProblem, states: np.ndarray) -> tuple[float, float]:
    """Return the largest slack [rad] and [m] of states (k, n) in bounds of positive width."""
    slack = np.full((len(states), len(UNITS)), np.inf)
    for region in problem.regions:
        inside = -excess(region, displacements(problem.robot, region, states))
        # projected states may be outside of bounds by the tolerance
        inside = (inside - PROJECTION_TOLERANCE).clip(min=0.0)
        slack = np.minimum(slack, np.where(region.wide, inside, np.inf))
    radians, metres = (float(slack[:, unit == UNITS].min(axis=1).max()) for unit in ("rad", "m"))
    return radians, metres


Solve = Callable[[PlanningProblem, Goals | None, float], Solution]
"""Solves a problem, given its goals (None: they are drawn) and the share of the budget to use."""


def keep_margin(problem: PlanningProblem, margin: Margin, solve: Solve) -> tuple[Solution, Kept]:
    """Solve a problem with a margin; if there is no path, solve it without.

    Each of the two runs has half of the budget.

    Args:
        problem: the problem.
        margin: for tracking error.
        solve: one run, `pipeline.solve` with its settings.

    Returns:
        The solution; a tolerated deviation in its certificate is with respect to the given problem.
        And the margin that it keeps.
    """
    if margin.check() == NO_MARGIN:
        return solve(problem, None, 1.0), Kept(None, margin)
    goals = goals_of(problem)
    if len(goals.configurations) == 0:
        return solve(problem, goals, 1.0), Kept(None, margin, "no goal")
    inner, used, why = with_margin(problem, goals.configurations, margin)
    found: Solution | None = None
    try:
        found = solve(inner, goals, 0.5)
    except InvalidProblemError as error:
        why = "; ".join(filter(None, (why, str(error))))
    if found is None or not found.solved:
        if found is not None:
            status = found.status.replace("_", " ")
            why = "; ".join(filter(None, (why, f"no path with this margin: {status}")))
        return solve(problem, goals, 0.5), Kept(None, margin, why)
    assert found.certificate is not None and found.path is not None
    tolerated = found.certificate.tolerated
    if tolerated is not None:
        clearances = (found.certificate.obstacle_clearance, found.certificate.self_clearance)
        tolerated = deviation_tolerated(problem, found.path.states, clearances)
    found = replace(
        found,
        problem=problem,
        left_out=_left_out(problem, goals.configurations, found.left_out, used),
        certificate=replace(found.certificate, tolerated=tolerated),
        goal_seconds=goals.seconds,
    )
    functions = few((one.describe() for one in problem.manifold.functions), 3)
    return found, Kept(used, margin, why, functions)


def _left_out(
    problem: PlanningProblem, goals: np.ndarray, texts: tuple[str, ...], margin: Margin
) -> tuple[str, ...]:
    """Return why goals were left out, with the bounds of the problem instead of tighter ones.

    Args:
        problem: the problem.
        goals: all its goals (k, n) [rad or m].
        texts: reasons with the margin, each of which begins with "goal" and its number.
        margin: what was kept.
    """
    if not texts:
        return ()
    _, own = usable_goals(problem, goals)
    why = {tuple(text.split()[:2]): text for text in own}
    labels = [tuple(text.split()[:2]) for text in texts]
    less = f"keeps less than the margin, {_text(margin)}"
    return tuple(why.get(label, f"{' '.join(label)} {less}") for label in labels)


def kept_by(problem: PlanningProblem, path: JointPath, kept: Kept) -> Kept:
    """Return the margin of a whole path, of which a part between its ends keeps `kept`.

    Args:
        problem: the problem of the whole path.
        path: the path, from the start to a goal.
        kept: margin of the part.
    """
    if kept.used is None:
        return kept
    goal = path.states[-1:]
    _, used, why = with_margin(problem, goal, kept.asked)
    least = Margin(*np.minimum(used, kept.used).tolist())
    if least != used and kept.why:
        why = "; ".join(filter(None, (why, f"between its straight ends: {kept.why}")))
    less = "; ".join(filter(None, (why, "its straight ends keep no more")))
    metres, radians = Margin(least.metres, 0.0), Margin(0.0, least.radians)
    for one, reason in ((least, why), (metres, less), (radians, less)):
        inner, _, _ = with_margin(problem, goal, one)
        if one != NO_MARGIN and certify(inner, path).valid:
            return Kept(one, kept.asked, reason, kept.without)
    return Kept(None, kept.asked, less)


def _text(margin: Margin) -> str:
    """Return a margin in words."""
    return f"{1e3 * margin.metres:.3g} mm, {margin.radians:.3g} rad"
