"""Why no configuration was found for a region of poses:
reach, the constraint and collisions, in words.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.collision.exact import CollisionChecker
from cvqmpt_lab.constraints.inverse_kinematics import ATTEMPTS, first_guesses, solve_poses
from cvqmpt_lab.constraints.report import broken_bound, displaced
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    RegionConstraint,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
)
from cvqmpt_lab.robot.robot import Robot

POSES = 25  # of the region that are looked at
HANDS = 4000  # random configurations by which the hand's reach is measured
SPREADS = (0.3, 0.2, 0.1, 0.05)  # [rad or m] around the best of them, round by round
MOST_PAIRS = 3  # of colliding pieces that are named


def why_none(
    robot: Robot,
    region: TaskSpaceRegion,
    checker: CollisionChecker,
    constraint: Sequence[TaskSpaceRegion],
) -> str:
    """The reasons that hold, "; " between them: out of reach, against the constraint, in collision;
    "" if none.
    """
    rng = np.random.default_rng(0)
    T = region.sample_poses(rng, POSES)
    found = solve_poses(robot, T, rng)
    missed = T[[len(rows) == 0 for rows in found]]
    reasons = (
        _reach(robot, missed, rng) if len(missed) else "",
        *(
            _broken(member, T)
            for member in constraint
            if not isinstance(member, TaskSpaceRegionChain)
        ),
        _collisions(checker, np.concatenate(found)),
    )
    return "; ".join(filter(None, reasons))


def _reach(robot: Robot, T: np.ndarray, rng: np.random.Generator) -> str:
    """How far poses (k, 4, 4) without inverse kinematics are, and how far the hand reaches."""
    axis, reach = robot.kinematics.translation[0], hand_reach(robot)
    away = np.linalg.norm(T[:, :3, 3] - axis, axis=1)
    if away.min() > reach:
        return (
            f"they lie {away.min():.2f} m or more from {robot.joint_names[0]}, the hand "
            f"reaches {reach:.2f} m"
        )
    turned = sum(_position_reached(robot, pose, rng) for pose in T)
    if turned:
        return (
            f"turned otherwise the hand gets to {turned} of {len(T)} of their places, turned "
            f"as asked to none"
        )
    near = (
        f"from {away.min():.2f} m on from {robot.joint_names[0]}, where the hand reaches "
        f"{reach:.2f} m"
    )
    return f"they lie {near}, but the joint limits do not let it get there"


def hand_reach(robot: Robot) -> float:
    """Distance [m] from the first joint that the hand gets to, in random configurations and around
    the best one.
    """
    axis, rng = robot.kinematics.translation[0], np.random.default_rng(0)
    configurations, best, reach = robot.random_configurations(rng, HANDS), robot.lower, 0.0
    for spread in SPREADS:
        away = np.linalg.norm(robot.poses(configurations)[:, :3, 3] - axis, axis=1)
        if away.max() > reach:
            best, reach = configurations[away.argmax()], float(away.max())
        near = best + spread * rng.standard_normal((HANDS // 8, robot.dof))
        configurations = near.clip(robot.lower, robot.upper)
    return reach


def _position_reached(robot: Robot, T: np.ndarray, rng: np.random.Generator) -> bool:
    """Whether the hand gets to the place of a pose (4, 4), turned in any way."""
    place = TaskSpaceRegion(T, np.eye(4), np.array([[0.0, 0.0]] * 3 + [[-FREE, FREE]] * 3))
    manifold = RegionConstraint(robot, (place,))
    return any(manifold.project(q) is not None for q in first_guesses(robot, rng, 1, ATTEMPTS)[0])


def _broken(member: TaskSpaceRegion, T: np.ndarray) -> str:
    """How the best of poses (k, 4, 4) breaks a region of the constraint; "" when one keeps it."""
    said = broken_bound(member, displaced(member, T, member.T0_w[None]))
    return f"every pose breaks {said}" if said else ""


def _collisions(checker: CollisionChecker, configurations: np.ndarray) -> str:
    """With what configurations (k, n) collide, the most frequent pairs first; "" when one is free."""
    pairs = [str(checker.colliding_pair(q)) for q in configurations if checker.in_collision(q)]
    if len(pairs) < len(configurations) or not pairs:
        return ""
    most = Counter(pairs).most_common(MOST_PAIRS)
    with_what = ", ".join(f"{pair} in {count}" for pair, count in most)
    return f"all {len(pairs)} configurations that reach them collide: {with_what}"
