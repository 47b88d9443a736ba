"""Starts and goals that can be used: checks of a problem by kinematics and exact collision checks.

`PlanningProblem` is data. It asks for `drawn_start`, `checked_functions` and `check_lengths` by the
table of providers in `cvqmpt_lab/__init__.py` when it is made or loaded; planning calls the rest.
"""

from collections.abc import Iterator

import numpy as np

from cvqmpt_lab.base.errors import InvalidProblemError
from cvqmpt_lab.base.values import FloatArray, frozen
from cvqmpt_lab.collision.carried import reach_with
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.goals import SAMPLE_MARGIN_M, find_in_region
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.region_constraint import functions_of
from cvqmpt_lab.constraints.report import broken_bound
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, displacements
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.pairs import cure_of_overlap
from cvqmpt_lab.scene.scene import check_extent, refuse_far_poses


def drawn_start(problem: PlanningProblem) -> FloatArray:
    """Draw the start (n,) in the start region and constraint; always the same one."""
    assert problem.start_region is not None
    checker, rng = World.of(problem).checker(SAMPLE_MARGIN_M), np.random.default_rng(0)
    found = find_in_region(
        problem.robot, problem.start_region, checker, rng, count=1, within=problem.constraint
    )
    if len(found.configurations) == 0:
        check_extent(problem.scene, reach_with(problem.robot, problem.attachments))
        from cvqmpt_lab.constraints.no_goal import why_none  # for errors alone

        why = why_none(problem.robot, problem.start_region, checker, problem.constraint)
        raise InvalidProblemError(
            f"{problem.name}: no start in 'start_region': {found.outcome}; {why}"
        )
    return frozen(found.configurations[0])


def checked_functions(problem: PlanningProblem, given: FloatArray) -> FloatArray:
    """Check the functions of the constraint at the start; return the goals (k, n) [rad or m].

    The problem turns endless joints of goals to within half a turn of the start. If a function does
    not hold at the turned goal, but at the given one (k, n), the goal is not turned.
    """
    from cvqmpt_lab.constraints.function_checks import check_function  # few problems have one

    for function in functions_of(problem.constraint):
        check_function(function, problem.robot, problem.start)
    if np.array_equal(given, problem.goals):
        return problem.goals
    inside = ((given >= problem.robot.lower) & (given <= problem.robot.upper)).all(axis=1)
    off, turned_off = (
        np.linalg.norm(problem.manifold.residual(states), axis=1)
        for states in (given, problem.goals)
    )
    kept = inside & (off <= PROJECTION_TOLERANCE) & (turned_off > PROJECTION_TOLERANCE)
    return frozen(np.where(kept[:, None], given, problem.goals))


def check_lengths(problem: PlanningProblem) -> None:
    """Refuse lengths that cannot be metres; warn when nothing of the scene is within reach."""
    check_extent(problem.scene, reach_with(problem.robot, problem.attachments))
    regions = {
        f"constraint[{k}]": region
        for k, region in enumerate(problem.constraint)
        if isinstance(region, TaskSpaceRegion)
    }
    if problem.goal_region is not None:
        regions["goal_region"] = problem.goal_region
    refuse_far_poses({f"{where}: its frame": region.T0_w for where, region in regions.items()})


def why_no_goal(problem: PlanningProblem, world: World | None = None) -> str:
    """Return why no configuration was found for the goal region, in words; see `why_none`.

    Args:
        problem: the problem.
        world: its world; None: it is made here.
    """
    from cvqmpt_lab.constraints.no_goal import why_none  # for errors alone

    assert problem.goal_region is not None
    checker = (world or World.of(problem)).checker(SAMPLE_MARGIN_M)
    return why_none(problem.robot, problem.goal_region, checker, problem.constraint)


def check_problem(problem: PlanningProblem, world: World | None = None) -> None:
    """Refuse a start or goal in collision, off the manifold or outside the goal region.

    Args:
        problem: the problem.
        world: its world; None: it is made here.
    """
    for _, what, cure in _faults(problem, world or World.of(problem), problem.goals):
        raise InvalidProblemError(f"{problem.name}: {what}; {cure}")


