"""How likely straight motions are free: clearances in the checker's distance grid, one logistic curve for all robots.

    log odds of P(free) = slope * smallest clearance + bias

The clearance is that of the robot's balls at states along the motion, read from a grid that the collision checker has
anyway. Nothing is checked; a motion costs one to two microseconds. Self-collisions are not seen.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.collision.distance_grid import FARTHEST, NEAREST, DistanceGrid, ball_clearance
from cvqmpt_lab.jit import entry, kernel
from cvqmpt_lab.robot.kinematics import forward_kinematics
from cvqmpt_lab.search.motion import CLEARANCES, Space


class EdgeCosts(NamedTuple):
    """What motions cost beyond their length."""

    grid: DistanceGrid  # of the scene
    slope: float  # [1/m]
    bias: float  # log odds at clearance 0
    weight: float = 4.0  # [rad] of -log P(free); 0: motions cost their length
    spacing: float = 0.3  # [rad] between the states whose clearances are read


@kernel(inline="source")
def smallest_clearance(space, grid, lowest):
    """The smaller of lowest and the smallest clearance [m] of the robot's balls, posed in the scratch, in a grid."""
    r, t, robot = space.scratch.link_rotation, space.scratch.link_translation, space.robot
    for k in range(robot.order.shape[0]):
        body = robot.order[k]
        link, node, end = robot.body_link[body], robot.body_start[body], robot.body_end[body]
        while node < end:
            clearance = ball_clearance(grid, r, t, robot, link, node)
            if clearance >= lowest:  # of this ball, so of all balls in it
                node = robot.skip[node]
                continue
            if robot.leaf[node] >= 0:
                lowest = clearance
            node += 1
    return lowest


@entry
def edge_nll(space: Space, costs: EdgeCosts, a: Annotated[np.ndarray, "n"], b: Annotated[np.ndarray, "n"]):
    """-log P(free) of the straight motion from a to b (n,); space.state and its scratch are overwritten."""
    length, lowest = 0.0, FARTHEST
    for j in range(a.shape[0]):
        length += (b[j] - a[j]) * (b[j] - a[j])
    length = np.sqrt(length)
    pieces = max(int(np.ceil(length / costs.spacing)), 1)
    for k in range(pieces + 1):
        if lowest > NEAREST:
            for j in range(a.shape[0]):
                space.state[j] = a[j] + k / pieces * (b[j] - a[j])
            forward_kinematics(
                space.kinematics, space.state, space.scratch.link_rotation, space.scratch.link_translation
            )
            lowest = smallest_clearance(space, costs.grid, lowest)
            space.counters[CLEARANCES] += 1
    odds = costs.slope * max(lowest, NEAREST) + costs.bias
    return max(-odds, 0.0) + np.log1p(np.exp(-abs(odds)))
