"""Reasons why a region of poses has no configuration: reach, constraint, collisions."""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from cvqmpt_lab.base.poses import Placement, rotation_vectors
from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.goals import (
    POSE_TOLERANCE,
    POSES_AT_ONCE,
    first_guesses,
    one_pose,
    only_projected,
    solve_poses,
)
from cvqmpt_lab.constraints.named import rpy_of, upper_axis
from cvqmpt_lab.constraints.project import (
    PROJECTION_STEPS,
    PROJECTION_TOLERANCE,
    project,
    projection_scratch,
)
from cvqmpt_lab.constraints.region_constraint import Member, RegionConstraint, regions_of
from cvqmpt_lab.constraints.report import broken_bound
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    displaced,
    displacements,
)
from cvqmpt_lab.robot.pairs import cure_of_overlap
from cvqmpt_lab.robot.robot import Robot


def why_none(
    robot: Robot,
    region: TaskSpaceRegion,
    checker: CollisionChecker,
    constraint: Sequence[Member],
) -> str:
    """Return why no configuration of a region was found, in words; "" if no reason is known.

    Args:
        robot: the robot.
        region: poses of the end effector.
        checker: of collisions.
        constraint: regions and functions that hold at the same time.
    """
    rng = np.random.default_rng(0)
    T = region.poses_or_frame(rng, POSES_AT_ONCE)
    anywhere = only_projected(robot, region)
    found = solve_poses(robot, region, T, first_guesses(robot, rng, len(T)), anywhere=anywhere)
    missed = T[[len(rows) == 0 for rows in found]]
    reasons = [contradiction(robot, constraint)]
    if len(missed) < len(T) and not any(reasons):
        # the hand gets there, perhaps not with what holds on to it
        chains = [member for member in constraint if isinstance(member, TaskSpaceRegionChain)]
        reasons += [_open_chain(robot, region, member, rng) for member in chains]
    if len(missed) and not any(reasons) and region.drawable:
        reasons.append(_reach(robot, region, missed, rng, checker, constraint))
    for member in regions_of(constraint):
        # few drawn poses say nothing of turns that are all free, nor of the other hand
        if (
            region.drawable
            and (region.bounded_rows > 2).any()
            and not isinstance(member, TaskSpaceRegionChain)
            and robot.frame(member.end_effector) is robot.hand(region.end_effector)
        ):
            broken = broken_bound(member, displaced(member, T, member.T0_w[None]))
            reasons += [f"every pose breaks {broken}", other_axis(member, T[0])] if broken else []
    reasons.append(_collisions(checker, np.concatenate(found)))
    said = "; ".join(filter(None, reasons)) or contradiction(robot, constraint)
    return said or _apart(robot, region, constraint, rng)


def other_axis(member: TaskSpaceRegion, T: np.ndarray) -> str:
    """Name of the hand axis that points up at T (4, 4), "" if it is the axis of `upright`."""
    up, wanted = upper_axis(T), upper_axis(member.T0_w @ member.Tw_e)
    if member.bounded_rows.tolist() not in ([6], [3, 4]) or up == wanted:
        return ""
    return f'axis {up} of the hand points up there, not {wanted}: write "axis": "{up}"'


def _apart(
    robot: Robot, region: TaskSpaceRegion, others: Sequence[Member], rng: np.random.Generator
) -> str:
    """Return the smallest residual of all members at once, as text."""
    ends = first_guesses(robot, rng, POSES_AT_ONCE)
    T = np.broadcast_to(region.T0_w, (len(ends), 4, 4))
    solve_poses(robot, region, T, ends, others, anywhere=not region.drawable)
    states = ends.reshape(-1, robot.dof)
    if not region.drawable:
        return f"region: {_cannot_hold(robot, region, (region, *others), states)}"
    off = np.linalg.norm(RegionConstraint(robot, (region, *others)).residual(states), axis=1)
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
    T, guesses = region.poses_or_frame(rng, POSES_AT_ONCE), first_guesses(robot, rng, POSES_AT_ONCE)
    if any(map(len, solve_poses(robot, region, T, guesses, (member,), not region.drawable))):
        return ""
    return _cannot_hold(robot, member, (region, member), guesses.reshape(-1, robot.dof)) + " there"


def _cannot_hold(
    robot: Robot,
    member: Member,
    members: Sequence[Member],
    ends: np.ndarray,
) -> str:
    """Return the residual of `member` at the best of projected states `ends` (k, n), as text."""
    off = np.linalg.norm(RegionConstraint(robot, tuple(members)).residual(ends), axis=1)
    if not isinstance(member, TaskSpaceRegion):
        what = f"{member.on(robot).describe()} cannot be kept"
        return f"{what}: the best of {len(ends)} tries has |F| = {off.min():.3g}"
    broken = broken_bound(member, displacements(robot, member, ends[None, off.argmin()]))
    what = "it cannot be kept"
    if isinstance(member, TaskSpaceRegionChain):
        hand = member.end_effector or robot.end_effector
        what = f"{member.base} and {hand} cannot both hold on"
    return f"{what}: the best of {len(ends)} tries breaks {broken or 'other bounds'}"


def contradiction(robot: Robot, constraint: Sequence[Member], tries: int = 100) -> str:
    """Return which member, or pair of members, no configuration was found for; "" if none."""
    draws = robot.random_configurations(np.random.default_rng(0), tries)

    def ends(*members: Member) -> np.ndarray:
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


