"""What a picture shows beside bodies:
the hand's axes, and the constraint as planes, lines, arcs and cones.
"""

from collections.abc import Iterator

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, TaskSpaceRegionChain
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.shapes import Box, Cylinder
from cvqmpt_lab.show.meshes import (
    Colour,
    Mesh,
    beads,
    hull_mesh,
    joined,
    poses_along,
    shape_mesh,
    unit,
)

# x, y, z
AXIS_COLOURS: tuple[Colour, ...] = ((0.85, 0.15, 0.15), (0.15, 0.60, 0.15), (0.15, 0.30, 0.85))
CONSTRAINT_COLOUR: Colour = (0.60, 0.25, 0.72)
AXIS, AXIS_RADIUS = 0.08, 0.004  # of the robot's reach: length of the hand's axes and their radius
CONE = 0.13  # of the robot's reach: length of the cone of a tilt
SHEET, LINE_RADIUS = 0.002, 0.003  # [m] thickness of planes, radius of lines
WIDEST = 1.4  # [rad] half angle at which a cone is no longer drawn
MARGIN = 0.1  # of the robot's reach by which planes and lines go on beyond the path
ARC_STATES = 40  # of the range of what a region hangs on


def hand_axes(problem: PlanningProblem, q: np.ndarray) -> Mesh:
    """The end effector's axes at q (n,): x red, y green, z blue."""
    length, radius = AXIS * problem.robot.reach, AXIS_RADIUS * problem.robot.reach
    T = poses_along(problem.robot, q[None])[1][0]
    rods = [_rod(T[:3, 3], T[:3, 3] + length * T[:3, k], radius, AXIS_COLOURS[k]) for k in range(3)]
    return joined(rods)


def constraint_marks(problem: PlanningProblem, states: np.ndarray) -> list[Mesh]:
    """Planes, lines, arcs and cones of a problem's regions around a path's states (m, n), m >= 1.

    A plane or line is drawn where the origin of e in w may move; a cone, at both ends of the path,
    where its axis may point that turns about itself freely; an arc is the way of a region that
    hangs on a door, over the door's range.
    """
    return [mark for region in problem.constraint for mark in _marks(problem, region, states)]


def _marks(problem: PlanningProblem, region: TaskSpaceRegion, states: np.ndarray) -> Iterator[Mesh]:
    reach, rows = problem.robot.reach, set(region.bounded_rows.tolist())
    hands = poses_along(problem.robot, states)[1] @ np.linalg.inv(region.Tw_e)  # w, displaced
    if isinstance(region, TaskSpaceRegionChain):
        yield from _arc(problem, region, states[0])
        return
    free = [k for k in range(3) if k not in rows]
    if len(free) in (1, 2):
        at = hands[:, :3, 3] @ region.T0_w[:3, :3] - region.T0_w[:3, :3].T @ region.T0_w[:3, 3]
        low, high = at.min(axis=0) - MARGIN * reach, at.max(axis=0) + MARGIN * reach
        fixed = [k for k in range(3) if k in rows]
        low[fixed], high[fixed] = region.Bw[fixed].clip(-reach, reach).T
        middle, size = (
            0.5 * (low + high),
            np.maximum(high - low, SHEET if len(free) == 2 else 2 * LINE_RADIUS),
        )
        T = region.T0_w.copy()
        T[:3, 3] += T[:3, :3] @ middle
        yield shape_mesh(Box((float(size[0]), float(size[1]), float(size[2])))).placed(
            T, CONSTRAINT_COLOUR
        )
    turning = [k for k in range(3) if k + 3 not in rows]
    widest = float(np.abs(region.Bw[[k for k in rows if k > 2]]).max(initial=0.0))
    if len(turning) == 1 and widest < WIDEST:
        for T in hands[[0, -1]]:
            yield _cone(T[:3, 3], CONE * reach * region.T0_w[:3, turning[0]], widest)
            end = T[:3, 3] + CONE * reach * T[:3, turning[0]]
            yield _rod(T[:3, 3], end, LINE_RADIUS, CONSTRAINT_COLOUR)


def _arc(problem: PlanningProblem, region: TaskSpaceRegionChain, q: np.ndarray) -> Iterator[Mesh]:
    """Where the region's frame goes while the joints that move it, and not the hand, go through
    their range.
    """
    robot = problem.robot
    row, _ = region.reference_link(robot)
    moved = np.flatnonzero(robot.kinematics.moves[:, row])
    if len(moved):
        states = np.repeat(q[None], ARC_STATES, axis=0)
        states[:, moved] = np.linspace(robot.lower[moved], robot.upper[moved], ARC_STATES)
        yield beads(
            (region.reference_poses(robot, states) @ region.Tw_e)[:, :3, 3], CONSTRAINT_COLOUR
        )


def _cone(apex: np.ndarray, axis: np.ndarray, angle: float) -> Mesh:
    """A cone from its apex (3,) along an axis (3,) [m], of a half angle [rad]."""
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across = np.tan(max(angle, 0.01)) * np.stack(
        [np.linalg.norm(axis) * unit(x), np.cross(unit(axis), unit(x)) * np.linalg.norm(axis)]
    )
    turn = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    rim = apex + axis + np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across
    return hull_mesh(np.vstack([apex, rim])).placed(np.eye(4), CONSTRAINT_COLOUR)


def _rod(start: np.ndarray, end: np.ndarray, radius: float, colour: Colour) -> Mesh:
    """A cylinder between two points (3,) [m]."""
    z = end - start
    x = unit(np.cross(z, np.eye(3)[np.argmin(np.abs(z))]))
    T = np.eye(4)
    T[:3] = np.stack([x, np.cross(unit(z), x), unit(z), 0.5 * (start + end)], axis=1)
    return shape_mesh(Cylinder(radius, float(np.linalg.norm(z)))).placed(T, colour)
