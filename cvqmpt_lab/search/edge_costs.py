"""Estimated probability that a straight motion is free, from the checker's distance grid.

It is a logistic function, the same for all robots:

    log (P(free) / (1 - P(free))) = slope * d + bias

d is the smallest clearance [m] of the robot's bounding balls at some states along the motion. The
estimate takes one to two microseconds. It is no collision check, and ignores self-collisions.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.collision.checker import ball_clearance
from cvqmpt_lab.collision.distance_grid import DistanceGrid
from cvqmpt_lab.robot.kinematics import forward_kinematics
from cvqmpt_lab.search.motion import CLEARANCES, MAX_BISECTED_STEPS, Space

CLEARANCE_MIN_M, CLEARANCE_MAX_M = -0.1, 0.15  # clearances of edges are clipped to this range


class EdgeCosts(NamedTuple):
    """Cost of a motion in addition to its length: weight * -log P(free).

    slope and bias were fitted to 32 256 edges of three arms (docs/training_log.md, part 3).
    """

    grid: DistanceGrid  # distances to the scene
    slope: float = 164.01773114271577  # [1/m]
    bias: float = 6.477892406232406  # log odds at clearance 0
    weight: float = 4.0  # [rad]; 0: the cost of a motion is its length
    # spacing of states whose clearances are read [rad]; up to MAX_BISECTED_STEPS times as large
    spacing: float = 0.3


@kernel(inline="source")
def smallest_clearance(space, grid, lowest):
    """Return the smaller of `lowest` and the smallest clearance [m] of the posed robot's balls."""
    r, t, robot = space.scratch.link_rotation, space.scratch.link_translation, space.robot
    for k in range(robot.order.shape[0]):
        body = robot.order[k]
        link, node, end = robot.body_link[body], robot.body_start[body], robot.body_start[body + 1]
        while node < end:
            clearance = ball_clearance(grid, r, t, robot, link, node)
            if clearance >= lowest:  # then also of all balls inside this one
                node = robot.skip[node]
                continue
            if robot.leaf[node] >= 0:
                lowest = clearance
            node += 1
    return lowest


@kernel(inline="machine")
def negative_log(costs, clearance):
    """Return -log P(free) = log (1 + exp(-slope d - bias)) for the smallest clearance d [m]."""
    odds = costs.slope * max(clearance, CLEARANCE_MIN_M) + costs.bias
    # above log odds of 18, the cost is 0 within double precision
    return max(-odds, 0.0) + np.log1p(np.exp(-abs(odds))) if odds < 18.0 else 0.0


@kernel(inline="machine")
def readings(costs, length):
    """Return the number of clearances to read along a motion of a length [rad]: 1, 2, 4, 8, ..."""
    count = 1
    while length > MAX_BISECTED_STEPS * costs.spacing * count:
        count *= 2
    return count


@entry
def reading(
    space: Space,
    costs: EdgeCosts,
    a: Annotated[np.ndarray, "n"],
    b: Annotated[np.ndarray, "n"],
    k: int,
    lowest: float,
):
    """Read the clearance at the k-th bisection point of the segment from a to b.

    The points are b, the middle, 1/4, 3/4, 1/8, ... of the segment.

    Args:
        space: the planning space; its state and scratch are overwritten.
        costs: hold the distance grid.
        a: (n,) [rad or m].
        b: (n,) [rad or m].
        k: number of the bisection point.
        lowest: upper bound of the result [m].

    Returns:
        The smaller of `lowest` and the clearance at that point [m].
    """
    level, place = 1, 1.0
    while 2 * level <= k:
        level *= 2
    if k > 0:
        place = (2 * (k - level) + 1) / (2 * level)
    for j in range(a.shape[0]):
        space.state[j] = a[j] + place * (b[j] - a[j])
    forward_kinematics(
        space.kinematics, space.state, space.scratch.link_rotation, space.scratch.link_translation
    )
    space.counters[CLEARANCES] += 1
    return smallest_clearance(space, costs.grid, lowest)
