"""Collision check of a posed robot, compiled and conservative: "free" is proven.

The balls of each body are checked from large to small. A ball that is free by the distance grid
ends its branch. Pieces in the other leaves are checked against each nearby obstacle by
`separation.slab_between`: free means that a separating slab was found. Poses that are not finite
count as collisions.

One check also tells how far the robot may move (conservative advancement, Mirtich 1996): a body
whose points move at most `rate` metres per metre of advance stays free for

    advance <= (distance - margin) / rate

In all functions r (p, 3, 3) and t (p, 3) [m] are the poses of the links, a pose is a 12-tuple (9
rotation entries by rows, then 3 of translation [m]), margin is in [m], and advance [m] is the
largest one that was proven so far. The functions return it, lowered where something is close, or
CONTACT.
"""

import numpy as np

from cvqmpt_lab.base.jit import kernel
from cvqmpt_lab.collision.distance_grid import GRID_REACH_M, cell_of, known_distance
from cvqmpt_lab.collision.separation import compose, slab_between, slab_to_box

CONTACT = -1.0


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


@kernel(inline="machine")
def _lowered(advance, gap, rate, margin):
    """Largest advance that a gap [m] between two pieces allows, or CONTACT."""
    if gap > margin + rate * advance:
        return advance
    return (gap - margin) / rate if gap > margin else CONTACT


@kernel
def _to_primitives(pieces, piece, scene, item, pose, ball, rate, margin, advance):
    """Advance that the primitives of an item allow a piece.

    Args:
        pieces: convex pieces of the robot.
        piece: number of one of them.
        scene: a `SceneGeometry`.
        item: number of an item.
        pose: of the world in the frame of the piece's link.
        ball: centre of a ball around the piece, in the frame of its link, and its radius [m].
        rate: rate of the piece.
        margin: [m].
        advance: [m].
    """
    frame = compose(scene.shapes.rotation[item], scene.shapes.translation[item], pose)
    radius = scene.bounds[item, 15]
    dx, dy, dz = ball[0] - frame[9], ball[1] - frame[10], ball[2] - frame[11]
    x = frame[0] * dx + frame[3] * dy + frame[6] * dz
    y = frame[1] * dx + frame[4] * dy + frame[7] * dz
    z = frame[2] * dx + frame[5] * dy + frame[8] * dz
    for k in range(scene.primitive_start[item], scene.primitive_start[item + 1]):
        primitive = scene.primitives[k]
        half = (primitive[3], primitive[4], primitive[5])
        a = _outside(x - primitive[0], half[0])
        b = _outside(y - primitive[1], half[1])
        c = _outside(z - primitive[2], half[2])
        enough = margin + rate * advance
        limit = ball[3] + enough + radius
        if a * a + b * b + c * c > limit * limit:
            continue
        p = _moved(frame, primitive[0], primitive[1], primitive[2])
        axis = (ball[0] - p[0], ball[1] - p[1], ball[2] - p[2])
        gap = slab_to_box(pieces, piece, half, radius, frame[:9] + p, axis, enough, margin)
        advance = _lowered(advance, gap, rate, margin)
        if advance < 0.0:
            return CONTACT
    return advance


