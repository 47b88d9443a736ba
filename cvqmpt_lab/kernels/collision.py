"""Whether a posed robot touches an obstacle or itself: conservative by construction.

Broad phase: the ball around a link piece, then the small balls that cover it, are cleared by one look-up
each in a distance grid. What is not cleared is settled between the convex hull and each nearby obstacle
by `separation.separated`, which says "free" only on the evidence of a separating slab.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.distance_grid import (
    DistanceGrid,
    Obstacles,
    clear_of_obstacles,
    distance_grid,
    point_distance,
)
from cvqmpt_lab.kernels.hull_cover import cover_by_balls, enclosing_ball
from cvqmpt_lab.kernels.separation import BOX, CYLINDER, HULL, SPHERE, ConvexShapes, separated
from cvqmpt_lab.kernels.shapes import ShapeSpec, corners, pack_shapes

CELL = 0.04  # [m] of the distance grid
FREE = -1  # stands for no obstacle index


class RobotGeometry(NamedTuple):
    """Convex pieces of a robot, its attachments included.

    Attributes
    ----------
    shapes: g pieces in their link frames. link: (g,) pose row of each.
    centre, radius: (g, 3), (g,) ball around each piece. ball_start: (g + 1,) its covering balls in
    ball_centre (b, 3), ball_radius (b,). order: pieces to check against obstacles, tip first.
    pairs: (k, 2) pieces to check against each other.
    """

    shapes: ConvexShapes
    link: np.ndarray
    centre: np.ndarray
    radius: np.ndarray
    ball_start: np.ndarray
    ball_centre: np.ndarray
    ball_radius: np.ndarray
    order: np.ndarray
    pairs: np.ndarray


class SceneGeometry(NamedTuple):
    """Obstacles, their bounds and grid; `seen` (n,) and `stamp` (1,) spare a pair a second test."""

    shapes: ConvexShapes
    bounds: Obstacles
    grid: DistanceGrid
    seen: np.ndarray
    stamp: np.ndarray


def robot_geometry(
    specs: Sequence[ShapeSpec], link: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> RobotGeometry:
    """Pieces of a robot with their covers; pieces on link 0 (the world) are not checked against obstacles."""
    balls = [cover_by_balls(corners(spec)) for spec in specs]
    bounds = [enclosing_ball(corners(spec)) for spec in specs]
    rows = np.array(link, dtype=np.int64)
    moving = [i for i in np.argsort(-rows, kind="stable") if rows[i] != 0]
    return RobotGeometry(
        shapes=pack_shapes(specs),
        link=rows,
        centre=np.array([centre for centre, _ in bounds]).reshape(-1, 3),
        radius=np.array([radius for _, radius in bounds]),
        ball_start=np.concatenate([[0], np.cumsum([len(radii) for _, radii in balls])]).astype(np.int64),
        ball_centre=np.concatenate([np.empty((0, 3)), *(centres for centres, _ in balls)]),
        ball_radius=np.concatenate([np.empty(0), *(radii for _, radii in balls)]),
        order=np.array(moving, dtype=np.int64),
        pairs=np.array(pairs, dtype=np.int64).reshape(-1, 2),
    )


def scene_geometry(
    specs: Sequence[ShapeSpec], lower: np.ndarray, upper: np.ndarray, cell: float = CELL
) -> SceneGeometry:
    """Obstacles (poses in the world) with a grid over the box lower..upper (3,) [m]."""
    if any(not np.isfinite(spec.T_owner_shape).all() for spec in specs):
        raise InvalidInputError("an obstacle's pose is not finite")
    shapes = pack_shapes(specs)
    bounds = _bounds(specs)
    n = len(specs)
    grid = distance_grid(bounds, lower, upper, cell)
    return SceneGeometry(shapes, bounds, grid, np.zeros(n, dtype=np.int64), np.zeros(1, dtype=np.int64))


def _bounds(specs: Sequence[ShapeSpec]) -> Obstacles:
    """Oriented boxes around shapes; spheres become swelled points."""
    rotation, translation, half, radius, lower, upper = [], [], [], [], [], []
    for spec in specs:
        T, swelling = spec.T_owner_shape, spec.size[0] if spec.kind == SPHERE else 0.0
        if spec.kind == HULL:
            low, high = spec.vertices.min(axis=0), spec.vertices.max(axis=0)
            middle, extent = 0.5 * (low + high), 0.5 * (high - low)
        else:
            middle = np.zeros(3)
            extent = {
                BOX: lambda size: 0.5 * np.array(size),
                CYLINDER: lambda size: np.array([size[0], size[0], 0.5 * size[2]]),
                SPHERE: lambda _: np.zeros(3),
            }[spec.kind](spec.size)
        rotation.append(T[:3, :3])
        translation.append(T[:3, :3] @ middle + T[:3, 3])
        half.append(extent)
        radius.append(swelling)
        reach = np.abs(T[:3, :3]) @ extent + swelling
        lower.append(translation[-1] - reach)
        upper.append(translation[-1] + reach)
    n = len(specs)
    return Obstacles(
        np.array(rotation).reshape(n, 3, 3),
        np.array(translation).reshape(n, 3),
        np.array(half).reshape(n, 3),
        np.array(radius).reshape(n),
        np.array(lower).reshape(n, 3),
        np.array(upper).reshape(n, 3),
    )


@kernel
def _placed(link_rotation, link_translation, link, point, k):
    """World coordinates of row k of point (m, 3), given in a link's frame."""
    x, y, z = point[k, 0], point[k, 1], point[k, 2]
    return (
        link_rotation[link, 0, 0] * x
        + link_rotation[link, 0, 1] * y
        + link_rotation[link, 0, 2] * z
        + link_translation[link, 0],
        link_rotation[link, 1, 0] * x
        + link_rotation[link, 1, 1] * y
        + link_rotation[link, 1, 2] * z
        + link_translation[link, 1],
        link_rotation[link, 2, 0] * x
        + link_rotation[link, 2, 1] * y
        + link_rotation[link, 2, 2] * z
        + link_translation[link, 2],
    )


