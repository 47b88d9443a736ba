"""Probability that a straight motion is free, from clearances in the checker's distance grid.

One logistic curve serves all robots:

    log (P(free) / (1 - P(free))) = slope * d + bias

d is the smallest clearance [m] of the robot's balls at states along the motion. Nothing is checked:
a motion costs one to two microseconds. Self-collisions are not seen.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.collision.checker import ball_clearance
from cvqmpt_lab.collision.distance_grid import DistanceGrid
from cvqmpt_lab.robot.kinematics import forward_kinematics
from cvqmpt_lab.search.motion import CLEARANCES, GAP, Space

CLEARANCE_MIN_M, CLEARANCE_MAX_M = -0.1, 0.15  # clearances of edges are cut off here


class EdgeCosts(NamedTuple):
    """What motions cost beyond their length: weight * -log P(free).

    slope, bias: fitted to 32 256 edges of three arms (docs/training_log.md, part 3).
    """

    grid: DistanceGrid  # of the scene
    slope: float = 164.01773114271577  # [1/m]
    bias: float = 6.477892406232406  # log odds at clearance 0
    weight: float = 4.0  # [rad] of -log P(free); 0: motions cost their length
    # [rad] between the states whose clearances are read; GAP times as much at most
    spacing: float = 0.3


@kernel(inline="source")
def smallest_clearance(space, grid, lowest):
    """The smallest clearance [m] of the posed robot's balls in a grid, at most `lowest`."""
    r, t, robot = space.scratch.link_rotation, space.scratch.link_translation, space.robot
    for k in range(robot.order.shape[0]):
        body = robot.order[k]
        link, node, end = robot.body_link[body], robot.body_start[body], robot.body_start[body + 1]
        while node < end:
            clearance = ball_clearance(grid, r, t, robot, link, node)
            if clearance >= lowest:  # of this ball, so of all balls in it
                node = robot.skip[node]
                continue
            if robot.leaf[node] >= 0:
                lowest = clearance
            node += 1
    return lowest


@kernel(inline="machine")
def negative_log(costs, clearance):
    """-log P(free) = log (1 + exp(-slope d - bias)) of a motion with smallest clearance d [m]."""
    odds = costs.slope * max(clearance, CLEARANCE_MIN_M) + costs.bias
    # at log odds of 18, P(free) is 1 to double precision of the costs
    return max(-odds, 0.0) + np.log1p(np.exp(-abs(odds))) if odds < 18.0 else 0.0


@kernel(inline="machine")
def readings(costs, length):
    """How many clearances are read on a motion of that length [rad]: 1, 2, 4, 8, ..."""
    count = 1
    while length > GAP * costs.spacing * count:
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
    """The smaller of lowest and reading k of the clearance [m] between a and b (n,), straight.

    Readings are at b, the middle, 1/4, 3/4, 1/8, ...; space.state and its scratch are overwritten.
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
