"""Goal configurations of a region of poses: inverse kinematics, and the policy of goals.

Inverse kinematics is projection: a pose is a task-space region with bounds of zero, and Newton's
method, the planners' projection (paper, Algorithm 1), works for any serial robot. Random poses are
almost never reachable by a hand with fewer than 6 joints: configurations are then projected onto
the region.

Policy (`draw_goals`): the start itself where the region contains it; goals near the start, found by
Newton's method from the start and from the goal before; then goals in other postures, from random
seeds. All planners and seeds get the same goals.

`sample_region` checks states by coal, `sample_goals` in compiled code.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Protocol

import numpy as np

from cvqmpt_lab.base.poses import nearest_turn
from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.collision.world import World
from cvqmpt_lab.constraints.problem_parts import ProblemParts
from cvqmpt_lab.constraints.project import (
    PROJECTION_TOLERANCE,
    projection_scratch,
    reach_poses,
)
from cvqmpt_lab.constraints.reach_free import (
    COLLIDING_POSE,
    UNREACHABLE_POSE,
    UNTRIED_POSE,
    Attempts,
    Poses,
    Seeds,
    Stopping,
    reach_free,
)
from cvqmpt_lab.constraints.region_constraint import (
    Member,
    RegionConstraint,
    reraise,
    stack_regions,
)
from cvqmpt_lab.constraints.regions import Regions
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.robot.kinematics import link_poses
from cvqmpt_lab.robot.robot import Robot

MAX_GOALS = 20
POSE_TOLERANCE = 1e-6  # [m, rad] of inverse kinematics
POSE_STEPS = 20  # Newton steps at most
POSE_ATTEMPTS = 12  # seeds of Newton's method per pose
SEED_STD_RAD = 0.3  # standard deviation of seeds around a given configuration
POSES_AT_ONCE = 25
SAMPLE_MARGIN_M = 1e-3  # kept from obstacles by sampled starts and goals
# projected samples end this far inside of bounds [m, rad], or a tenth of the width
REGION_INSET = 1e-3


@lru_cache(maxsize=8)
def one_pose(end_effector: str | None) -> TaskSpaceRegion:
    """Return the region of a single pose of an end effector, at the origin.

    Inverse kinematics writes the pose into arrays of the region's reference frame.
    """
    return TaskSpaceRegion(np.eye(4), np.eye(4), np.zeros((6, 2)), end_effector=end_effector)


def only_projected(robot: Robot, region: TaskSpaceRegion) -> bool:
    """Return whether configurations of a region are found by projection from random ones alone.

    No poses can be drawn in it, or fewer than 6 joints move the hand: random poses are almost never
    reachable.
    """
    return not region.drawable or robot.movers(robot.hand(region.end_effector)[0]).sum() < 6


def solve_poses(
    robot: Robot,
    region: TaskSpaceRegion,
    poses: np.ndarray,
    guesses: np.ndarray,
    within: Sequence[Member] = (),
    anywhere: bool = False,
    tolerance: float = POSE_TOLERANCE,
) -> list[np.ndarray]:
    """Solve inverse kinematics inside the joint limits by Newton's method.

    Args:
        robot: the robot.
        region: region of the poses.
        poses: (k, 4, 4) of the end effector in the base frame [m].
        guesses: (k, a, n) seeds of Newton's method [rad or m]; overwritten.
        within: regions and functions that hold at the same time.
        anywhere: whether to project onto the region instead of reaching the poses.
        tolerance: largest norm of F [m, rad].

    Returns:
        k arrays (at most a, n) of configurations [rad or m].
    """
    # the reference frame of the first region is written for each pose
    regions = stack_regions(robot, (one_pose(region.end_effector), *within))
    if anywhere:
        regions = stack_regions(robot, (region, *within), REGION_INSET)
        poses = np.broadcast_to(region.T0_w, poses.shape)
    reached = np.empty(guesses.shape[:2], dtype=np.int64)
    reach_poses(
        robot.kinematics,
        regions,
        np.ascontiguousarray(poses[:, :3, :3]),
        np.ascontiguousarray(poses[:, :3, 3]),
        guesses,
        tolerance,
        POSE_STEPS,
        projection_scratch(robot.kinematics, regions),
        reached,
    )
    reraise(within)
    return [rows[iterations >= 0] for rows, iterations in zip(guesses, reached, strict=True)]


def first_guesses(
    robot: Robot, rng: np.random.Generator, poses: int, near: np.ndarray | None = None
) -> np.ndarray:
    """Draw seeds of Newton's method.

    Args:
        robot: the robot.
        rng: random numbers.
        poses: number of poses k.
        near: configuration (n,) around which seeds are drawn [rad or m]; None: uniform seeds.

    Returns:
        (k, POSE_ATTEMPTS, n) [rad or m].
    """
    shape = (poses, POSE_ATTEMPTS, robot.dof)
    if near is None:
        return robot.random_configurations(rng, poses * POSE_ATTEMPTS).reshape(shape)
    return near + SEED_STD_RAD * rng.standard_normal(shape)


class GoalProblem(ProblemParts, Protocol):
    """The parts of a planning problem that goals depend on."""

    @property
    def goal_region(self) -> TaskSpaceRegion | None:
        """Poses of the end effector that count as a goal."""

    @property
    def constraint(self) -> tuple[Member, ...]:
        """Regions and functions that hold on the whole path."""

    @property
    def closed_chain(self) -> tuple[TaskSpaceRegion, ...]:
        """Regions that hold one end effector to another."""

    @property
    def manifold(self) -> RegionConstraint:
        """The constraint F(q) = 0."""

    def random_stream(self, *keys: int) -> np.random.Generator:
        """Return a generator seeded by keys and the start."""


@dataclass(frozen=True)
class GoalSample:
    """Result of sampling a goal region."""

    configurations: np.ndarray  # (k, n), free of collision [rad or m]
    poses_tried: int  # poses drawn
    unreachable: int  # poses without an inverse-kinematics solution
    colliding: int  # poses with solutions, none of them free of collision

    def with_more(self, other: "GoalSample") -> "GoalSample":
        """Return both samples as one."""
        return GoalSample(
            np.concatenate([self.configurations, other.configurations]),
            self.poses_tried + other.poses_tried,
            self.unreachable + other.unreachable,
            self.colliding + other.colliding,
        )

    @property
    def outcome(self) -> str:
        """The number of poses without a configuration, in words."""
        tried = f"of {self.poses_tried} poses, {self.unreachable} without inverse kinematics"
        return f"{tried}, {self.colliding} in collision"


def sample_region(
    robot: Robot,
    region: TaskSpaceRegion,
    checker: CollisionChecker,
    rng: np.random.Generator,
    count: int,
    max_poses: int = 100,
    within: Sequence[Member] = (),
    near: np.ndarray | None = None,
    project: bool = False,
    tolerance: float = POSE_TOLERANCE,
    distinct: float | None = None,
) -> GoalSample:
    """Draw collision-free configurations with the end effector in a region, one per pose.

    Args:
        robot: the robot.
        region: poses of the end effector.
        checker: of collisions.
        rng: random numbers.
        count: of configurations wanted.
        max_poses: poses drawn at most.
        within: regions and functions that hold at the same time; the region of a held handle
            moves its door to the hand.
        near: configuration (n,) around which seeds are drawn [rad or m]; None: uniform seeds.
        project: whether to project onto the region instead of reaching poses drawn in it; always
            done if the region is `only_projected`.
        tolerance: largest norm of F of the pose and the regions [m, rad].
        distinct: least distance of two configurations in a joint, whole turns aside [rad or m];
            None: the same one may be found again.
    """
    anywhere = project or only_projected(robot, region)
    found: list[np.ndarray] = []
    unreachable = colliding = tried = 0
    while len(found) < count and tried < max_poses:
        poses = region.poses_or_frame(rng, min(POSES_AT_ONCE, max_poses - tried))
        guesses = first_guesses(robot, rng, len(poses), near)
        # `count` poses at a time, so that few are solved in vain
        few = (slice(first, first + count) for first in range(0, len(poses), count))
        for candidates in (
            one
            for part in few
            for one in solve_poses(
                robot, region, poses[part], guesses[part], within, anywhere, tolerance
            )
        ):
            tried += 1
            new = candidates if distinct is None else _others(robot, candidates, found, distinct)
            free = next((q for q in new if not checker.in_collision(q)), None)
            if free is not None:
                found.append(free)
            else:
                unreachable += len(candidates) == 0
                colliding += len(new) > 0
            if len(found) == count:
                break
    configurations = np.array(found).reshape(-1, robot.dof)
    return GoalSample(configurations, tried, unreachable, colliding)


def _others(
    robot: Robot, candidates: np.ndarray, found: Sequence[np.ndarray], distinct: float
) -> np.ndarray:
    """Return the candidates (k, n) that differ from all found by `distinct` in a joint."""
    apart = candidates[:, None] - np.array(found).reshape(-1, robot.dof)
    apart = np.where(robot.turns_freely, nearest_turn(apart, 0.0), apart)
    return candidates[(np.abs(apart).max(axis=-1, initial=0.0) >= distinct).all(axis=-1)]


def find_in_region(*args: Any, **options: Any) -> GoalSample:
    """Call `sample_region`, and again with projection onto the region if no pose was reached.

    Where exact bounds and rounded numbers of a pose contradict each other by less than the
    tolerance of projections, configurations between the two are found at last.
    """
    found = sample_region(*args, **options)
    if len(found.configurations):
        return found
    found = sample_region(*args, **{**options, "project": True})
    if len(found.configurations) or not options.get("within"):
        return found
    close = sample_region(*args, **{**options, "tolerance": PROJECTION_TOLERANCE})
    return close if len(close.configurations) else found


def sample_goals(
    problem: GoalProblem,
    rng: np.random.Generator,
    count: int,
    max_poses: int = 100,
    within: Sequence[Member] = (),
    near: np.ndarray | None = None,
    project: bool = False,
    look: int = 16,
    world: World | None = None,
) -> GoalSample:
    """Draw collision-free configurations in a problem's goal region, one per pose.

    Where joints have a range of more than a full turn, every second configuration is moved by whole
    turns towards the start: otherwise most goals of such arms are whole turns away.

    Args:
        problem: the problem; its goal region must not be None.
        rng: random numbers.
        count: of configurations wanted.
        max_poses: poses drawn at most.
        within: regions and functions that hold at the same time; the region of a held handle
            moves its door to the hand.
        near: configuration (n,) around which seeds are drawn [rad or m]; None: uniform seeds.
        project: whether to project onto the region instead of reaching poses drawn in it.
        look: seeds of Newton's method compared for an attempt.
        world: the world of the problem; None: it is made here.
    """
    robot, region, world = problem.robot, problem.goal_region, world or World.of(problem)
    assert region is not None
    if near is None:
        seeds = _seeds_anywhere(robot, region.end_effector)
    else:
        scattered = near + SEED_STD_RAD * rng.standard_normal((512, robot.dof))
        seeds = _seeds(robot, np.clip(scattered, robot.lower, robot.upper), region.end_effector)
    T = region.poses_or_frame(rng, max_poses)
    regions = stack_regions(robot, (one_pose(region.end_effector), *within))
    if project:
        # no pose is the one to start near to
        T[:], look = region.T0_w, 1
        regions = stack_regions(robot, (region, *within), REGION_INSET)
    poses = _no_configurations(T, robot.dof)
    found = reach_free.unchecked(  # all arrays are made here
        robot.kinematics,
        regions,
        world.robot_arrays,
        world.scene_arrays,
        SAMPLE_MARGIN_M,
        Attempts(
            seeds,
            rng.integers(len(seeds.configurations) - look + 1, size=(POSE_ATTEMPTS, max_poses)),
            look,
        ),
        # from a given posture, or along limits and bounds, progress may be slow
        Stopping(count, POSE_TOLERANCE, POSE_STEPS, on_stall=near is None and not project),
        projection_scratch(robot.kinematics, regions),
        np.empty((len(world.robot_arrays.body_link), 4)),
        poses,
    )
    reraise(within)
    configurations = poses.configurations[poses.reached[:found]]
    configurations[::2] = _turned_near(configurations[::2], problem.start, robot)
    return GoalSample(
        configurations,
        poses_tried=int((poses.verdict != UNTRIED_POSE).sum()),
        unreachable=int((poses.verdict == UNREACHABLE_POSE).sum()),
        colliding=int((poses.verdict == COLLIDING_POSE).sum()),
    )


def _no_configurations(T: np.ndarray, n: int) -> Poses:
    """Return poses T (k, 4, 4) [m] without configurations (k, n)."""
    return Poses(
        np.ascontiguousarray(T[:, :3, :3]),
        np.ascontiguousarray(T[:, :3, 3]),
        np.empty((len(T), n)),
        np.empty(len(T), dtype=np.int64),
        np.empty(len(T), dtype=np.int64),
    )


def _turned_near(configurations: np.ndarray, start: np.ndarray, robot: Robot) -> np.ndarray:
    """Move the hinges of configurations (k, n) by whole turns, as near to start as limits allow."""
    turned = np.where(robot.turns_freely, nearest_turn(configurations, start), configurations)
    return np.where((turned >= robot.lower) & (turned <= robot.upper), turned, configurations)


@lru_cache(maxsize=8)
def _seeds_anywhere(robot: Robot, end_effector: str | None) -> Seeds:
    """Uniform configurations, always the same."""
    uniform = robot.random_configurations(np.random.default_rng(0), 8192)
    return _seeds(robot, uniform, end_effector)


def _seeds(robot: Robot, configurations: np.ndarray, end_effector: str | None) -> Seeds:
    """Configurations (k, n) with the poses of an end effector."""
    link, T = robot.hand(end_effector)
    rotations, translations = link_poses(robot.kinematics, configurations)
    return Seeds(
        configurations,
        rotations[:, link] @ T[:3, :3],
        translations[:, link] + rotations[:, link] @ T[:3, 3],
        0.3 * robot.reach,
    )


@dataclass(frozen=True, eq=False)
class Goals:
    """The goals of a query."""

    configurations: np.ndarray  # (k, n) [rad or m]
    drawn: bool = False  # from a goal region; goals near the start come first
    outcome: str = ""  # counts of drawn poses that gave no configuration
    seconds: float = 0.0  # spent on drawing them [s]
    # number of given goals, if their other turns follow; the nearest ones are searched first
    given: int = 0

    def near(self, start: np.ndarray, radius: float = 1.0) -> int:
        """Return the number of goals that are near the start (n,), or 0.

        Given goals are near if their other turns follow. A drawn goal is near within `radius`
        [rad], and at most twice as far as the nearest one.
        """
        return self.within(start, radius) if self.drawn else self.given

    def within(self, start: np.ndarray, radius: float = 1.0) -> int:
        """Return the number of goals within `radius` [rad] and twice the nearest distance."""
        distances = np.linalg.norm(self.configurations - start, axis=1)
        return int((distances <= min(radius, 2.0 * distances.min())).sum())


def goals_of(problem: GoalProblem, world: World | None = None) -> Goals:
    """Return the given goals of a problem; if there are none, draw them from its goal region.

    Args:
        problem: the problem.
        world: its world; None: it is made here.
    """
    if len(problem.goals) > 0 or problem.goal_region is None:
        others = _other_turns(problem.robot, problem.goals)
        if len(others) == 0:
            return Goals(problem.goals)
        goals = np.concatenate([problem.goals, others])
        return Goals(frozen(goals), given=len(problem.goals))
    began = time.perf_counter()
    found = draw_goals(problem, world or World.of(problem))
    configurations = on_manifold(problem, found.configurations)
    return Goals(configurations, True, found.outcome, time.perf_counter() - began)


def _other_turns(robot: Robot, goals: np.ndarray) -> np.ndarray:
    """Return goals (k, n) with one endless joint moved by a whole turn inside its limits.

    The way to the nearest turn of a goal may be blocked.
    """
    found = [np.empty((0, robot.dof))]
    for j in np.flatnonzero(robot.endless):
        for turn in (-2.0 * np.pi, 2.0 * np.pi):
            moved = goals + turn * np.eye(robot.dof)[j]
            found.append(moved[(moved[:, j] >= robot.lower[j]) & (moved[:, j] <= robot.upper[j])])
    return np.concatenate(found)


def draw_goals(problem: GoalProblem, world: World) -> GoalSample:
    """Draw goals from a problem's goal region, goals near the start first.

    The start itself is the only goal where the region contains it. Goals depend on the problem's
    start, not on a seed: all planners get the same. Where the hand holds a door, goals have the
    door where the hand takes it, and a posture like the start's: most others require letting go.
    Configurations are projected onto region and constraint where the region is `only_projected`, or
    where no goal at a drawn pose satisfies the constraint.
    """
    region = problem.goal_region
    assert region is not None
    off = RegionConstraint(problem.robot, (region,)).residual(problem.start)
    if np.linalg.norm(off) <= PROJECTION_TOLERANCE:
        return GoalSample(problem.start[None], 0, 0, 0)
    near = near_goals(problem, world=world)
    others = goals_in_any_posture(problem, MAX_GOALS - len(near), world)
    return replace(others, configurations=np.concatenate([near, others.configurations]))


def near_goals(problem: GoalProblem, most: int = 4, world: World | None = None) -> np.ndarray:
    """Find goals (at most `most`, n) in postures like the start's; (0, n) if there are none.

    The first is the start projected onto goal region and constraint. Others reach the drawn poses
    that are nearest to the hand's pose at the start; Newton's method begins at the start or at the
    goal before, whichever has the hand nearer.
    """
    robot, region = problem.robot, problem.goal_region
    assert region is not None
    reached = partial(_reached, problem, world or World.of(problem))
    regions = stack_regions(robot, (region, *problem.constraint), REGION_INSET)
    found = reached(regions, region.T0_w[None], [problem.start])
    if not (region.drawable and np.ptp(region.Bw, axis=1).any()):
        return found  # a region of one pose has no other
    regions = stack_regions(robot, (one_pose(region.end_effector), *problem.constraint))
    T = region.sample_poses(problem.random_stream(0), POSES_AT_ONCE)
    hand = robot.pose(problem.start, region.end_effector)
    shift = np.linalg.norm(T[:, :3, 3] - hand[:3, 3], axis=1) / (0.3 * robot.reach)
    turn = np.linalg.norm((T - hand)[:, :3, :2], axis=(1, 2))
    for k in np.argsort(shift**2 + turn**2, kind="stable")[: most - 1]:
        more = reached(regions, T[k : k + 1], [problem.start, *found[-1:]])
        found = np.concatenate([found, more])
    return found


def _reached(
    problem: GoalProblem,
    world: World,
    regions: Regions,
    T: np.ndarray,
    seeds: Sequence[np.ndarray],
) -> np.ndarray:
    """Return free configurations (at most k, n) that Newton's method reaches from given seeds.

    Args:
        problem: goal region and constraint.
        world: its world.
        regions: the first one is moved to each pose.
        T: poses (k, 4, 4) [m].
        seeds: configurations (n,) [rad or m]; the one with the hand nearest to the pose is taken.
    """
    robot = problem.robot
    assert problem.goal_region is not None
    poses = _no_configurations(T, robot.dof)
    found = reach_free.unchecked(  # all arrays are made here
        robot.kinematics,
        regions,
        world.robot_arrays,
        world.scene_arrays,
        SAMPLE_MARGIN_M,
        Attempts(
            _seeds(robot, np.array(seeds), problem.goal_region.end_effector),
            # one attempt: Newton's method from the same seed ends the same way again
            np.zeros((1, len(T)), dtype=np.int64),
            len(seeds),
        ),
        Stopping(len(T), POSE_TOLERANCE, 5 * POSE_STEPS, on_stall=False),
        projection_scratch(robot.kinematics, regions),
        np.empty((len(world.robot_arrays.body_link), 4)),
        poses,
    )
    reraise(problem.constraint)
    return poses.configurations[poses.reached[:found]]


def goals_in_any_posture(
    problem: GoalProblem, count: int = MAX_GOALS, world: World | None = None
) -> GoalSample:
    """Draw goals from random seeds, at any distance from the start, see `draw_goals`.

    Suites whose problems have given goals take these.
    """
    rng, region, world = problem.random_stream(), problem.goal_region, world or World.of(problem)
    assert region is not None
    held = [part for part in problem.constraint if isinstance(part, TaskSpaceRegionChain)]
    near = problem.start if held else None
    sampled = partial(sample_goals, problem, rng, count, near=near, world=world)
    drawn = None
    if problem.closed_chain:
        # few postures of two hands come near the start's posture
        sampled = partial(_near_and_far, problem, rng, count, world=world)
    if not only_projected(problem.robot, region):
        drawn = sampled(within=held)
        # a region of one pose has no other
        if _on_manifold(problem, drawn.configurations).any() or not np.ptp(region.Bw, axis=1).any():
            return drawn
    projected = sampled(within=problem.constraint, project=True)
    return projected if drawn is None or len(projected.configurations) else drawn


def _near_and_far(
    problem: GoalProblem, rng: np.random.Generator, count: int, **options: Any
) -> GoalSample:
    """Draw goals in postures like the start's, and others where these are few."""
    like = sample_goals(problem, rng, count, near=problem.start, **options)
    missing = count - len(like.configurations)
    return like.with_more(sample_goals(problem, rng, missing, **options)) if missing else like


def on_manifold(problem: GoalProblem, states: np.ndarray) -> np.ndarray:
    """Return the states (k, n) that satisfy the constraint; all, if none does.

    Then the check of goals can name the violated bound.
    """
    kept = states[_on_manifold(problem, states)]
    return frozen(kept if len(kept) else states)


def _on_manifold(problem: GoalProblem, states: np.ndarray) -> np.ndarray:
    """Return which of states (k, n) satisfy the constraint, (k,) bool."""
    return np.linalg.norm(problem.manifold.residual(states), axis=1) <= PROJECTION_TOLERANCE