@kernel
def _world_in_link(link_rotation, link_translation, link):
    """Pose of the world in a link's frame: 9 rotation entries by rows, then 3 of translation."""
    r = link_rotation
    x, y, z = link_translation[link, 0], link_translation[link, 1], link_translation[link, 2]
    return (
        r[link, 0, 0],
        r[link, 1, 0],
        r[link, 2, 0],
        r[link, 0, 1],
        r[link, 1, 1],
        r[link, 2, 1],
        r[link, 0, 2],
        r[link, 1, 2],
        r[link, 2, 2],
        -(r[link, 0, 0] * x + r[link, 1, 0] * y + r[link, 2, 0] * z),
        -(r[link, 0, 1] * x + r[link, 1, 1] * y + r[link, 2, 1] * z),
        -(r[link, 0, 2] * x + r[link, 1, 2] * y + r[link, 2, 2] * z),
    )


@kernel
def _hits_obstacle(link_rotation, link_translation, robot, scene, piece, i, margin):
    """Whether no separating slab was found between a piece and obstacle i."""
    link = robot.link[piece]
    pose = _world_in_link(link_rotation, link_translation, link)
    x, y, z = scene.bounds.translation[i, 0], scene.bounds.translation[i, 1], scene.bounds.translation[i, 2]
    axis = (
        robot.centre[piece, 0] - (pose[0] * x + pose[1] * y + pose[2] * z + pose[9]),
        robot.centre[piece, 1] - (pose[3] * x + pose[4] * y + pose[5] * z + pose[10]),
        robot.centre[piece, 2] - (pose[6] * x + pose[7] * y + pose[8] * z + pose[11]),
    )
    return not separated(robot.shapes, piece, scene.shapes, i, pose, axis, margin)


@kernel
def _ball_hit(link_rotation, link_translation, robot, scene, piece, ball, x, y, z, block, margin):
    """Obstacle that a piece touches near one of its covering balls, or FREE."""
    reach = robot.ball_radius[ball] + margin
    if block < 0:  # outside the grid: every obstacle is a candidate
        first, last = 0, scene.seen.shape[0]
    else:
        first, last = scene.grid.block_start[block], scene.grid.block_start[block + 1]
    for k in range(first, last):
        i = k if block < 0 else scene.grid.block_items[k]
        if scene.seen[i] == scene.stamp[0] or point_distance(scene.bounds, i, x, y, z) > reach:
            continue
        scene.seen[i] = scene.stamp[0]
        if _hits_obstacle(link_rotation, link_translation, robot, scene, piece, i, margin):
            return i
    return FREE


