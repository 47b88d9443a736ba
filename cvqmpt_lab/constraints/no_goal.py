"""Reasons why a region of poses has no configuration: reach, constraint, collisions."""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.goals import (
    POSE_TOLERANCE,
    POSES_AT_ONCE,
    first_guesses,
    has_fewer_than_6_dof,
    solve_poses,
)
from cvqmpt_lab.constraints.project import (
    PROJECTION_STEPS,
    PROJECTION_TOLERANCE,
    project,
    projection_scratch,
)
from cvqmpt_lab.constraints.region_constraint import RegionConstraint
from cvqmpt_lab.constraints.report import broken_bound, displaced, displacements
from cvqmpt_lab.constraints.task_space_region import FREE, TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.robot.robot import Robot


def why_none(
    robot: Robot,
    region: TaskSpaceRegion,
    checker: CollisionChecker,
    constraint: Sequence[TaskSpaceRegion],
) -> str:
    """Return why no configuration of a region was found, in words; "" if no reason is known.

    Args:
        robot: the robot.
        region: poses of the end effector.
        checker: of collisions.
        constraint: regions that hold at the same time.
    """
    rng = np.random.default_rng(0)
    T = region.sample_poses(rng, POSES_AT_ONCE)
    anywhere = has_fewer_than_6_dof(robot, region)
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
            and robot.frame(member.end_effector) is robot.hand(region.end_effector)
        ):
            broken = broken_bound(member, displaced(member, T, member.T0_w[None]))
            reasons += [f"every pose breaks {broken}"] if broken else []
    reasons.append(_collisions(checker, np.concatenate(found)))
    said = "; ".join(filter(None, reasons)) or contradiction(robot, constraint)
    return said or _apart(robot, (region, *constraint), rng)


def _apart(robot: Robot, members: Sequence[TaskSpaceRegion], rng: np.random.Generator) -> str:
    """Return the smallest residual of all members at once, as text."""
    ends = first_guesses(robot, rng, POSES_AT_ONCE)
    T = np.broadcast_to(members[0].T0_w, (len(ends), 4, 4))
    solve_poses(robot, members[0], T, ends, members[1:])
    states = ends.reshape(-1, robot.dof)
    off = np.linalg.norm(RegionConstraint(robot, tuple(members)).residual(states), axis=1)
    return (
        f"pose and constraint are {off.min():.2g} rad or m apart at best, at most "
        f"{PROJECTION_TOLERANCE:g} is allowed"
    )


def _open_chain(
    robot: Robot,
    region: TaskSpaceRegion,
    member: TaskSpaceRegionChain,
    rng: np.random.Generator,
) -> str:
    """Return the smallest closure error found, as text; "" if a closed configuration was found."""
    T, guesses = region.sample_poses(rng, POSES_AT_ONCE), first_guesses(robot, rng, POSES_AT_ONCE)
    if any(map(len, solve_poses(robot, region, T, guesses, (member,)))):
        return ""
    return _cannot_hold(robot, member, (region, member), guesses.reshape(-1, robot.dof)) + " there"


def _cannot_hold(
    robot: Robot,
    member: TaskSpaceRegion,
    members: Sequence[TaskSpaceRegion],
    ends: np.ndarray,
) -> str:
    """Return the residual of `member` at the best of projected states `ends` (k, n), as text."""
    off = np.linalg.norm(RegionConstraint(robot, tuple(members)).residual(ends), axis=1)
    broken = broken_bound(member, displacements(robot, member, ends[None, off.argmin()]))
    what = "it cannot be kept"
    if isinstance(member, TaskSpaceRegionChain):
        hand = member.end_effector or robot.end_effector
        what = f"{member.base} and {hand} cannot both hold on"
    return f"{what}: the best of {len(ends)} tries breaks {broken or 'other bounds'}"


def contradiction(robot: Robot, constraint: Sequence[TaskSpaceRegion], tries: int = 100) -> str:
    """Return which region, or pair of regions, no configuration was found for; "" if none."""
    draws = robot.random_configurations(np.random.default_rng(0), tries)

    def ends(*members: TaskSpaceRegion) -> np.ndarray:
        """First configuration (1, n) that satisfies them, or all end points (tries, n)."""
        manifold, found = RegionConstraint(robot, members), draws.copy()
        scratch = projection_scratch(robot.kinematics, manifold.regions)
        for q in found:
            if (
                project(
                    robot.kinematics, manifold.regions, q, POSE_TOLERANCE, PROJECTION_STEPS, scratch
                )
                >= 0
            ):
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
    """Compare the distance of unreachable poses T (k, 4, 4) with the reach of the hand."""
    first = int(robot.kinematics.moves[:, robot.hand(region.end_effector)[0]].argmax())
    reach = hand_reach(robot, region.end_effector)
    away = np.linalg.norm(T[:, :3, 3] - robot.kinematics.translation[first], axis=1)
    if away.min() > reach:
        return (
            f"they lie {away.min():.2f} m or more from {robot.moving_joints[first]}, the hand "
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
            f"{turned} of {len(T)} of their positions are reachable with another orientation, none "
            "with the requested one"
        )
    return (
        f"they lie from {away.min():.2f} m on from {robot.moving_joints[first]}, where the hand "
        f"reaches {reach:.2f} m, but the joint limits do not let it get there"
    )


def hand_reach(robot: Robot, end_effector: str | None = None, count: int = 4000) -> float:
    """Return the largest distance [m] of a hand from its first joint, found by sampling.

    Samples are `count` random configurations, and more around the best one.
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
    """Return colliding pairs of configurations (k, n), most frequent first; "" if one is free."""
    pairs = [str(checker.colliding_pair(q)) for q in configurations if checker.in_collision(q)]
    if len(pairs) < len(configurations) or not pairs:
        return ""
    most = Counter(pairs).most_common(3)
    with_what = ", ".join(f"{pair} in {count}" for pair, count in most)
    return f"all {len(pairs)} configurations that reach them collide: {with_what}"