def _reach(
    robot: Robot,
    region: TaskSpaceRegion,
    T: np.ndarray,
    rng: np.random.Generator,
    checker: CollisionChecker,
    constraint: Sequence[Member],
) -> str:
    """Compare the distance of unreachable poses with the reach of the hand.

    Args:
        robot: the robot.
        region: poses of the end effector.
        T: poses (k, 4, 4) of the region that are not reached [m].
        rng: random numbers.
        checker: of collisions.
        constraint: regions that hold at the same time.
    """
    first = int(robot.kinematics.moves[:, robot.hand(region.end_effector)[0]].argmax())
    reach = hand_reach(robot, region.end_effector)
    away = np.linalg.norm(T[:, :3, 3] - robot.kinematics.translation[first], axis=1)
    if away.min() > reach:
        return (
            f"they lie {away.min():.2f} m or more from {robot.moving_joints[first]}, the hand "
            f"reaches {reach:.2f} m"
        )
    turned = []
    for pose in T:
        there = RegionConstraint(robot, (_anyhow(pose, region),))
        ends = map(there.project, first_guesses(robot, rng, 1)[0])
        found = [q for q in ends if q is not None]
        turned += [(pose, np.array(found))] if found else []
    if turned:
        nearest = _nearest_turned(robot, region, turned, checker, constraint)
        return (
            f"{len(turned)} of {len(T)} of their positions are reachable with another orientation, "
            f"none with the requested one{nearest}"
        )
    return (
        f"they lie from {away.min():.2f} m on from {robot.moving_joints[first]}, where the hand "
        f"reaches {reach:.2f} m, but the joint limits do not let it get there"
    )


def _nearest_turned(
    robot: Robot,
    region: TaskSpaceRegion,
    turned: Sequence[tuple[np.ndarray, np.ndarray]],
    checker: CollisionChecker,
    constraint: Sequence[Member],
    starts: int = 6,
    steps: int = 100,
) -> str:
    """Nearest reachable orientation, formatted as a command-line value; "" if none is found.

    Random steps from the best configurations, each smaller than the last that failed, are projected
    and kept if they turn the hand less.

    Args:
        robot: the robot.
        region: poses of the end effector.
        turned: poses (4, 4) of the region, and configurations (k, n) at the position of each.
        checker: of collisions.
        constraint: regions that hold at the same time.
        starts: number of configurations at which steps begin.
        steps: number of steps from each.
    """
    hand, rng = region.end_effector, np.random.default_rng(0)

    def turns(pose: np.ndarray, states: np.ndarray) -> np.ndarray:
        relative = pose[:3, :3].T @ robot.poses(states, hand)[:, :3, :3]
        return np.linalg.norm(rotation_vectors(relative), axis=1)

    def typed(q: np.ndarray) -> str:
        """Return the pose at q (n,) as text; "" if this text is not reached free of collision."""
        at = robot.pose(q, hand)
        numbers = np.concatenate([at[:3, 3], rpy_of(at[:3, :3])]).round(4) + 0.0
        T = Placement(xyz=tuple(numbers[:3]), rpy=tuple(numbers[3:])).matrix
        (ends,) = solve_poses(robot, one_pose(hand), T[None], q[None, None].copy())
        reached = len(ends) > 0 and not checker.in_collision(ends[0])
        return ",".join(f"{x:g}" for x in numbers) if reached else ""

    least, said = np.inf, ""
    few = -(-starts // len(turned))  # of each pose
    ends = [
        (pose, q) for pose, states in turned for q in states[turns(pose, states).argsort()[:few]]
    ]
    for pose, q in sorted(ends, key=lambda end: turns(end[0], end[1][None])[0])[:starts]:
        there = RegionConstraint(robot, (_anyhow(pose, region), *constraint))
        spread, off = 0.3, np.inf  # [rad or m], [rad]
        passed = []
        for step in range(steps):
            to = there.project(q + (step > 0) * spread * rng.standard_normal(robot.dof))
            turn = np.inf if to is None else float(turns(pose, to[None])[0])
            if to is None or turn >= off or checker.in_collision(to):
                spread *= 0.95
                continue
            q, off = to, turn
            passed.append((off, q))
        # the text of the very last is perhaps just out of reach
        for off, q in reversed(passed):
            if off < least and (text := typed(q)):
                least, said = off, text
                break
    return f"; the nearest one found, {np.degrees(least):.0f} deg from it: {said}" if said else ""


def _anyhow(pose: np.ndarray, region: TaskSpaceRegion) -> TaskSpaceRegion:
    """Return the region of all turns at a pose (4, 4), for the end effector of `region`."""
    bounds = np.array([[0.0, 0.0]] * 3 + [[-FREE, FREE]] * 3)
    return TaskSpaceRegion(pose, np.eye(4), bounds, end_effector=region.end_effector)


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
    pairs = [checker.colliding_pair(q) for q in configurations if checker.in_collision(q)]
    if len(pairs) < len(configurations) or not pairs:
        return ""
    most = Counter(map(str, pairs)).most_common(3)
    with_what = ", ".join(f"{pair} in {count}" for pair, count in most)
    first = next(pair for pair in pairs if str(pair) == most[0][0])
    known = cure_of_overlap(checker.robot, (first.first, first.second)) if first else ""
    said = f"all {len(pairs)} configurations that reach them collide: {with_what}"
    return "; ".join(filter(None, (said, known)))