@kernel
def piece_hit(link_rotation, link_translation, robot, scene, piece, margin):
    """First obstacle found within margin [m] of a piece, or FREE."""
    link = robot.link[piece]
    x, y, z = _placed(link_rotation, link_translation, link, robot.centre, piece)
    clear, _ = clear_of_obstacles(scene.grid, x, y, z, robot.radius[piece] + margin)
    if clear:
        return FREE
    scene.stamp[0] += 1
    for ball in range(robot.ball_start[piece], robot.ball_start[piece + 1]):
        x, y, z = _placed(link_rotation, link_translation, link, robot.ball_centre, ball)
        clear, block = clear_of_obstacles(scene.grid, x, y, z, robot.ball_radius[ball] + margin)
        if not clear:
            hit = _ball_hit(
                link_rotation, link_translation, robot, scene, piece, ball, x, y, z, block, margin
            )
            if hit != FREE:
                return hit
    return FREE


@kernel
def pair_touches(link_rotation, link_translation, robot, a, b, margin):
    """Whether no separating slab was found between two pieces of the robot."""
    la, lb = robot.link[a], robot.link[b]
    xa, ya, za = _placed(link_rotation, link_translation, la, robot.centre, a)
    xb, yb, zb = _placed(link_rotation, link_translation, lb, robot.centre, b)
    dx, dy, dz = xa - xb, ya - yb, za - zb
    reach = robot.radius[a] + robot.radius[b] + margin
    if dx * dx + dy * dy + dz * dz > reach * reach:
        return False
    w = _world_in_link(link_rotation, link_translation, la)
    r, t = link_rotation, link_translation
    pose = (
        w[0] * r[lb, 0, 0] + w[1] * r[lb, 1, 0] + w[2] * r[lb, 2, 0],
        w[0] * r[lb, 0, 1] + w[1] * r[lb, 1, 1] + w[2] * r[lb, 2, 1],
        w[0] * r[lb, 0, 2] + w[1] * r[lb, 1, 2] + w[2] * r[lb, 2, 2],
        w[3] * r[lb, 0, 0] + w[4] * r[lb, 1, 0] + w[5] * r[lb, 2, 0],
        w[3] * r[lb, 0, 1] + w[4] * r[lb, 1, 1] + w[5] * r[lb, 2, 1],
        w[3] * r[lb, 0, 2] + w[4] * r[lb, 1, 2] + w[5] * r[lb, 2, 2],
        w[6] * r[lb, 0, 0] + w[7] * r[lb, 1, 0] + w[8] * r[lb, 2, 0],
        w[6] * r[lb, 0, 1] + w[7] * r[lb, 1, 1] + w[8] * r[lb, 2, 1],
        w[6] * r[lb, 0, 2] + w[7] * r[lb, 1, 2] + w[8] * r[lb, 2, 2],
        w[0] * t[lb, 0] + w[1] * t[lb, 1] + w[2] * t[lb, 2] + w[9],
        w[3] * t[lb, 0] + w[4] * t[lb, 1] + w[5] * t[lb, 2] + w[10],
        w[6] * t[lb, 0] + w[7] * t[lb, 1] + w[8] * t[lb, 2] + w[11],
    )
    axis = (
        w[0] * dx + w[1] * dy + w[2] * dz,
        w[3] * dx + w[4] * dy + w[5] * dz,
        w[6] * dx + w[7] * dy + w[8] * dz,
    )
    return not separated(robot.shapes, a, robot.shapes, b, pose, axis, margin)


@kernel
def state_in_collision(link_rotation, link_translation, robot, scene, margin):
    """Whether the robot with these link poses is within margin [m] of an obstacle or of itself."""
    for k in range(robot.order.shape[0]):
        if piece_hit(link_rotation, link_translation, robot, scene, robot.order[k], margin) != FREE:
            return True
    for k in range(robot.pairs.shape[0]):
        if pair_touches(link_rotation, link_translation, robot, robot.pairs[k, 0], robot.pairs[k, 1], margin):
            return True
    return False
