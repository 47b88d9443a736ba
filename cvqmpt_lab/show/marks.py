"""Marks of what cannot be seen: regions of a constraint and frames, as meshes."""

from collections.abc import Iterator

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegionChain
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.scene.shapes import Box
from cvqmpt_lab.show.meshes import Mesh, beads, cone, rod, shape_mesh


def constraint_marks(
    problem: PlanningProblem,
    states: np.ndarray,
    margin: float = 0.1,
    length: float = 0.13,
    sheet: float = 0.002,
    radius: float = 0.003,
    widest: float = 1.4,
) -> Iterator[Mesh]:
    """Planes, lines, arcs and cones of a problem's regions around a path.

    A plane or line shows where the origin of e in w may be. A cone, at both ends of the path,
    shows where an axis whose tilt is bounded, or with free rotation about itself, may point. An arc
    shows the path of a region that is attached to a door, over the door's range.

    Args:
        problem: with the regions.
        states: of the path (m, n), m >= 1.
        margin: by which planes and lines go on beyond the path [robot's reach].
        length: of cones [robot's reach].
        sheet: thickness of planes [m].
        radius: of lines [m].
        widest: half angle at which a cone is no longer drawn [rad].
    """
    robot, reach = problem.robot, problem.robot.reach
    for region in problem.constraint:
        if isinstance(region, TaskSpaceRegionChain):
            # the joint of a door; a region that hangs on the other hand is not drawn
            moved = np.flatnonzero(robot.kinematics.moves[:, region.links(robot)[0][0]])
            if len(moved) == 1:
                swept = np.repeat(states[:1], 40, axis=0)
                swept[:, moved] = np.linspace(robot.lower[moved], robot.upper[moved], 40)
                yield beads((region.reference_poses(robot, swept) @ region.Tw_e)[:, :3, 3])
            continue
        # w, displaced
        T_world_w = robot.poses(states, region.end_effector) @ np.linalg.inv(region.Tw_e)
        rows = set(region.bounded_rows.tolist())
        fixed, free = ([k for k in range(3) if (k in rows) == bound] for bound in (True, False))
        if len(free) in (1, 2):
            R, t = region.T0_w[:3, :3], region.T0_w[:3, 3]
            at = T_world_w[:, :3, 3] @ R - R.T @ t
            low, high = at.min(axis=0) - margin * reach, at.max(axis=0) + margin * reach
            low[fixed], high[fixed] = region.Bw[fixed].clip(-reach, reach).T
            x, y, z = np.maximum(high - low, sheet if len(free) == 2 else 2.0 * radius).tolist()
            T = region.T0_w.copy()
            T[:3, 3] += R @ (0.5 * (low + high))
            yield shape_mesh(Box((x, y, z))).placed(T)
        turning = [2] if 6 in rows else [k for k in range(3) if k + 3 not in rows]
        leaning = [6] if 6 in rows else [k for k in rows if k > 2]
        tilt = float(np.abs(region.bounds[leaning]).max(initial=0.0))
        if len(turning) == 1 and tilt < widest:
            for T in T_world_w[[0, -1]]:
                yield cone(T[:3, 3], length * reach * region.T0_w[:3, turning[0]], tilt)
                yield rod(T[:3, 3], T[:3, 3] + length * reach * T[:3, turning[0]], radius)


def axes_marks(reach: float, length: float = 0.08, radius: float = 0.004) -> list[Mesh]:
    """Rods along a frame's x, y, z; length and radius are shares of the robot's reach [m]."""
    return [rod(np.zeros(3), end, radius * reach) for end in length * reach * np.eye(3)]
