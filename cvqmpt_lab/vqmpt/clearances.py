"""Compiled half of the edge validity model: clearances of a robot's spheres along motions, in the
distance field of a cloud or the collision checker's distance grid. Nothing is checked; a motion
costs some microseconds.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.collision.distance_grid import FARTHEST, NEAREST, DistanceGrid, ball_clearance
from cvqmpt_lab.collision.geometry import RobotGeometry
from cvqmpt_lab.jit import entry, kernel
from cvqmpt_lab.robot.kinematics import Kinematics, forward_kinematics
from cvqmpt_lab.vqmpt.edge_curve import EdgeCurve

REACH = 0.25  # [m] distances to the cloud are cut off here: more than the largest ball and FARTHEST
STEPS = 255.0  # of a stored byte


class EdgeArrays(NamedTuple):
    """Distances to a cloud on a grid, a robot's spheres, and the curve that reads their clearances."""

    origin: Annotated[np.ndarray, "3"]  # corner of the grid [m]
    cell: float  # edge of a cell [m]
    distance: Annotated[np.ndarray, "uint8 cells_x cells_y cells_z"]
    """From the middle of each cell to the nearest point of the cloud, in REACH / 255."""
    sphere: Annotated[np.ndarray, "spheres 4"]  # centre in its link's frame, and radius [m]
    row: Annotated[np.ndarray, "int64 spheres"]  # pose row of each sphere's link
    spacing: float  # at most, between the states of a motion whose clearances are read [rad]
    curve: EdgeCurve  # of the smallest clearance of all
    clearance: Annotated[np.ndarray, "n"]  # work array: of every joint's spheres the smallest [m]
    state: Annotated[np.ndarray, "n"]  # work array
    rotation: Annotated[np.ndarray, "rows 3 3"]  # work array
    translation: Annotated[np.ndarray, "rows 3"]  # work array


@entry
def fill_distances(
    points: Annotated[np.ndarray, "count 3"],
    origin: Annotated[np.ndarray, "3"],
    cell: float,
    span: Annotated[np.ndarray, "int64 2 3"],
    square: Annotated[np.ndarray, "float32 x y z"],
    distance: Annotated[np.ndarray, "uint8 x y z"],
):
    """Write the distance of every cell's middle from the nearest of points, cut off at REACH.

    span, square: work arrays, the cells around a point and squared distances.
    """
    square[:] = REACH * REACH
    low, high, step = span[0], span[1], np.float32(cell)
    for i in range(points.shape[0]):
        for a in range(3):
            at = (points[i, a] - origin[a]) / cell - 0.5
            low[a] = max(int(np.ceil(at - REACH / cell)), 0)
            high[a] = min(int(np.floor(at + REACH / cell)) + 1, square.shape[a])
        if high[2] <= low[2]:
            continue
        below = np.float32(origin[2] + (low[2] + 0.5) * cell - points[i, 2])
        for x in range(low[0], high[0]):
            dx = origin[0] + (x + 0.5) * cell - points[i, 0]
            for y in range(low[1], high[1]):
                dy = origin[1] + (y + 0.5) * cell - points[i, 1]
                if dx * dx + dy * dy > REACH * REACH:
                    continue
                across, column = np.float32(dx * dx + dy * dy), square[x, y, low[2] : high[2]]
                for z in range(column.shape[0]):  # a loop that vector instructions can take
                    dz = below + np.float32(z) * step
                    own = across + dz * dz
                    column[z] = own if own < column[z] else column[z]
    for x in range(square.shape[0]):
        for y in range(square.shape[1]):
            for z in range(square.shape[2]):
                distance[x, y, z] = np.uint8(
                    np.sqrt(square[x, y, z]) * np.float32(STEPS / REACH) + np.float32(0.5)
                )


@kernel(inline="source")
def _lower_clearances(kinematics, model, q):
    """Lower the smallest clearances seen so far to those of configuration q (n,)."""
    r, t, shape = model.rotation, model.translation, model.distance.shape
    forward_kinematics(kinematics, q, r, t)
    for k in range(model.sphere.shape[0]):
        link = model.row[k]
        x, y, z, radius = (
            model.sphere[k, 0],
            model.sphere[k, 1],
            model.sphere[k, 2],
            model.sphere[k, 3],
        )
        wx = (
            r[link, 0, 0] * x + r[link, 0, 1] * y + r[link, 0, 2] * z + t[link, 0] - model.origin[0]
        )
        wy = (
            r[link, 1, 0] * x + r[link, 1, 1] * y + r[link, 1, 2] * z + t[link, 1] - model.origin[1]
        )
        wz = (
            r[link, 2, 0] * x + r[link, 2, 1] * y + r[link, 2, 2] * z + t[link, 2] - model.origin[2]
        )
        i, j, m = (
            int(np.floor(wx / model.cell)),
            int(np.floor(wy / model.cell)),
            int(np.floor(wz / model.cell)),
        )
        if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= m < shape[2]:
            clearance = model.distance[i, j, m] * (REACH / STEPS) - radius
            model.clearance[link - 1] = min(model.clearance[link - 1], clearance)


