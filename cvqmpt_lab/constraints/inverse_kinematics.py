"""Inverse kinematics as projection, and the reasons why a region of poses has no configuration.

A pose is a task-space region with bounds of zero. Newton's method from random configurations, the
planners' projection (paper, Algorithm 1), works for any serial robot. A hand that less than six
joints move gets to hardly any pose that is drawn: configurations are projected onto the region.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.project import project, projection_scratch, reach_poses
from cvqmpt_lab.constraints.report import broken_bound, displaced, displacements
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    RegionConstraint,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    stack_regions,
)
from cvqmpt_lab.robot.robot import Robot

TOLERANCE = 1e-6  # [m, rad] on the pose
MAX_ITERATIONS = 20
ATTEMPTS = 12  # random configurations Newton's method starts from, per pose
NEAR = 0.3  # [rad] standard deviation of starts around a given configuration
POSES = 25  # drawn at once
SAMPLE_MARGIN = 1e-3  # [m] kept from obstacles by sampled starts and goals
INSIDE = 1e-3  # [m, rad] or a tenth of the width, inside bounds: where projected samples end


def one_pose(region: TaskSpaceRegion) -> TaskSpaceRegion:
    """The region of one pose, of that end effector; its reference frame is written later."""
    return TaskSpaceRegion(np.eye(4), np.eye(4), np.zeros((6, 2)), end_effector=region.end_effector)


def reaches_no_pose(robot: Robot, region: TaskSpaceRegion) -> bool:
    """Whether less than six joints move the hand: it gets to hardly any pose that is drawn."""
    return int(robot.kinematics.moves[:, robot.hand(region.end_effector)[0]].sum()) < 6


def solve_poses(
    robot: Robot,
    region: TaskSpaceRegion,
    poses: np.ndarray,
    guesses: np.ndarray,
    within: Sequence[TaskSpaceRegion] = (),
    anywhere: bool = False,
) -> list[np.ndarray]:
    """Configurations inside the limits that reach end-effector poses, by Newton's method.

    Args:
        robot: the robot.
        region: that the poses were drawn in.
        poses: (k, 4, 4) in the base frame [m].
        guesses: (k, a, n), where Newton's method starts; overwritten [rad or m].
        within: regions kept at the same time.
        anywhere: they end anywhere in the region instead.

    Returns:
        k arrays (at most a, n).
    """
    # the reference frame of the first region is written for each pose
    regions = stack_regions(robot, (one_pose(region), *within))
    if anywhere:
        regions = stack_regions(robot, (region, *within), INSIDE)
        poses = np.broadcast_to(region.T0_w, poses.shape)
    reached = np.empty(guesses.shape[:2], dtype=np.int64)
    reach_poses(
        robot.kinematics,
        regions,
        np.ascontiguousarray(poses[:, :3, :3]),
        np.ascontiguousarray(poses[:, :3, 3]),
        guesses,
        TOLERANCE,
        MAX_ITERATIONS,
        projection_scratch(robot.dof, regions),
        reached,
    )
    return [rows[iterations >= 0] for rows, iterations in zip(guesses, reached, strict=True)]


def first_guesses(
    robot: Robot, rng: np.random.Generator, poses: int, near: np.ndarray | None = None
) -> np.ndarray:
    """Configurations (poses, ATTEMPTS, n) anywhere, or `NEAR` one (n,)."""
    shape = (poses, ATTEMPTS, robot.dof)
    if near is None:
        return robot.random_configurations(rng, poses * ATTEMPTS).reshape(shape)
    return near + NEAR * rng.standard_normal(shape)


@dataclass(frozen=True)
class GoalSample:
    """Result of sampling a goal region."""

    configurations: np.ndarray  # (k, n), free of collision [rad or m]
    poses_tried: int  # poses drawn
    unreachable: int  # poses without an inverse-kinematics solution
    colliding: int  # poses with solutions, none of them free of collision

    def with_more(self, other: "GoalSample") -> "GoalSample":
        """Both samples together."""
        return GoalSample(
            np.concatenate([self.configurations, other.configurations]),
            self.poses_tried + other.poses_tried,
            self.unreachable + other.unreachable,
            self.colliding + other.colliding,
        )

    @property
    def outcome(self) -> str:
        """Counts of poses that gave no configuration."""
        tried = f"of {self.poses_tried} poses, {self.unreachable} without inverse kinematics"
        return f"{tried}, {self.colliding} in collision"


def sample_region(
    robot: Robot,
    region: TaskSpaceRegion,
    checker: CollisionChecker,
    rng: np.random.Generator,
    count: int,
    max_poses: int = 100,
    within: Sequence[TaskSpaceRegion] = (),
    near: np.ndarray | None = None,
    project: bool = False,
) -> GoalSample:
    """Up to count collision-free configurations with the end effector in a region, one per pose.

    within: regions kept at the same time; the region of a held handle moves its door to the hand.
    near: configuration (n,) that Newton's method starts around, `NEAR` away, instead of anywhere.
    project: onto the region, not onto poses drawn in it; always if the robot `reaches_no_pose`.
    """
    anywhere = project or reaches_no_pose(robot, region)
    found: list[np.ndarray] = []
    unreachable = colliding = tried = 0
    while len(found) < count and tried < max_poses:
        poses = region.sample_poses(rng, min(POSES, max_poses - tried))
        guesses = first_guesses(robot, rng, len(poses), near)
        # as many poses at once as configurations are wanted: no more than needed are solved
        few = (slice(first, first + count) for first in range(0, len(poses), count))
        for candidates in (
            one
            for part in few
            for one in solve_poses(robot, region, poses[part], guesses[part], within, anywhere)
        ):
            tried += 1
            free = next((q for q in candidates if not checker.in_collision(q)), None)
            if free is not None:
                found.append(free)
            else:
                unreachable += len(candidates) == 0
                colliding += len(candidates) > 0
            if len(found) == count:
                break
    configurations = np.array(found).reshape(-1, robot.dof)
    return GoalSample(configurations, tried, unreachable, colliding)


def find_in_region(*args: Any, **options: Any) -> GoalSample:
    """`sample_region`, by projection onto the region where none of the poses is reached."""
    found = sample_region(*args, **options)
    if len(found.configurations):
        return found
    return sample_region(*args, **{**options, "project": True})


def why_none(
    robot: Robot,
    region: TaskSpaceRegion,
    checker: CollisionChecker,
    constraint: Sequence[TaskSpaceRegion],
) -> str:
    """The reasons: out of reach, against the constraint, in collision; "" if none is known."""
    rng = np.random.default_rng(0)
    T = region.sample_poses(rng, POSES)
    anywhere = reaches_no_pose(robot, region)
    found = solve_poses(robot, region, T, first_guesses(robot, rng, len(T)), anywhere=anywhere)
    missed = T[[len(rows) == 0 for rows in found]]
    reasons = [contradiction(robot, constraint)]
    if len(missed) < len(T) and not any(reasons):
        # the hand gets there, perhaps not with what holds on to it
        chains = [member for member in constraint if isinstance(member, TaskSpaceRegionChain)]
        reasons += [_open_chain(robot, region, member, rng) for member in chains]
    if len(missed) and not any(reasons):
        reasons.append(_reach(robot, region, missed, rng))
    for member in constraint:
        # few drawn poses say nothing of turns that are all free, nor of the other hand
        if (
            (region.bounded_rows > 2).any()
            and not isinstance(member, TaskSpaceRegionChain)
            and robot.hand(member.end_effector) is robot.hand(region.end_effector)
        ):
            broken = broken_bound(member, displaced(member, T, member.T0_w[None]))
            reasons += [f"every pose breaks {broken}"] if broken else []
    reasons.append(_collisions(checker, np.concatenate(found)))
    return "; ".join(filter(None, reasons)) or contradiction(robot, constraint)


def _open_chain(
    robot: Robot,
    region: TaskSpaceRegion,
    member: TaskSpaceRegionChain,
    rng: np.random.Generator,
) -> str:
    """By how much a closed chain is missed at best with a hand in a region; "" if it closes."""
    T, guesses = region.sample_poses(rng, POSES), first_guesses(robot, rng, POSES)
    if any(map(len, solve_poses(robot, region, T, guesses, (member,)))):
        return ""
    return _cannot_hold(robot, member, (region, member), guesses.reshape(-1, robot.dof)) + " there"


def _cannot_hold(
    robot: Robot,
    member: TaskSpaceRegion,
    members: Sequence[TaskSpaceRegion],
    ends: np.ndarray,
) -> str:
    """By how much a region is missed where projections onto members end best, (k, n)."""
    off = np.linalg.norm(RegionConstraint(robot, tuple(members)).residual(ends), axis=1)
    broken = broken_bound(member, displacements(robot, member, ends[None, off.argmin()]))
    what = "it cannot be kept"
    if isinstance(member, TaskSpaceRegionChain):
        hand = member.end_effector or robot.end_effector
        what = f"{member.base} and {hand} cannot both hold on"
    return f"{what}: the best of {len(ends)} tries breaks {broken or 'other bounds'}"


def contradiction(robot: Robot, constraint: Sequence[TaskSpaceRegion], tries: int = 100) -> str:
    """A region, or two together, that no configuration was found for, in words; or ""."""
    draws = robot.random_configurations(np.random.default_rng(0), tries)

    def ends(*members: TaskSpaceRegion) -> np.ndarray:
        """The first configuration (1, n) that keeps them, or where projections end (tries, n)."""
        manifold, found = RegionConstraint(robot, members), draws.copy()
        scratch = projection_scratch(robot.dof, manifold.regions)
        for q in found:
            if project(robot.kinematics, manifold.regions, q, TOLERANCE, 50, scratch) >= 0:
                return q[None]
        return found

    alone = [ends(member) for member in constraint]
    for k, (member, found) in enumerate(zip(constraint, alone, strict=True)):
        if len(found) > 1:
            return f"constraint[{k}]: {_cannot_hold(robot, member, (member,), found)}"
    for (i, first), (k, second) in combinations(enumerate(constraint), 2):
        if len(ends(first, second)) > 1:
            return (
                f"constraint[{i}] and constraint[{k}] contradict each other: none of {tries} "
                "tries keeps both"
            )
    return ""


def _reach(robot: Robot, region: TaskSpaceRegion, T: np.ndarray, rng: np.random.Generator) -> str:
    """How far poses (k, 4, 4) without inverse kinematics are, and how far the hand reaches."""
    first = int(robot.kinematics.moves[:, robot.hand(region.end_effector)[0]].argmax())
    reach = hand_reach(robot, region.end_effector)
    away = np.linalg.norm(T[:, :3, 3] - robot.kinematics.translation[first], axis=1)
    if away.min() > reach:
        return (
            f"they lie {away.min():.2f} m or more from {robot.joint_names[first]}, the hand "
            f"reaches {reach:.2f} m"
        )
    turned = 0
    anyhow = np.array([[0.0, 0.0]] * 3 + [[-FREE, FREE]] * 3)
    for pose in T:
        place = TaskSpaceRegion(pose, np.eye(4), anyhow, end_effector=region.end_effector)
        manifold = RegionConstraint(robot, (place,))
        guesses = first_guesses(robot, rng, 1)[0]
        turned += any(manifold.project(q) is not None for q in guesses)
    if turned:
        return (
            f"turned otherwise the hand gets to {turned} of {len(T)} of their places, turned as "
            "asked to none"
        )
    return (
        f"they lie from {away.min():.2f} m on from {robot.joint_names[first]}, where the hand "
        f"reaches {reach:.2f} m, but the joint limits do not let it get there"
    )


def hand_reach(robot: Robot, end_effector: str | None = None, count: int = 4000) -> float:
    """Distance [m] from its first joint that a hand reaches.

    Found by `count` random configurations, and by more around the best one.
    """
    k, rng = robot.kinematics, np.random.default_rng(0)
    axis = k.translation[int(k.moves[:, robot.hand(end_effector)[0]].argmax())]
    configurations, best, reach = robot.random_configurations(rng, count), robot.lower, 0.0
    # standard deviations [rad or m], round by round
    for spread in (0.3, 0.2, 0.1, 0.05):
        there = robot.poses(configurations, end_effector)[:, :3, 3]
        away = np.linalg.norm(there - axis, axis=1)
        if away.max() > reach:
            best, reach = configurations[away.argmax()], float(away.max())
        near = best + spread * rng.standard_normal((count // 8, robot.dof))
        configurations = near.clip(robot.lower, robot.upper)
    return reach


def _collisions(checker: CollisionChecker, configurations: np.ndarray) -> str:
    """The pairs that collide in configurations (k, n), most frequent first; "" if one is free."""
    pairs = [str(checker.colliding_pair(q)) for q in configurations if checker.in_collision(q)]
    if len(pairs) < len(configurations) or not pairs:
        return ""
    most = Counter(pairs).most_common(3)
    with_what = ", ".join(f"{pair} in {count}" for pair, count in most)
    return f"all {len(pairs)} configurations that reach them collide: {with_what}"
