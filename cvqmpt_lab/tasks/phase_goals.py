"""Goals of the phases of a task: configurations from which the next phase can begin."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.task_space_region import TOLERANCE
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import MAX_GOALS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.tasks.task import HandPhase, Move, PlannedPhase, Slide, Task, Turn
from cvqmpt_lab.tasks.world import World


class Effort(NamedTuple):
    """Numbers of samples for the goals of a kind of phase."""

    goals: int  # sought; those of slides and turns differ only in posture
    poses: int  # of the end effector that are tried for them
    first_goals: int = 0  # sought by the phase before
    grasps: int = 0  # how many of those must allow goals of this phase
    # goals of this phase that a grasp must allow: one with fewer is near a joint limit
    goals_ahead: int = 0
    poses_ahead: int = 0  # of the end effector that are tried for them


EFFORT: dict[type, Effort] = {
    Move: Effort(goals=MAX_GOALS, poses=100),
    Slide: Effort(goals=3, poses=3, first_goals=8, grasps=5, goals_ahead=1, poses_ahead=1),
    Turn: Effort(goals=10, poses=25, first_goals=20, grasps=2, goals_ahead=5, poses_ahead=8),
}


def phase_problems(task: Task, paths: Sequence[np.ndarray]) -> Iterator[PlanningProblem]:
    """The problems, without goals, of the planned phases whose paths (m, n) are given."""
    world = World.before(task)
    for (hand, phase), states in zip(task.planned, paths, strict=False):
        world = world.through(hand)
        yield world.problem(task, phase)
        world = world.moved(states[-1])


def phase_goals(task: Task, k: int, world: World) -> tuple[np.ndarray, str]:
    """Goals (m, n) [rad or m] of planned phase k from which the next can begin; "", or why none."""
    (_, phase), *later = task.planned[k : k + 2]
    problem, effort = world.problem(task, phase), EFFORT[type(phase)]
    ahead = EFFORT[type(later[0][1])] if later else None
    if ahead is None or not ahead.grasps:
        return _sampled(problem, phase, effort.goals, effort.poses)
    hand, after = later[0]
    found, reason = _sampled(problem, phase, ahead.first_goals, effort.poses)
    good: list[np.ndarray] = []
    for goal in found:
        if len(good) < ahead.grasps and _goes_on(task, hand, after, world.moved(goal)):
            good.append(goal)
    if not good and not reason:
        reason = f"none of {len(found)} goals lets {after.name!r} reach its own"
    return np.array(good).reshape(-1, problem.robot.dof), reason


def prepare(task: Task, k: int, world: World) -> None:
    """Build the collision checkers for sampling goals; as spaces of planners, it is not timed."""
    (_, phase), *later = task.planned[k : k + 2]
    _checker(world.problem(task, phase))
    for hand, after in later:
        if isinstance(phase, Move) and isinstance(after, Turn):
            _checker(world.through(hand).problem(task, after))


def _goes_on(task: Task, hand: Sequence[HandPhase], after: PlannedPhase, world: World) -> bool:
    """Whether the slide or turn after phases of the hand has goals from a world."""
    try:
        problem = world.through(hand).problem(task, after)
    except InvalidInputError:
        # what is grasped there is too far
        return False
    if _checker(problem).in_collision(problem.start):
        return False
    effort = EFFORT[type(after)]
    found, _ = _sampled(problem, after, effort.goals_ahead, effort.poses_ahead)
    return len(found) >= effort.goals_ahead


def _sampled(
    problem: PlanningProblem, phase: PlannedPhase, count: int, poses: int
) -> tuple[np.ndarray, str]:
    """Up to count goals of a phase's problem; the samples depend on the start alone.

    Slides and turns get goals near the start's posture: most others require letting go. Goals of a
    move are drawn within its constraint only if none of the region alone keeps it.
    """
    assert problem.goal_region is not None
    drawn = partial(
        sample_region,
        problem.robot,
        problem.goal_region,
        _checker(problem),
        count=count,
        max_poses=poses,
        near=None if isinstance(phase, Move) else problem.start,
    )
    within = problem.constraint if isinstance(phase, Turn) else ()
    found = drawn(rng=problem.random_stream(), within=within)
    goals = found.configurations
    if isinstance(phase, Move) and len(goals):
        off = np.linalg.norm(problem.manifold.residual(goals), axis=1)
        goals = goals[off <= TOLERANCE]
        if len(goals) == 0:
            found = drawn(rng=problem.random_stream(), within=problem.constraint)
            goals = found.configurations
    return goals, "" if len(goals) else f"no goal: {found.outcome}"


def _checker(problem: PlanningProblem, door_margin: float = 5e-4) -> CollisionChecker:
    """The checker for starts and goals; with a door in hand its margin is door_margin [m]."""
    held = "articulated" in problem.robot.source
    return problem.collision_checker(door_margin if held else SAMPLE_MARGIN)