@kernel
def clearance_along(kinematics, model, a, b):
    """Put every joint's smallest clearance along the motion from a to b (n,) into model.clearance;
    log odds of free.
    """
    length = 0.0
    for j in range(a.shape[0]):
        length += (b[j] - a[j]) * (b[j] - a[j])
        model.clearance[j] = FARTHEST
    pieces = int(np.ceil(np.sqrt(length) / model.spacing))
    for k in range(pieces + 1):
        share = k / max(pieces, 1)
        for j in range(a.shape[0]):
            model.state[j] = a[j] + share * (b[j] - a[j])
        _lower_clearances(kinematics, model, model.state)
    lowest = FARTHEST
    for j in range(a.shape[0]):
        model.clearance[j] = max(model.clearance[j], NEAREST)
        lowest = min(lowest, model.clearance[j])
    return model.curve.slope * lowest + model.curve.bias


@entry
def motion_log_odds(
    kinematics: Kinematics,
    model: EdgeArrays,
    motions: Annotated[np.ndarray, "count 2 n"],
    clearance: Annotated[np.ndarray, "count n"],
    odds: Annotated[np.ndarray, "count"],
):
    """Write every joint's smallest clearance [m] and the log odds of straight motions."""
    for i in range(motions.shape[0]):
        odds[i] = clearance_along(kinematics, model, motions[i, 0], motions[i, 1])
        for j in range(clearance.shape[1]):
            clearance[i, j] = model.clearance[j]


@entry
def scene_clearances(
    kinematics: Kinematics,
    model: EdgeArrays,
    robot: RobotGeometry,
    grid: DistanceGrid,
    motions: Annotated[np.ndarray, "count 2 n"],
    clearance: Annotated[np.ndarray, "count n"],
):
    """Write every joint's smallest clearance [m] along straight motions, in the distance grid of a
    scene.

    model: its work arrays and its spacing are used, not its cloud.
    """
    r, t, n = model.rotation, model.translation, motions.shape[2]
    for i in range(motions.shape[0]):
        length = 0.0
        for j in range(n):
            length += (motions[i, 1, j] - motions[i, 0, j]) ** 2
            clearance[i, j] = FARTHEST
        pieces = int(np.ceil(np.sqrt(length) / model.spacing))
        for k in range(pieces + 1):
            for j in range(n):
                model.state[j] = motions[i, 0, j] + k / max(pieces, 1) * (
                    motions[i, 1, j] - motions[i, 0, j]
                )
            forward_kinematics(kinematics, model.state, r, t)
            for body in robot.order:
                link, node = robot.body_link[body], robot.body_start[body]
                while node < robot.body_end[body]:
                    own = ball_clearance(grid, r, t, robot, link, node)
                    if own >= clearance[i, link - 1]:  # of this ball, so of all balls in it
                        node = robot.skip[node]
                        continue
                    if robot.leaf[node] >= 0:
                        clearance[i, link - 1] = max(own, NEAREST)
                    node += 1


@entry
def sphere_cells(
    kinematics: Kinematics,
    model: EdgeArrays,
    configurations: Annotated[np.ndarray, "count n"],
    cells: Annotated[np.ndarray, "int32 count spheres"],
):
    """Write which cell of the flattened grid each sphere's centre lies in, or -1, for
    configurations asked often.
    """
    shape = model.distance.shape
    for i in range(configurations.shape[0]):
        forward_kinematics(kinematics, configurations[i], model.rotation, model.translation)
        for k in range(model.sphere.shape[0]):
            place, inside = 0, True
            for a in range(3):
                centre = model.translation[model.row[k], a] - model.origin[a]
                for b in range(3):
                    centre += model.rotation[model.row[k], a, b] * model.sphere[k, b]
                at = int(np.floor(centre / model.cell))
                inside = inside and 0 <= at < shape[a]
                place = place * shape[a] + at
            cells[i, k] = place if inside else -1


@entry
def cell_clearances(
    model: EdgeArrays,
    distance: Annotated[np.ndarray, "uint8 flat"],
    cells: Annotated[np.ndarray, "int32 count spheres"],
    clearance: Annotated[np.ndarray, "count"],
):
    """Write the smallest clearance [m] of spheres in cells of `sphere_cells`; distance:
    the flat field.
    """
    for i in range(cells.shape[0]):
        lowest = FARTHEST
        for k in range(cells.shape[1]):
            if cells[i, k] >= 0:
                lowest = min(lowest, distance[cells[i, k]] * (REACH / STEPS) - model.sphere[k, 3])
        clearance[i] = max(lowest, NEAREST)


@entry
def edge_clearances(
    at_state: Annotated[np.ndarray, "count"],
    first: Annotated[np.ndarray, "int32 motions_and_one"],
    ends: Annotated[np.ndarray, "int32 motions 2"],
    clearance: Annotated[np.ndarray, "motions"],
):
    """Write the smallest clearance along motions from that at their states.

    first: where each motion's states between its ends begin among all. ends: rows of its ends.
    """
    for e in range(ends.shape[0]):
        clearance[e] = min(at_state[ends[e, 0]], at_state[ends[e, 1]])
        for i in range(first[e], first[e + 1]):
            clearance[e] = min(clearance[e], at_state[i])
