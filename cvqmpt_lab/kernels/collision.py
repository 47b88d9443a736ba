"""Whether a posed robot touches an obstacle or itself: conservative by construction.

Broad phase: the ball around a link piece, then the small balls that cover it, are cleared by one look-up
each in a distance grid. What is not cleared is settled between the convex hull and each nearby obstacle
by `separation.separated`, which says "free" only on the evidence of a separating slab.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.compiling import inlined, kernel
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
    """Convex pieces of a robot, its attachments included, sorted by link.

    Attributes
    ----------
    shapes: g pieces in their link frames. link: (g,) pose row of each.
    centre, radius: (g, 3), (g,) ball around each piece. ball_start: (g + 1,) its covering balls in
    ball_centre (b, 3), ball_radius (b,).
    link_centre, link_radius: (n + 1, 3), (n + 1,) ball around all pieces of a link.
    link_start: (n + 2,) first piece of each link; pieces of link 0 (the world) never meet obstacles.
    groups: (m, 4) link, other link, first and one-past-last row of `pairs` between them.
    pairs: (k, 2) pieces to check against each other. placed: (n + 1, 3) work array.
    """

    shapes: ConvexShapes
    link: np.ndarray
    centre: np.ndarray
    radius: np.ndarray
    ball_start: np.ndarray
    ball_centre: np.ndarray
    ball_radius: np.ndarray
    link_centre: np.ndarray
    link_radius: np.ndarray
    link_start: np.ndarray
    groups: np.ndarray
    pairs: np.ndarray
    placed: np.ndarray


class SceneGeometry(NamedTuple):
    """Obstacles, their bounds and grid; `seen` (n,) and `stamp` (1,) spare a pair a second test."""

    shapes: ConvexShapes
    bounds: Obstacles
    grid: DistanceGrid
    seen: np.ndarray
    stamp: np.ndarray


def robot_geometry(
    specs: Sequence[ShapeSpec], link: Sequence[int], pairs: Sequence[tuple[int, int]], n_links: int
) -> RobotGeometry:
    """Pieces of a robot with their covers.

    link: pose row of each piece, below n_links. pairs: indices into specs to check against each other.
    """
    order = np.argsort(link, kind="stable")
    specs = [specs[i] for i in order]
    rows = np.array(link, dtype=np.int64)[order]
    place = np.argsort(order)  # new position of each piece
    balls = [cover_by_balls(corners(spec)) for spec in specs]
    bounds = [enclosing_ball(corners(spec)) for spec in specs]
    link_centre, link_radius = np.zeros((n_links, 3)), np.full(n_links, -1.0)
    for row in set(rows.tolist()):
        points = np.concatenate([corners(spec) for spec, own in zip(specs, rows, strict=True) if own == row])
        link_centre[row], link_radius[row] = enclosing_ball(points)
    sorted_pairs, groups = _grouped([(int(place[i]), int(place[j])) for i, j in pairs], rows)
    return RobotGeometry(
        shapes=pack_shapes(specs),
        link=rows,
        centre=np.array([centre for centre, _ in bounds]).reshape(-1, 3),
        radius=np.array([radius for _, radius in bounds]),
        ball_start=np.concatenate([[0], np.cumsum([len(radii) for _, radii in balls])]).astype(np.int64),
        ball_centre=np.concatenate([np.empty((0, 3)), *(centres for centres, _ in balls)]),
        ball_radius=np.concatenate([np.empty(0), *(radii for _, radii in balls)]),
        link_centre=link_centre,
        link_radius=link_radius,
        link_start=np.searchsorted(rows, np.arange(n_links + 1)).astype(np.int64),
        groups=groups,
        pairs=sorted_pairs,
        placed=np.zeros((n_links, 3)),
    )


def _grouped(pairs: list[tuple[int, int]], rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs sorted by the two links they join, tip first, and one group row per pair of links."""
    ordered = sorted(((min(pair), max(pair)) for pair in pairs), reverse=True)
    by_links = sorted(ordered, key=lambda pair: (-rows[pair[1]], rows[pair[0]]))
    groups: list[list[int]] = []
    for k, (a, b) in enumerate(by_links):
        links = [int(rows[a]), int(rows[b])]
        if not groups or groups[-1][:2] != links:
            groups.append([*links, k, k])
        groups[-1][3] = k + 1
    return (
        np.array(by_links, dtype=np.int64).reshape(-1, 2),
        np.array(groups, dtype=np.int64).reshape(-1, 4),
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


@inlined
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


@inlined
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


@inlined
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


@inlined
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


@inlined
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


@inlined
def _cover_near(robot, piece, point, radius):
    """Whether a covering ball of a piece meets the ball around a point in its link's frame."""
    for ball in range(robot.ball_start[piece], robot.ball_start[piece + 1]):
        dx = robot.ball_centre[ball, 0] - point[0]
        dy = robot.ball_centre[ball, 1] - point[1]
        dz = robot.ball_centre[ball, 2] - point[2]
        reach = robot.ball_radius[ball] + radius
        if dx * dx + dy * dy + dz * dz <= reach * reach:
            return True
    return False


@inlined
def _link_in_link(link_rotation, link_translation, a, b):
    """Pose of link b in the frame of link a: 9 rotation entries by rows, then 3 of translation."""
    w = _world_in_link(link_rotation, link_translation, a)
    r, t = link_rotation, link_translation
    return (
        w[0] * r[b, 0, 0] + w[1] * r[b, 1, 0] + w[2] * r[b, 2, 0],
        w[0] * r[b, 0, 1] + w[1] * r[b, 1, 1] + w[2] * r[b, 2, 1],
        w[0] * r[b, 0, 2] + w[1] * r[b, 1, 2] + w[2] * r[b, 2, 2],
        w[3] * r[b, 0, 0] + w[4] * r[b, 1, 0] + w[5] * r[b, 2, 0],
        w[3] * r[b, 0, 1] + w[4] * r[b, 1, 1] + w[5] * r[b, 2, 1],
        w[3] * r[b, 0, 2] + w[4] * r[b, 1, 2] + w[5] * r[b, 2, 2],
        w[6] * r[b, 0, 0] + w[7] * r[b, 1, 0] + w[8] * r[b, 2, 0],
        w[6] * r[b, 0, 1] + w[7] * r[b, 1, 1] + w[8] * r[b, 2, 1],
        w[6] * r[b, 0, 2] + w[7] * r[b, 1, 2] + w[8] * r[b, 2, 2],
        w[0] * t[b, 0] + w[1] * t[b, 1] + w[2] * t[b, 2] + w[9],
        w[3] * t[b, 0] + w[4] * t[b, 1] + w[5] * t[b, 2] + w[10],
        w[6] * t[b, 0] + w[7] * t[b, 1] + w[8] * t[b, 2] + w[11],
    )


@inlined
def _pair_touches(robot, a, b, pose, margin):
    """Whether no separating slab was found between two pieces; pose is b's link in a's link frame."""
    x, y, z = robot.centre[b, 0], robot.centre[b, 1], robot.centre[b, 2]
    centre = (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[9],
        pose[3] * x + pose[4] * y + pose[5] * z + pose[10],
        pose[6] * x + pose[7] * y + pose[8] * z + pose[11],
    )
    if not _cover_near(robot, a, centre, robot.radius[b] + margin):
        return False
    axis = (
        robot.centre[a, 0] - centre[0],
        robot.centre[a, 1] - centre[1],
        robot.centre[a, 2] - centre[2],
    )
    return not separated(robot.shapes, a, robot.shapes, b, pose, axis, margin)


@inlined
def _link_hits_obstacle(link_rotation, link_translation, robot, scene, link, margin):
    """Whether a piece of a link is within margin [m] of an obstacle."""
    x, y, z = robot.placed[link, 0], robot.placed[link, 1], robot.placed[link, 2]
    clear, _ = clear_of_obstacles(scene.grid, x, y, z, robot.link_radius[link] + margin)
    if clear:
        return False
    for piece in range(robot.link_start[link], robot.link_start[link + 1]):
        if piece_hit(link_rotation, link_translation, robot, scene, piece, margin) != FREE:
            return True
    return False


@inlined
def _group_touches(link_rotation, link_translation, robot, group, margin):
    """Whether two links are within margin [m] of each other."""
    a, b = robot.groups[group, 0], robot.groups[group, 1]
    dx = robot.placed[a, 0] - robot.placed[b, 0]
    dy = robot.placed[a, 1] - robot.placed[b, 1]
    dz = robot.placed[a, 2] - robot.placed[b, 2]
    reach = robot.link_radius[a] + robot.link_radius[b] + margin
    if dx * dx + dy * dy + dz * dz > reach * reach:
        return False
    pose = _link_in_link(link_rotation, link_translation, a, b)
    for k in range(robot.groups[group, 2], robot.groups[group, 3]):
        if _pair_touches(robot, robot.pairs[k, 0], robot.pairs[k, 1], pose, margin):
            return True
    return False


@kernel
def state_in_collision(link_rotation, link_translation, robot, scene, margin):
    """Whether the robot with these link poses is within margin [m] of an obstacle or of itself."""
    n_links = robot.link_radius.shape[0]
    for link in range(n_links):
        x, y, z = _placed(link_rotation, link_translation, link, robot.link_centre, link)
        robot.placed[link, 0], robot.placed[link, 1], robot.placed[link, 2] = x, y, z
        if not np.isfinite(x + y + z):
            return True
    for link in range(n_links - 1, 0, -1):
        if robot.link_radius[link] >= 0.0 and _link_hits_obstacle(
            link_rotation, link_translation, robot, scene, link, margin
        ):
            return True
    for group in range(robot.groups.shape[0]):
        if _group_touches(link_rotation, link_translation, robot, group, margin):
            return True
    return False
