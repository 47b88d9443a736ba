"""State of a task at one time: the arm's configuration, the held object or door, the scene.

The goals of a phase are configurations from which the next phase can begin.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial, reduce
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.poses import pose, rotation_vectors
from cvqmpt_lab.collision.exact import CollisionChecker, checker_of
from cvqmpt_lab.constraints.goals import (
    MAX_GOALS,
    REGION_INSET,
    SAMPLE_MARGIN_M,
    near_goals,
    sample_region,
)
from cvqmpt_lab.constraints.project import PROJECTION_TOLERANCE
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.features.tasks.task import (
    Grasp,
    HandPhase,
    Hold,
    Move,
    PlannedPhase,
    Slide,
    Task,
    Turn,
)
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.robot.load import robot_from_source
from cvqmpt_lab.robot.mechanism import with_articulated_object
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.articulation import take_out
from cvqmpt_lab.scene.scene import Attachment, Scene, SceneObject
from cvqmpt_lab.scene.shapes import Cylinder, Sphere


class Load(NamedTuple):
    """A carried object."""

    item: SceneObject  # object at its pose in the scene before the grasp
    attachment: Attachment  # object in the hand


@dataclass(frozen=True, eq=False)
class World:
    """State of a task at one time."""

    source: Mapping[str, Any]  # description of the arm, with the gripper's current opening
    scene: Scene  # without the carried object; doors at their current values
    q: np.ndarray  # (n,) of the arm [rad or m]
    held: Load | Hold | None = None  # a carried object, or the phase that took hold of a door

    @staticmethod
    def before(task: Task) -> "World":
        """State at the start of a task."""
        return World(task.robot, task.scene, task.start)

    @property
    def arm(self) -> Robot:
        """The robot without the door it holds."""
        return robot_from_source(self.source)

    def problem(self, task: Task, phase: PlannedPhase) -> PlanningProblem:
        """The problem of a planned phase, without goals."""
        robot, scene, start = self.arm, self.scene, self.q
        attachments = (self.held.attachment,) if isinstance(self.held, Load) else ()
        constraint: tuple[TaskSpaceRegion, ...]
        match phase:
            case Move():
                constraint, goal = phase.constraint, phase.goal
            case Slide():
                T_world_hand = robot.pose(self.q)
                Bw = np.zeros((6, 2))
                # samples end REGION_INSET inside of bounds, and so must start and goal
                Bw[:3] = np.sort([(0.0, along) for along in phase.translation])
                Bw[:3][phase.translation != 0.0] += (-REGION_INSET, REGION_INSET)
                constraint = (TaskSpaceRegion(T_world_hand, np.eye(4), Bw),)
                there = T_world_hand @ pose(phase.translation)
                goal = TaskSpaceRegion(there, np.eye(4), np.zeros((6, 2)))
            case Turn():
                assert isinstance(self.held, Hold)
                door = self.held.articulation
                turned = scene.with_joint(door, phase.value)[phase.goal.base]
                constraint, goal = (phase.constraint,), phase.goal.at(turned.T_world_object)
                start = np.append(start, scene.articulation(door).value)
                scene, robot = _mechanism(robot, scene, self.held)
        return PlanningProblem(
            name=f"{task.name}/{phase.name}",
            robot=robot,
            scene=scene,
            start=start,
            constraint=constraint,
            attachments=attachments,
            goal_region=goal,
        )

    def moved(self, q: np.ndarray) -> "World":
        """State after a planned phase that ended at q (n,), or (n + 1,) with a door in the hand."""
        if not isinstance(self.held, Hold):
            return replace(self, q=q)
        joint = self.scene.articulation(self.held.articulation)
        value = float(np.clip(q[-1], joint.lower, joint.upper))
        return replace(self, scene=self.scene.with_joint(joint.name, value), q=q[:-1])

    def through(self, phases: Iterable[HandPhase]) -> "World":
        """State after several hand phases."""
        return reduce(World.after, phases, self)

    def after(self, phase: HandPhase) -> "World":
        """State after a hand phase; InvalidInputError if the fingers do not close on the object."""
        source = {**self.source, **phase.gripper}
        match phase:
            case Hold():
                return replace(self, source=source, held=phase)
            case Grasp():
                item, expected = self.scene[phase.object], phase.attachment
                T_hand_object = np.linalg.inv(self.arm.pose(self.q)) @ item.T_world_object
                _require_in_hand(phase, item, T_hand_object, robot_from_source(source), self.q)
                name = expected.name if expected else item.name
                mass = item.mass
                if mass is None and expected is not None:
                    mass = expected.mass
                load = Load(item, Attachment(name, item.shape, T_hand_object, mass))
                return World(source, self.scene.without(phase.object), self.q, load)
        scene = self.scene
        if isinstance(self.held, Load):
            T = self.arm.pose(self.q) @ self.held.attachment.T_hand_object
            scene = scene.with_objects(replace(self.held.item, T_world_object=T))
        return replace(self, source=source, scene=scene, held=None)


def _require_in_hand(
    phase: Grasp,
    item: SceneObject,
    T_hand_object: np.ndarray,
    robot: Robot,
    q: np.ndarray,
    gap: float = 0.02,
    most_turn: float = 0.1,
) -> None:
    """Refuse an object that is not in the closed hand at q (n,) as the grasp expects it.

    Turns about a symmetry axis of the object are allowed. The task continues with the true pose.

    Args:
        phase: the grasp.
        item: the object in the scene.
        T_hand_object: true pose (4, 4) of the object in the hand [m].
        robot: the arm with the gripper closed.
        q: configuration (n,) of the arm [rad or m].
        gap: largest distance from the expected position, or from the arm [m].
        most_turn: largest angle from the expected orientation [rad].
    """
    if phase.attachment is None:
        scene = Scene(item.name, (replace(item, obstacle=True),))
        if CollisionChecker(robot, scene).nearest_obstacle(q, gap).pair is None:
            raise InvalidInputError(
                f"phase {phase.name!r}: {item.name!r} is more than {gap} m from the arm; let "
                "the phase before end at the object, or say by an 'attachment' where a hand "
                "without collision bodies holds it"
            )
        return
    T = phase.attachment.T_hand_object
    off = float(np.linalg.norm(T_hand_object[:3, 3] - T[:3, 3]))
    R = T[:3, :3].T @ T_hand_object[:3, :3]
    match item.shape:
        case Sphere():
            turn = 0.0
        case Cylinder():
            turn = math.acos(min(1.0, abs(R[2, 2])))
        case _:
            turn = float(np.linalg.norm(rotation_vectors(R)))
    if off > gap or turn > most_turn:
        raise InvalidInputError(
            f"phase {phase.name!r}: {item.name!r} is {off:.3f} m and {turn:.2f} rad from where "
            f"the hand closes by its attachment, at most {gap} m and {most_turn} rad are "
            "allowed; let the phase before end at the object, or leave 'attachment' out"
        )


# takes 0.2 s for the frame around a door
_taken_out = lru_cache(maxsize=8)(take_out)


@lru_cache(maxsize=8)
def _mechanism(robot: Robot, scene: Scene, held: Hold) -> tuple[Scene, Robot]:
    """Return the scene without the held door, and the robot with the door as its last joint."""
    rest, door = _taken_out(scene, held.articulation, held.may_touch)
    return rest, with_articulated_object(robot, door)


class Effort(NamedTuple):
    """Numbers of goals and samples for a kind of phase."""

    goals: int  # number of goals to sample; those of slides and turns differ only in posture
    poses: int  # number of end-effector poses to try for them
    first_goals: int = 0  # number of goals to sample for the phase before
    grasps: int = 0  # number of those that must allow goals of this phase
    # goals of this phase that each of those must allow; with fewer it is near a joint limit
    goals_ahead: int = 0
    poses_ahead: int = 0  # number of end-effector poses to try for them


EFFORT: dict[type, Effort] = {
    Move: Effort(goals=MAX_GOALS, poses=100),
    Slide: Effort(goals=3, poses=3, first_goals=8, grasps=5, goals_ahead=1, poses_ahead=1),
    Turn: Effort(goals=10, poses=25, first_goals=20, grasps=2, goals_ahead=5, poses_ahead=8),
}


def phase_problems(task: Task, paths: Sequence[np.ndarray]) -> Iterator[PlanningProblem]:
    """Yield the problems, without goals, of the planned phases whose paths (m, n) are given."""
    world = World.before(task)
    for (hand, phase), states in zip(task.planned, paths, strict=False):
        world = world.through(hand)
        yield world.problem(task, phase)
        world = world.moved(states[-1])


def phase_goals(task: Task, k: int, world: World) -> tuple[np.ndarray, str]:
    """Sample goals of planned phase k from which the next planned phase can begin.

    Returns:
        Goals (m, n) [rad or m], and the reason if there are none, else "".
    """
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
    """Build the collision checkers for goal sampling, which is not part of the planning time."""
    (_, phase), *later = task.planned[k : k + 2]
    _checker(world.problem(task, phase))
    for hand, after in later:
        if isinstance(phase, Move) and isinstance(after, Turn):
            _checker(world.through(hand).problem(task, after))


def _goes_on(task: Task, hand: Sequence[HandPhase], after: PlannedPhase, world: World) -> bool:
    """Whether the slide or turn after hand phases has goals if these begin in `world`."""
    try:
        problem = world.through(hand).problem(task, after)
    except InvalidInputError:
        return False  # the object to grasp is not in the hand there
    if _checker(problem).in_collision(problem.start):
        return False
    effort = EFFORT[type(after)]
    found, _ = _sampled(problem, after, effort.goals_ahead, effort.poses_ahead)
    return len(found) >= effort.goals_ahead


def _sampled(
    problem: PlanningProblem, phase: PlannedPhase, count: int, poses: int
) -> tuple[np.ndarray, str]:
    """Sample up to `count` goals of a phase; the random numbers depend only on its start.

    Slides and turns get goals near the posture of the start, because most other postures can only
    be reached without holding the object. Goals of a move are sampled in the goal region; only if
    none of these keeps the constraint, they are projected onto the constraint too.

    Args:
        problem: the problem of the phase, with its goal region.
        phase: the phase.
        count: largest number of goals.
        poses: number of end-effector poses to try.

    Returns:
        Goals (m, n) [rad or m], and the reason if there are none, else "".
    """
    assert problem.goal_region is not None
    if isinstance(phase, Move) and phase.configuration is not None:
        if _checker(problem).in_collision(phase.configuration):
            return np.empty((0, problem.robot.dof)), "the move's configuration is in collision"
        return phase.configuration[None], ""
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
    if isinstance(phase, Move):
        goals = np.concatenate([near_goals(problem), goals])[:count]
    if isinstance(phase, Move) and len(goals):
        off = np.linalg.norm(problem.manifold.residual(goals), axis=1)
        goals = goals[off <= PROJECTION_TOLERANCE]
        if len(goals) == 0:
            found = drawn(rng=problem.random_stream(), within=problem.constraint)
            goals = found.configurations
    return goals, "" if len(goals) else f"no goal: {found.outcome}"


def _checker(problem: PlanningProblem, door_margin: float = 5e-4) -> CollisionChecker:
    """Collision checker for starts and goals; with a door in hand its margin is door_margin [m]."""
    held = "articulated" in problem.robot.source
    return checker_of(problem, door_margin if held else SAMPLE_MARGIN_M)