@kernel(inline="source")
def _to_items(r, t, robot, scene, link, node, where, rate, margin, advance):
    """Advance that nearby items allow the piece in a leaf.

    where: x, y, z [m] of its ball's centre, ix, iy, iz of its cell, whether that is in the grid.
    """
    x, y, z, ix, iy, iz, inside = where
    piece, radius = robot.leaf[node], robot.sphere[node, 3]
    # the lists hold what is within GRID_REACH_M: nothing further away is needed
    if rate * advance > GRID_REACH_M - radius - margin >= 0.0:
        advance = (GRID_REACH_M - radius - margin) / rate
    listed = inside and radius + margin <= GRID_REACH_M
    first, count = 0, scene.bounds.shape[0]
    if listed:
        first = scene.grid.list_start[ix >> 1, iy >> 1, iz >> 1]
        count = scene.grid.list_count[ix >> 1, iy >> 1, iz >> 1]
    pose = _world_in_link(r, t, link)
    for k in range(first, first + count):
        i = np.int64(scene.grid.items[k]) if listed else np.int64(k)
        ax, ay, az = _closest_face_offset(scene.bounds, i, x, y, z)
        enough = margin + rate * advance
        distance2, limit = ax * ax + ay * ay + az * az, radius + enough + scene.bounds[i, 15]
        if distance2 > limit * limit:
            continue
        if not distance2 > 0.0:
            ax, ay, az = x - scene.bounds[i, 9], y - scene.bounds[i, 10], z - scene.bounds[i, 11]
        axis = (
            pose[0] * ax + pose[1] * ay + pose[2] * az,
            pose[3] * ax + pose[4] * ay + pose[5] * az,
            pose[6] * ax + pose[7] * ay + pose[8] * az,
        )
        gap = slab_between(robot.pieces, piece, scene.shapes, i, pose, axis, enough, margin)
        if gap > enough:
            continue
        if scene.primitive_start[i] == scene.primitive_start[i + 1]:
            advance = _lowered(advance, gap, rate, margin)
        else:
            centre = robot.sphere[node, 0], robot.sphere[node, 1], robot.sphere[node, 2]
            ball = centre + (radius,)
            advance = _to_primitives(
                robot.pieces, piece, scene, i, pose, ball, rate, margin, advance
            )
        if advance < 0.0:
            return CONTACT
    return advance


@kernel(inline="source")
def _to_obstacles(r, t, robot, scene, body, rate, margin, advance):
    """Advance that obstacles allow a body; CONTACT also if its pose is not finite."""
    link = robot.body_link[body]
    node, end = robot.body_start[body], robot.body_start[body + 1]
    while node < end:
        x, y, z = _placed(r, t, link, robot.sphere, node)
        ix, iy, iz, inside = cell_of(scene.grid, x, y, z)
        if inside:
            enough = margin + rate * advance
            if known_distance(scene.grid, ix, iy, iz) > robot.sphere[node, 3] + enough:
                node = robot.skip[node]
                continue
        elif not abs(x) + abs(y) + abs(z) < np.inf:
            return CONTACT
        if robot.leaf[node] >= 0:
            where = x, y, z, ix, iy, iz, inside
            advance = _to_items(r, t, robot, scene, link, node, where, rate, margin, advance)
            if advance < 0.0:
                return CONTACT
        node += 1
    return advance


@kernel(inline="source")
def _to_body(robot, piece, ball, other, pose, rate, margin, advance):
    """Advance that the pieces of another body allow a piece.

    Args:
        robot: a `RobotGeometry`.
        piece: number of the piece.
        ball: centre of a ball around the piece, in the frame of its link, and its radius [m].
        other: number of the other body.
        pose: of the other body's link in the frame of the piece's link.
        rate: of the two bodies against each other.
        margin: [m].
        advance: [m].
    """
    node, end = robot.body_start[other], robot.body_start[other + 1]
    while node < end:
        p = _moved(pose, robot.sphere[node, 0], robot.sphere[node, 1], robot.sphere[node, 2])
        axis = (ball[0] - p[0], ball[1] - p[1], ball[2] - p[2])
        enough = margin + rate * advance
        limit = ball[3] + robot.sphere[node, 3] + enough
        if axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2] > limit * limit:
            node = robot.skip[node]
            continue
        if robot.leaf[node] >= 0:
            gap = slab_between(
                robot.pieces, piece, robot.pieces, robot.leaf[node], pose, axis, enough, margin
            )
            advance = _lowered(advance, gap, rate, margin)
            if advance < 0.0:
                return CONTACT
        node += 1
    return advance


