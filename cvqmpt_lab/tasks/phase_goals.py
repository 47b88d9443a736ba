"""Goals of the phases of a task: configurations from which the next phase can begin."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.inverse_kinematics import SAMPLE_MARGIN, sample_region
from cvqmpt_lab.constraints.task_space_region import TOLERANCE
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.pipeline import MAX_GOALS
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.tasks.task import Move, PlannedPhase, Slide, Task, Turn
from cvqmpt_lab.tasks.world import World

DOOR_MARGIN = 5e-4  # [m] in place of SAMPLE_MARGIN with a door in the hand


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


class PhaseGoals(NamedTuple):
    """Goal configurations of a phase."""

    configurations: np.ndarray  # (m, n) [rad or m]
    reason: str = ""  # why there are none, or ""


def following(task: Task, k: int) -> tuple[int, PlannedPhase] | None:
    """Number of the first planned phase from k on, and that phase; None when there is none."""
    for number, phase in enumerate(task.phases[k:], start=k):
        if isinstance(phase, PlannedPhase):
            return number, phase
    return None


def world_before(task: Task, world: World, k: int, number: int) -> World:
    """The world before phase `number`, from that before phase k;
    the phases between are not planned.
    """
    for phase in task.phases[k:number]:
        world = world.after(phase)
    return world


def phase_problems(task: Task, paths: Sequence[np.ndarray]) -> Iterator[PlanningProblem]:
    """The problems, without goals, of the planned phases whose paths, states (m, n) each, are
    given.
    """
    world, begin = World.before(task), 0
    for states in paths:
        ahead = following(task, begin)
        assert ahead is not None, "more paths than planned phases"
        number, phase = ahead
        world = world_before(task, world, begin, number)
        yield world.problem(task, phase)
        world, begin = world.moved(states[-1]), number + 1


def phase_goals(task: Task, k: int, world: World) -> PhaseGoals:
    """Goals of planned phase k from which the planned phase after it can begin."""
    phase, after = task.phases[k], following(task, k + 1)
    assert isinstance(phase, PlannedPhase)
    problem, effort = world.problem(task, phase), EFFORT[type(phase)]
    if after is None or not EFFORT[type(after[1])].grasps:
        return _sampled(problem, phase, effort.goals, effort.poses)
    ahead = EFFORT[type(after[1])]
    found = _sampled(problem, phase, ahead.first_goals, effort.poses)
    good: list[np.ndarray] = []
    for goal in found.configurations:
        if len(good) < ahead.grasps and _goes_on(task, k, world.moved(goal)):
            good.append(goal)
    if found.reason or good:
        return PhaseGoals(np.array(good).reshape(-1, problem.robot.dof), found.reason)
    reason = f"none of {len(found.configurations)} goals lets {after[1].name!r} reach its own"
    return PhaseGoals(found.configurations[:0], reason)


def prepare(task: Task, k: int, world: World) -> None:
    """Build the collision checkers for sampling goals, which is not timed, as spaces of planners
    are not.
    """
    phase, after = task.phases[k], following(task, k + 1)
    assert isinstance(phase, PlannedPhase)
    _checker(world.problem(task, phase))
    if isinstance(phase, Move) and after and isinstance(after[1], Turn):
        later = world_before(task, world, k + 1, after[0])
        _checker(later.problem(task, after[1]))


def _goes_on(task: Task, k: int, world: World) -> bool:
    """Whether the slide or turn after phase k has goals from a world."""
    after = following(task, k + 1)
    assert after is not None
    try:
        problem = world_before(task, world, k + 1, after[0]).problem(task, after[1])
    except InvalidInputError:  # what is grasped there is too far
        return False
    if _checker(problem).in_collision(problem.start):
        return False
    effort = EFFORT[type(after[1])]
    found = _sampled(problem, after[1], effort.goals_ahead, effort.poses_ahead)
    return len(found.configurations) >= effort.goals_ahead


def _sampled(problem: PlanningProblem, phase: PlannedPhase, count: int, poses: int) -> PhaseGoals:
    """Up to count goals of a phase's problem; the samples depend on the start alone.

    Slides and turns get goals near the start's posture: others could be reached only by letting go.
    Goals of a move are drawn within its constraint only if none of the region alone keeps it.
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
    if isinstance(phase, Move) and len(found.configurations):
        off = np.linalg.norm(problem.manifold.residual(found.configurations), axis=1)
        if (off > TOLERANCE).all():
            found = drawn(rng=problem.random_stream(), within=problem.constraint)
        else:
            found = replace(found, configurations=found.configurations[off <= TOLERANCE])
    if len(found.configurations):
        return PhaseGoals(found.configurations)
    return PhaseGoals(found.configurations, f"no goal: {found.outcome}")


def _checker(problem: PlanningProblem) -> CollisionChecker:
    """The checker for starts and goals;
    its margin is smaller with a door, which is 1 mm from its neighbour.
    """
    return problem.collision_checker(
        DOOR_MARGIN if "articulated" in problem.robot.source else SAMPLE_MARGIN
    )
