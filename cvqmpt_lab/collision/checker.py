"""Collision check of a posed robot, compiled and conservative: "free" is proven.

The balls of each body are checked from large to small. A ball that is free by the distance grid
ends its branch. Pieces in the other leaves are checked against each nearby obstacle by
`separation.separated`: free means that a separating slab was found. Poses that are not finite count
as collisions.

In all functions r (p, 3, 3) and t (p, 3) [m] are the poses of the links, a pose is a 12-tuple (9
rotation entries by rows, then 3 of translation [m]), and margin is in [m].
"""

import numpy as np

from cvqmpt_lab.base.jit import kernel
from cvqmpt_lab.collision.distance_grid import GRID_REACH_M, cell_of, known_distance
from cvqmpt_lab.collision.separation import box_separated, compose, separated


@kernel(inline="machine")
def _placed(r, t, link, sphere, k):
    """World position of the centre of ball k."""
    x, y, z = sphere[k, 0], sphere[k, 1], sphere[k, 2]
    return (
        r[link, 0, 0] * x + r[link, 0, 1] * y + r[link, 0, 2] * z + t[link, 0],
        r[link, 1, 0] * x + r[link, 1, 1] * y + r[link, 1, 2] * z + t[link, 1],
        r[link, 2, 0] * x + r[link, 2, 1] * y + r[link, 2, 2] * z + t[link, 2],
    )


@kernel(inline="source")
def ball_clearance(grid, rotation, translation, robot, link, node):
    """Clearance [m] of a robot's ball in a distance grid; infinite outside the grid.

    Args:
        grid: a `DistanceGrid`.
        rotation: of the links (p, 3, 3).
        translation: of the links (p, 3) [m].
        robot: a `RobotGeometry`.
        link: number of the ball's link.
        node: number of the ball.
    """
    x, y, z = _placed(rotation, translation, link, robot.sphere, node)
    ix, iy, iz, inside = cell_of(grid, x, y, z)
    return known_distance(grid, ix, iy, iz) - robot.sphere[node, 3] if inside else np.inf


@kernel(inline="machine")
def _moved(pose, x, y, z):
    """Point R p + t of a point p = (x, y, z) under the pose (R, t)."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z + pose[9],
        pose[3] * x + pose[4] * y + pose[5] * z + pose[10],
        pose[6] * x + pose[7] * y + pose[8] * z + pose[11],
    )


@kernel(inline="machine")
def _world_in_link(r, t, link):
    """Pose of the world in a link's frame."""
    x, y, z = t[link, 0], t[link, 1], t[link, 2]
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


@kernel(inline="source")
def _closest_face_offset(bounds, i, x, y, z):
    """World vector from the nearest point of item i's box to a point (x, y, z) [m]; zero inside."""
    dx, dy, dz = x - bounds[i, 9], y - bounds[i, 10], z - bounds[i, 11]
    a = bounds[i, 0] * dx + bounds[i, 3] * dy + bounds[i, 6] * dz
    b = bounds[i, 1] * dx + bounds[i, 4] * dy + bounds[i, 7] * dz
    c = bounds[i, 2] * dx + bounds[i, 5] * dy + bounds[i, 8] * dz
    a -= min(max(a, -bounds[i, 12]), bounds[i, 12])
    b -= min(max(b, -bounds[i, 13]), bounds[i, 13])
    c -= min(max(c, -bounds[i, 14]), bounds[i, 14])
    return (
        bounds[i, 0] * a + bounds[i, 1] * b + bounds[i, 2] * c,
        bounds[i, 3] * a + bounds[i, 4] * b + bounds[i, 5] * c,
        bounds[i, 6] * a + bounds[i, 7] * b + bounds[i, 8] * c,
    )


@kernel(inline="machine")
def _outside(x, half):
    """Signed distance of a coordinate from the interval [-half, half]; zero inside."""
    return x - min(max(x, -half), half)


