"""Planning with a margin: inside of bounds, and away from obstacles, by what an arm may be off."""

from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, InvalidProblemError
from cvqmpt_lab.certificate.certificate import deviation_tolerated
from cvqmpt_lab.constraints.goals import Goals, goals_of
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.report import displacements, excess
from cvqmpt_lab.planning.pipeline import Solution, solve
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.method import Method
from cvqmpt_lab.search.result import Budget


class Margin(NamedTuple):
    """By how much the robot and its hand may be off."""

    metres: float = 0.002  # from obstacles, and within bounds of position [m]
    radians: float = 0.005  # within bounds of rotation and tilt [rad]

    def check(self) -> Self:
        """Itself; refuse a margin below 0, and one that is larger than 0.1 m or 0.2 rad."""
        limits = ("margin", self.metres, 0.1, "m"), ("margin angle", self.radians, 0.2, "rad")
        for name, value, most, unit in limits:
            if not 0.0 <= value <= most:
                raise InvalidInputError(f"{name} {value}: give a number from 0 to {most} {unit}")
        return self


NO_MARGIN = Margin(0.0, 0.0)


def with_margin(
    problem: PlanningProblem, goals: np.ndarray, margin: Margin
) -> tuple[PlanningProblem, Margin, str]:
    """Tighten bounds by a margin, limited by the slack of start and goals.

    Bounds of width 0 stay, such as those of a hand that holds a door.

    Args:
        problem: the problem.
        goals: its goals (k, n) [rad or m].
        margin: of tracking error.

    Returns:
        The tighter problem, the margin used, and the reason if it is smaller.
    """
    why, rooms, slacks, checker = [], [], [], problem.collision_checker()
    for what, states in (("start", problem.start[None]), ("best goal", goals)):
        # distance from obstacles [m] and slack in bounds [rad, m] of the best state
        found = (checker.nearest_obstacle(q) for q in states)
        nearest = max(found, key=lambda it: it.distance)
        room = max(nearest.distance - 1e-4, 0.0)  # 0.1 mm for rounding of the kernels
        slack = _slack(problem, states)
        rooms.append(room)
        slacks.append(slack)
        if room < margin.metres:
            why.append(f"the {what} is {1e3 * room:.1f} mm from {nearest.pair}")
        if slack[0] < margin.radians or slack[1] < margin.metres:
            why.append(f"the {what} is near a bound")
    radians, moved = np.minimum(np.min(slacks, axis=0), (margin.radians, margin.metres)).tolist()
    room = min(margin.metres, *rooms)
    inner = problem.changed(
        clearance=max(problem.clearance, room),
        constraint=tuple(region.inset(moved, radians) for region in problem.constraint),
    )
    return inner, Margin(min(room, moved), radians), "; ".join(why)


def _slack(problem: PlanningProblem, states: np.ndarray) -> tuple[float, float]:
    """Slack [rad] and [m] in bounds of positive width of the best of states (k, n)."""
    most = np.full((len(states), 7), np.inf)
    for region in problem.constraint:
        inside = -excess(region, displacements(problem.robot, region, states))
        # what projection may leave
        most = np.minimum(
            most, np.where(region.wide, (inside - PROJECTION_TOLERANCE).clip(min=0.0), np.inf)
        )
    return float(most[:, 3:].min(axis=1).max()), float(most[:, :3].min(axis=1).max())


def solve_with_margin(
    problem: PlanningProblem,
    method: Method | str,
    budget: Budget,
    seed: int,
    margin: Margin,
    **options: Any,
) -> tuple[Solution, str]:
    """Solve inside by a margin, and with half of the budget without where that finds no path.

    Args: as `pipeline.solve`.

    Returns:
        The solution, whose certificate says what is tolerated by the problem that was asked; which
        margin it has, and why not all of it.
    """
    margin.check()
    if margin == NO_MARGIN:
        return solve(problem, method, budget, seed, **options), "none asked for"
    goals: Goals = options.pop("goals", None) or goals_of(problem)
    if len(goals.configurations) == 0:
        return solve(problem, method, budget, seed, goals=goals, **options), "none: no goal"
    inner, used, why = with_margin(problem, goals.configurations, margin)
    found: Solution | None = None
    try:
        found = solve(inner, method, budget.share(0.5), seed, goals=goals, **options)
    except InvalidProblemError as error:
        why = "; ".join(filter(None, (why, str(error))))
    if found is None or not found.solved:
        if found is not None:
            why = "; ".join(filter(None, (why, f"no path inside by it: {found.plan.status}")))
        plain = solve(problem, method, budget.share(0.5), seed, goals=goals, **options)
        return plain, f"none of {_text(margin)}: {why}"
    assert found.certificate is not None and found.path is not None
    rooms = (found.certificate.obstacle_clearance, found.certificate.self_clearance)
    tolerated = deviation_tolerated(problem, found.path.states, rooms)
    found = replace(
        found,
        problem=problem,
        certificate=replace(found.certificate, tolerated=tolerated),
        goal_seconds=goals.seconds,
    )
    return found, f"{_text(used)}{why and f' of {_text(margin)}: {why}'}"


def _text(margin: Margin) -> str:
    return f"{1e3 * margin.metres:.3g} mm, {margin.radians:.3g} rad"