@kernel(inline="source")
def _between_bodies(r, t, robot, a, b, centre, rate, margin, advance):
    """Advance of bodies a and b against each other; centre: of b's largest ball (x, y, z) [m]."""
    la, lb = robot.body_link[a], robot.body_link[b]
    node, end, root = robot.body_start[a], robot.body_start[a + 1], robot.body_start[b]
    world = _world_in_link(r, t, la)
    pose = compose(r[lb], t[lb], world)
    x, y, z = _moved(world, centre[0], centre[1], centre[2])
    while node < end:
        dx, dy, dz = robot.sphere[node, 0] - x, robot.sphere[node, 1] - y, robot.sphere[node, 2] - z
        limit = robot.sphere[node, 3] + robot.sphere[root, 3] + margin + rate * advance
        if dx * dx + dy * dy + dz * dz > limit * limit:
            node = robot.skip[node]
            continue
        piece = robot.leaf[node]
        if piece >= 0:
            small = robot.sphere[node, 0], robot.sphere[node, 1], robot.sphere[node, 2]
            ball = small + (robot.sphere[node, 3],)
            advance = _to_body(robot, piece, ball, b, pose, rate, margin, advance)
            if advance < 0.0:
                return CONTACT
        node += 1
    return advance


@kernel(inline="machine")
def _rate(swing, motion):
    """Rate sum_j swing_j motion_j of a body, or of a pair of bodies."""
    rate = 0.0
    for j in range(swing.shape[0]):
        rate += swing[j] * motion[j]
    return rate


@kernel
def safe_advance(link_rotation, link_translation, robot, scene, margin, motion, advance, balls):
    """Largest advance for which a posed robot keeps a margin from obstacles and from itself.

    Args:
        link_rotation: (p, 3, 3), from `forward_kinematics`.
        link_translation: (p, 3) [m].
        robot: a `RobotGeometry`.
        scene: a `SceneGeometry`.
        margin: [m].
        motion: largest |dq_j| of each joint per metre of advance (n,) [rad/m]; not read if the
            advance is 0.
        advance: the largest one of interest [m].
        balls: work array (bodies, 4): centre and radius of the largest ball of each body [m].

    Returns:
        The advance [m]; CONTACT in contact, or if a link pose is not finite.
    """
    rate = 0.0
    for k in range(robot.order.shape[0]):
        body = robot.order[k]
        if advance > 0.0:
            rate = _rate(robot.body_swing[body], motion)
        advance = _to_obstacles(
            link_rotation, link_translation, robot, scene, body, rate, margin, advance
        )
        if advance < 0.0:
            return CONTACT
    for body in range(balls.shape[0]):
        root = robot.body_start[body]
        balls[body, 0], balls[body, 1], balls[body, 2] = _placed(
            link_rotation, link_translation, robot.body_link[body], robot.sphere, root
        )
        balls[body, 3] = robot.sphere[root, 3]
    for k in range(robot.pairs.shape[0]):
        a, b = robot.pairs[k, 0], robot.pairs[k, 1]
        if advance > 0.0:
            rate = _rate(robot.pair_swing[k], motion)
        x, y, z = balls[a, 0] - balls[b, 0], balls[a, 1] - balls[b, 1], balls[a, 2] - balls[b, 2]
        limit = balls[a, 3] + balls[b, 3] + margin + rate * advance
        if x * x + y * y + z * z > limit * limit:
            continue
        centre = balls[b, 0], balls[b, 1], balls[b, 2]
        advance = _between_bodies(
            link_rotation, link_translation, robot, a, b, centre, rate, margin, advance
        )
        if advance < 0.0:
            return CONTACT
    return advance


@kernel(inline="source")
def in_contact(link_rotation, link_translation, robot, scene, margin, balls):
    """Whether a posed robot comes within a margin of an obstacle or of itself.

    Args:
        link_rotation: (p, 3, 3), from `forward_kinematics`.
        link_translation: (p, 3) [m].
        robot: a `RobotGeometry`.
        scene: a `SceneGeometry`.
        margin: [m].
        balls: work array, see `safe_advance`.

    Returns:
        True in contact, or if a link pose is not finite.
    """
    unread = link_translation[0]
    return (
        safe_advance(link_rotation, link_translation, robot, scene, margin, unread, 0.0, balls)
        < 0.0
    )