@kernel
def _touches_primitive(pieces, piece, scene, item, pose, centre, reach, margin):
    """Whether a piece comes within a margin of a primitive of an item.

    Args:
        pieces: of the robot.
        piece: number of one of them.
        scene: a `SceneGeometry`.
        item: number of an item.
        pose: of the world in the frame of the piece's link.
        centre: of a ball around the piece, in the frame of its link [m].
        reach: radius of that ball, and the margin [m].
        margin: [m].
    """
    frame = compose(scene.shapes.rotation[item], scene.shapes.translation[item], pose)
    radius = scene.bounds[item, 15]
    dx, dy, dz = centre[0] - frame[9], centre[1] - frame[10], centre[2] - frame[11]
    x = frame[0] * dx + frame[3] * dy + frame[6] * dz
    y = frame[1] * dx + frame[4] * dy + frame[7] * dz
    z = frame[2] * dx + frame[5] * dy + frame[8] * dz
    for k in range(scene.primitive_start[item], scene.primitive_start[item + 1]):
        primitive = scene.primitives[k]
        half = (primitive[3], primitive[4], primitive[5])
        a = _outside(x - primitive[0], half[0])
        b = _outside(y - primitive[1], half[1])
        c = _outside(z - primitive[2], half[2])
        if a * a + b * b + c * c > (reach + radius) * (reach + radius):
            continue
        p = _moved(frame, primitive[0], primitive[1], primitive[2])
        axis = (centre[0] - p[0], centre[1] - p[1], centre[2] - p[2])
        if not box_separated(pieces, piece, half, radius, frame[:9] + p, axis, margin):
            return True
    return False


@kernel(inline="source")
def _touches_item(r, t, robot, scene, link, node, where, margin):
    """Whether an item is within a margin of the piece in a leaf.

    where: x, y, z [m] of its ball's centre, ix, iy, iz of its cell, whether that is in the grid.
    """
    x, y, z, ix, iy, iz, inside = where
    piece, reach = robot.leaf[node], robot.sphere[node, 3] + margin
    listed = inside and reach <= GRID_REACH_M
    first, count = 0, scene.bounds.shape[0]
    if listed:
        first = scene.grid.list_start[ix >> 1, iy >> 1, iz >> 1]
        count = scene.grid.list_count[ix >> 1, iy >> 1, iz >> 1]
    pose = _world_in_link(r, t, link)
    for k in range(first, first + count):
        i = np.int64(scene.grid.items[k]) if listed else np.int64(k)
        ax, ay, az = _closest_face_offset(scene.bounds, i, x, y, z)
        distance2, limit = ax * ax + ay * ay + az * az, reach + scene.bounds[i, 15]
        if distance2 > limit * limit:
            continue
        if not distance2 > 0.0:
            ax, ay, az = x - scene.bounds[i, 9], y - scene.bounds[i, 10], z - scene.bounds[i, 11]
        axis = (
            pose[0] * ax + pose[1] * ay + pose[2] * az,
            pose[3] * ax + pose[4] * ay + pose[5] * az,
            pose[6] * ax + pose[7] * ay + pose[8] * az,
        )
        if separated(robot.pieces, piece, scene.shapes, i, pose, axis, margin):
            continue
        centre = robot.sphere[node, 0], robot.sphere[node, 1], robot.sphere[node, 2]
        solid = scene.primitive_start[i] == scene.primitive_start[i + 1]
        if solid or _touches_primitive(robot.pieces, piece, scene, i, pose, centre, reach, margin):
            return True
    return False


@kernel(inline="source")
def _touches_obstacle(r, t, robot, scene, body, margin):
    """Whether an obstacle is within a margin of a body, or the body's pose is not finite."""
    link = robot.body_link[body]
    node, end = robot.body_start[body], robot.body_start[body + 1]
    while node < end:
        x, y, z = _placed(r, t, link, robot.sphere, node)
        ix, iy, iz, inside = cell_of(scene.grid, x, y, z)
        if inside:
            if known_distance(scene.grid, ix, iy, iz) > robot.sphere[node, 3] + margin:
                node = robot.skip[node]
                continue
        elif not abs(x) + abs(y) + abs(z) < np.inf:
            return True
        where = x, y, z, ix, iy, iz, inside
        if robot.leaf[node] >= 0 and _touches_item(r, t, robot, scene, link, node, where, margin):
            return True
        node += 1
    return False