def usable_goals(
    problem: PlanningProblem, goals: np.ndarray, world: World | None = None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the goals that `check_problem` accepts, and why each other one is left out.

    InvalidProblemError: the start is refused, or every goal.

    Args:
        problem: the problem.
        goals: (k, n) [rad or m].
        world: the world of the problem; None: it is made here.
    """
    left_out: dict[int, str] = {}
    for k, what, cure in _faults(problem, world or World.of(problem), goals):
        left_out.setdefault(k, what)
        if k < 0 or len(left_out) == len(goals):
            several = f"none of {len(left_out)} goals can be used: " if len(left_out) > 1 else ""
            raise InvalidProblemError(f"{problem.name}: {several}{what}; {cure}")
    return frozen(np.delete(goals, [*left_out], axis=0)), tuple(left_out.values())


def _faults(
    problem: PlanningProblem, world: World, goals: np.ndarray
) -> Iterator[tuple[int, str, str]]:
    """Number of a goal of (k, n), or -1 for the start; why it cannot be used; and the cure."""
    checker = world.checker()
    states = np.vstack([problem.start, goals])
    off = np.linalg.norm(problem.manifold.residual(states), axis=1) > PROJECTION_TOLERANCE
    for k, q in enumerate(states, start=-1):
        label = "start" if k < 0 else f"goal {k}"
        if checker.in_collision(q):
            gap = (
                ", or leave 1 mm between what is carried and what it stands on"
                if problem.attachments
                else ""
            )
            found = f"{label} is in collision: {checker.contact(q)}"
            pair = checker.colliding_pair(q)
            known = cure_of_overlap(problem.robot, (pair.first, pair.second)) if pair else ""
            cure = f"{_base_inside(checker)}choose another configuration{gap}"
            yield k, found, "; ".join(filter(None, (cure, known)))
        if off[k + 1]:
            yield k, *_off_manifold(problem, goals, label, q)
    if problem.goal_region is None:
        return
    lower, upper = problem.goal_region.bounds.T
    x = displacements(problem.robot, problem.goal_region, goals)
    outside = np.maximum(lower - x, x - upper).max(axis=1)
    for k in np.flatnonzero(outside > 1e-3).tolist():
        yield (
            k,
            f"goal {k} lies outside 'goal_region' by {outside[k]:.4f} (rad or m)",
            "take out 'goals', and new ones are drawn from the region, or 'goal_region'",
        )


def _base_inside(checker: CollisionChecker, least_m: float = 1e-3) -> str:
    """Return a remark that the robot's base stands inside an obstacle, and the cure; or ""."""
    depth, pair = checker.standing_inside()
    if pair is None or -depth < least_m:
        return ""
    return (
        f"the base stands in an obstacle, too ({pair.first} is {-1e3 * depth:.0f} mm inside "
        f"{pair.second}): move {pair.second}, or the robot by its field 'base'; or "
    )


def with_projected_start(problem: PlanningProblem) -> PlanningProblem:
    """Return the problem with its start projected by Algorithm 1; refuse it if that fails."""
    start = problem.manifold.project(problem.start)
    if start is None:
        raise InvalidProblemError(
            f"{problem.name}: the projection of the start fails: "
            + "; ".join(_off_manifold(problem, problem.goals, "start", problem.start, False))
        )
    return problem.changed(start=frozen(start))


def _off_manifold(
    problem: PlanningProblem, goals: np.ndarray, label: str, q: np.ndarray, projects: bool = True
) -> tuple[str, str]:
    """Return the violated bound and a suggested fix.

    Args:
        problem: its constraint.
        goals: all goals (k, n); if they are drawn from a region and none satisfies the constraint,
            the region is blamed.
        label: name of the start or goal.
        q: its configuration (n,) [rad or m].
        projects: whether the projection of the start may be advised: it has not failed.
    """
    from cvqmpt_lab.constraints.no_goal import contradiction, other_axis  # for errors alone

    states, broken = q[None], f"{label} breaks"
    cure = "`cvqmpt ik` finds configurations that keep the constraint"
    if label == "start":
        cure += ", --project-start moves this one onto it" if projects else ""
        for k, region in enumerate(problem.constraint):
            if not isinstance(region, TaskSpaceRegion):
                continue
            if axis := other_axis(region, problem.robot.pose(q, region.end_effector)):
                cure = f"{axis} in constraint[{k}], or choose another start"
    if label != "start" and problem.goal_region is not None:
        residuals = np.linalg.norm(problem.manifold.residual(goals), axis=1)
        if residuals.min() > PROJECTION_TOLERANCE:
            states, broken = (
                goals,
                f"'goal_region' leaves the constraint: the best of {len(goals)} goals in it breaks",
            )
            cure = "move or turn the region, or widen the bound"
    bounds = [
        broken_bound(region, displacements(problem.robot, region, states))
        for region in problem.regions
    ] + [
        function.describe()
        for function in problem.manifold.functions
        if np.linalg.norm(function.residual(states), axis=1).min() > PROJECTION_TOLERANCE
    ]
    if against := contradiction(problem.robot, problem.constraint):
        cure = f"{against}; move, widen or leave out a region"
    off = np.linalg.norm(problem.manifold.residual(states), axis=1).min()
    violated = ", ".join(filter(None, bounds)) or "the constraint by rounding"
    return f"{broken} {violated}, |F| = {off:.3g}", cure