@kernel(inline="source")
def _touches_body(robot, piece, x, y, z, radius, other, pose, margin):
    """Whether a piece of another body is within a margin of a piece.

    Args:
        robot: a `RobotGeometry`.
        piece: number of the piece.
        x: of the centre of the piece's ball, in the frame of its link [m].
        y: of that centre [m].
        z: of that centre [m].
        radius: of that ball, and the margin [m].
        other: number of the other body.
        pose: of the other body's link in the frame of the piece's link.
        margin: [m].
    """
    node, end = robot.body_start[other], robot.body_start[other + 1]
    while node < end:
        p = _moved(pose, robot.sphere[node, 0], robot.sphere[node, 1], robot.sphere[node, 2])
        axis = (x - p[0], y - p[1], z - p[2])
        limit = radius + robot.sphere[node, 3]
        if axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2] > limit * limit:
            node = robot.skip[node]
            continue
        if robot.leaf[node] >= 0 and not separated(
            robot.pieces, piece, robot.pieces, robot.leaf[node], pose, axis, margin
        ):
            return True
        node += 1
    return False


@kernel(inline="source")
def _bodies_touch(r, t, robot, a, b, xa, ya, za, margin):
    """Whether bodies a and b come within a margin; xa, ya, za [m]: centre of a's largest ball."""
    la, lb = robot.body_link[a], robot.body_link[b]
    node, end, root = robot.body_start[a], robot.body_start[a + 1], robot.body_start[b]
    xb, yb, zb = _placed(r, t, lb, robot.sphere, root)
    limit = robot.sphere[node, 3] + robot.sphere[root, 3] + margin
    if (xa - xb) * (xa - xb) + (ya - yb) * (ya - yb) + (za - zb) * (za - zb) > limit * limit:
        return False
    world = _world_in_link(r, t, la)
    pose = compose(r[lb], t[lb], world)
    x, y, z = _moved(world, xb, yb, zb)
    while node < end:
        dx, dy, dz = robot.sphere[node, 0] - x, robot.sphere[node, 1] - y, robot.sphere[node, 2] - z
        radius = robot.sphere[node, 3] + margin
        limit = radius + robot.sphere[root, 3]
        if dx * dx + dy * dy + dz * dz > limit * limit:
            node = robot.skip[node]
            continue
        piece = robot.leaf[node]
        if piece >= 0:
            cx, cy, cz = robot.sphere[node, 0], robot.sphere[node, 1], robot.sphere[node, 2]
            if _touches_body(robot, piece, cx, cy, cz, radius, b, pose, margin):
                return True
        node += 1
    return False


@kernel
def in_contact(link_rotation, link_translation, robot, scene, margin):
    """Whether a posed robot comes within a margin of an obstacle or of itself.

    Args:
        link_rotation: (p, 3, 3), from `forward_kinematics`.
        link_translation: (p, 3) [m].
        robot: a `RobotGeometry`.
        scene: a `SceneGeometry`.
        margin: [m].

    Returns:
        True in contact, or if a link pose is not finite.
    """
    for k in range(robot.order.shape[0]):
        if _touches_obstacle(link_rotation, link_translation, robot, scene, robot.order[k], margin):
            return True
    placed = -1
    x = y = z = 0.0
    for k in range(robot.pairs.shape[0]):
        a, b = robot.pairs[k, 0], robot.pairs[k, 1]
        if a != placed:
            placed, link = a, robot.body_link[a]
            x, y, z = _placed(
                link_rotation, link_translation, link, robot.sphere, robot.body_start[a]
            )
        if _bodies_touch(link_rotation, link_translation, robot, a, b, x, y, z, margin):
            return True
    return False
