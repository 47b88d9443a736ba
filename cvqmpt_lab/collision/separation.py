"""Separation of two convex shapes by GJK (Gilbert, Johnson and Keerthi 1988), in scalars.

Only measured slabs count: "separated" is proven. The inner step finds the nearest point to the
origin on a simplex of up to four points, by the Voronoi-region tests in Ericson, "Real-Time
Collision Detection", section 5.1. Its functions return ``(n, p0, p1, p2, v)``: the smallest face
that carries the nearest point (its first n points count) and that point v. Points are tuples of
three floats [m].
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import kernel

_ORIGIN = (0.0, 0.0, 0.0)
_FLAT = 1e-12


@kernel
def dot(a, b):
    """Inner product of two 3-tuples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@kernel
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def _along(a, t, e):
    return a[0] + t * e[0], a[1] + t * e[1], a[2] + t * e[2]


@kernel(inline="machine")
def _nearest_on_segment(a, b):
    ab = _minus(b, a)
    t = -dot(a, ab)
    if t <= 0.0:
        return 1, a, a, a, a
    length2 = dot(ab, ab)
    if t >= length2:
        return 1, b, b, b, b
    return 2, a, b, b, _along(a, t / length2, ab)


@kernel
def _nearest_on_triangle(a, b, c):
    ab, ac = _minus(b, a), _minus(c, a)
    d1, d2 = -dot(ab, a), -dot(ac, a)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1, a, a, a, a
    d3, d4 = -dot(ab, b), -dot(ac, b)
    if d3 >= 0.0 and d4 <= d3:
        return 1, b, b, b, b
    d5, d6 = -dot(ab, c), -dot(ac, c)
    if d6 >= 0.0 and d5 <= d6:
        return 1, c, c, c, c
    normal = _cross(ab, ac)
    area2 = dot(normal, normal)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return _nearest_on_segment(a, b)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return _nearest_on_segment(a, c)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        return _nearest_on_segment(b, c)
    if not area2 > 0.0:
        return _nearest_on_segment(a, b)
    # The foot of the perpendicular along the normal is accurate even far from the corners.
    height = dot(normal, a) / area2
    return 3, a, b, c, (height * normal[0], height * normal[1], height * normal[2])


@kernel
def _beyond_face(a, b, c, opposite):
    """Whether the origin may lie beyond face abc, seen from the opposite corner (flat: yes)."""
    normal = _cross(_minus(b, a), _minus(c, a))
    side_origin = -dot(a, normal)
    side_opposite = dot(_minus(opposite, a), normal)
    scale = dot(normal, normal)
    if side_opposite * side_opposite <= _FLAT * scale * dot(opposite, opposite):
        return True
    return side_origin * side_opposite < 0.0


@kernel
def _nearest_on_tetrahedron(a, b, c, d):
    """Nearest point on tetrahedron abcd, where d is the newest corner; n = 4 when it encloses."""
    found, best = (4, a, b, c, _ORIGIN), np.inf
    for p, q, opposite in ((a, b, c), (b, c, a), (c, a, b)):
        if _beyond_face(d, p, q, opposite):
            face = _nearest_on_triangle(d, p, q)
            distance2 = dot(face[4], face[4])
            if distance2 < best:
                found, best = face, distance2
    return found


@kernel(inline="machine")
def nearest_on_simplex(n, p0, p1, p2, newest):
    """Nearest point to the origin on the hull of the first n points and the newest one."""
    if n == 0:
        return 1, newest, newest, newest, newest
    if n == 1:
        return _nearest_on_segment(newest, p0)
    if n == 2:
        return _nearest_on_triangle(newest, p0, p1)
    return _nearest_on_tetrahedron(p0, p1, p2, newest)


HULL, BOX, CYLINDER, SPHERE = 0, 1, 2, 3
MAX_HULL_VERTICES = 1 << 16
_INDEX_MASK = np.int64(MAX_HULL_VERTICES - 1)
_VALUE_MASK = ~_INDEX_MASK
_MAX_ITERATIONS = 64
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class ConvexShapes(NamedTuple):
    """Convex shapes: a core (below) inflated by ``radius``; a sphere is an inflated point.

    Vertices of hulls are in the owner's frame: ``rotation`` is identity, ``translation`` zero.
    """

    kind: Annotated[np.ndarray, "int64 shapes"]  # HULL, BOX, CYLINDER (axis z) or SPHERE
    # Half sizes of a box; (radius, radius, half length) of a cylinder; largest |x|, |y|, |z| of a
    # hull; 0 of a sphere
    size: Annotated[np.ndarray, "shapes 3"]  # [m]
    radius: Annotated[np.ndarray, "shapes"]  # Inflation of the core [m]; for a sphere its radius
    rotation: Annotated[np.ndarray, "shapes 3 3"]  # Orientation of the core in its owner's frame
    translation: Annotated[np.ndarray, "shapes 3"]  # Position of the core in its owner's frame [m]
    vertex_start: Annotated[np.ndarray, "int64 shapes"]  # First column of ``vertices``
    vertex_count: Annotated[np.ndarray, "int64 shapes"]  # Number of columns of ``vertices``
    # of all hulls, a row a coordinate, so that loops vectorise [m]
    vertices: Annotated[np.ndarray, "3 vertices"]


@kernel(inline="machine")
def _hull_support(x, y, z, size, d):
    """The vertex s_H(d) = argmax_x x . d among x, y, z (n,), to about 1e-10 of the hull's size.

    The low bits of each (positive) projection hold the index of its vertex: the search becomes a
    maximum of integers, the only form that compiles to vector instructions.
    """
    offset = 1.001 * (size[0] * abs(d[0]) + size[1] * abs(d[1]) + size[2] * abs(d[2])) + 1e-200
    best = np.int64(0)
    for i in range(x.shape[0]):
        projection = np.float64(x[i] * d[0] + y[i] * d[1] + z[i] * d[2] + offset)
        best = max(best, (projection.view(np.int64) & _VALUE_MASK) | i)
    k = min(best & _INDEX_MASK, x.shape[0] - 1)
    return x[k], y[k], z[k]


@kernel(inline="machine")
def _core_support(kind, size, x, y, z, d):
    """The point of a core, in its own frame, farthest along d (3 scalars)."""
    if kind == HULL:
        return _hull_support(x, y, z, size, d)
    if kind == BOX:
        return np.copysign(size[0], d[0]), np.copysign(size[1], d[1]), np.copysign(size[2], d[2])
    if kind == CYLINDER:
        length = np.sqrt(d[0] * d[0] + d[1] * d[1])
        scale = size[0] / length if length > 0.0 else 0.0
        return scale * d[0], scale * d[1], np.copysign(size[2], d[2])
    return 0.0, 0.0, 0.0


@kernel(inline="machine")
def _posed_support(kind, size, x, y, z, pose, d):
    """The point of a posed core farthest along d; pose: 9 rotation entries by rows, then 3."""
    local = (
        pose[0] * d[0] + pose[3] * d[1] + pose[6] * d[2],
        pose[1] * d[0] + pose[4] * d[1] + pose[7] * d[2],
        pose[2] * d[0] + pose[5] * d[1] + pose[8] * d[2],
    )
    s = _core_support(kind, size, x, y, z, local)
    return (
        pose[0] * s[0] + pose[1] * s[1] + pose[2] * s[2] + pose[9],
        pose[3] * s[0] + pose[4] * s[1] + pose[5] * s[2] + pose[10],
        pose[6] * s[0] + pose[7] * s[1] + pose[8] * s[2] + pose[11],
    )


@kernel
def _gjk(
    ka, size_a, xa, ya, za, pose_a, kb, size_b, xb, yb, zb, pose_b, axis, above, below, tolerance
):
    """The widest slab between two cores [m]: GJK.

    With supports s_A, s_B and a direction v from B towards A, the empty slab across v is

        gap(v) = v . (s_A(-v) - s_B(v)) / |v|

    The next v is the point nearest to the origin on the simplex of the last s_A - s_B. See
    `separating_gap` for when it stops.
    """
    v = axis
    n = np.int64(0)
    p0 = p1 = p2 = axis
    widest = -np.inf
    known = False
    for _ in range(_MAX_ITERATIONS):
        length = np.sqrt(dot(v, v))
        away = (-v[0], -v[1], -v[2])
        if ka == HULL:
            a = _hull_support(xa, ya, za, size_a, away)
        else:
            a = _posed_support(ka, size_a, xa, ya, za, pose_a, away)
        b = _posed_support(kb, size_b, xb, yb, zb, pose_b, v)
        w = (a[0] - b[0], a[1] - b[1], a[2] - b[2])
        gap = dot(v, w) / length if length > 0.0 else -np.inf
        if gap > widest:
            widest = gap
            if gap > above:
                return widest
        if known and not length - gap > tolerance:
            return widest
        n, p0, p1, p2, v = nearest_on_simplex(n, p0, p1, p2, w)
        length2 = dot(v, v)
        if n == 4 or not length2 > below * below or (known and length2 >= length * length):
            return widest
        known = True
    return widest


@kernel(inline="machine")
def compose(r, t, pose):
    """Pose (12-tuple) followed by rotation r (3, 3) and translation t (3,) inside it."""
    return (
        pose[0] * r[0, 0] + pose[1] * r[1, 0] + pose[2] * r[2, 0],
        pose[0] * r[0, 1] + pose[1] * r[1, 1] + pose[2] * r[2, 1],
        pose[0] * r[0, 2] + pose[1] * r[1, 2] + pose[2] * r[2, 2],
        pose[3] * r[0, 0] + pose[4] * r[1, 0] + pose[5] * r[2, 0],
        pose[3] * r[0, 1] + pose[4] * r[1, 1] + pose[5] * r[2, 1],
        pose[3] * r[0, 2] + pose[4] * r[1, 2] + pose[5] * r[2, 2],
        pose[6] * r[0, 0] + pose[7] * r[1, 0] + pose[8] * r[2, 0],
        pose[6] * r[0, 1] + pose[7] * r[1, 1] + pose[8] * r[2, 1],
        pose[6] * r[0, 2] + pose[7] * r[1, 2] + pose[8] * r[2, 2],
        pose[0] * t[0] + pose[1] * t[1] + pose[2] * t[2] + pose[9],
        pose[3] * t[0] + pose[4] * t[1] + pose[5] * t[2] + pose[10],
        pose[6] * t[0] + pose[7] * t[1] + pose[8] * t[2] + pose[11],
    )


@kernel(inline="machine")
def _core_gap(a, i, kind, size, x, y, z, pose, axis, above, below, tolerance):
    """`_gjk` of the core of shape i of a, posed in its owner's frame, and of another core."""
    start, count = a.vertex_start[i], a.vertex_count[i]
    pose_a = IDENTITY if a.kind[i] == HULL else compose(a.rotation[i], a.translation[i], IDENTITY)
    return _gjk(
        a.kind[i],
        (a.size[i, 0], a.size[i, 1], a.size[i, 2]),
        a.vertices[0, start : start + count],
        a.vertices[1, start : start + count],
        a.vertices[2, start : start + count],
        pose_a,
        kind,
        size,
        x,
        y,
        z,
        pose,
        axis,
        above,
        below,
        tolerance,
    )


@kernel(inline="machine")
def separating_gap(a, i, b, j, pose, axis, above, below, tolerance):
    """The widest empty slab found between shape i of a and shape j of b [m].

    A positive gap is certified: the slab was measured with the support points of both shapes. Zero
    or less means that no slab was found.

    Args:
        a: shapes.
        i: number of a shape of a.
        b: shapes.
        j: number of a shape of b.
        pose: of b's owner in a's owner's frame, 12-tuple: rotation by rows, then translation [m].
        axis: first direction, 3-tuple from b towards a of any length, in the frame of a's owner.
        above: stop when a slab is wider [m].
        below: stop when the distance is known to be at most this [m].
        tolerance: stop when the gap is so close to the distance [m].
    """
    inflation = a.radius[i] + b.radius[j]
    start, count = b.vertex_start[j], b.vertex_count[j]
    pose_b = pose if b.kind[j] == HULL else compose(b.rotation[j], b.translation[j], pose)
    gap = _core_gap(
        a,
        i,
        b.kind[j],
        (b.size[j, 0], b.size[j, 1], b.size[j, 2]),
        b.vertices[0, start : start + count],
        b.vertices[1, start : start + count],
        b.vertices[2, start : start + count],
        pose_b,
        axis,
        above + inflation,
        below + inflation,
        tolerance,
    )
    return gap - inflation


@kernel(inline="machine")
def separated(a, i, b, j, pose, axis, margin):
    """Whether a slab wider than margin [m] separates shape i of a from shape j of b."""
    return separating_gap(a, i, b, j, pose, axis, margin, margin, 1e-9) > margin


@kernel
def distance(a, i, b, j, pose, axis, tolerance):
    """Lower bound [m] on the distance of two shapes, within tolerance; 0 in contact."""
    return max(separating_gap(a, i, b, j, pose, axis, np.inf, 0.0, tolerance), 0.0)


@kernel(inline="machine")
def box_separated(a, i, half, radius, pose, axis, margin):
    """Whether a slab wider than margin [m] separates shape i of a from an inflated box.

    half, radius: half edges (3 floats) and inflation of the box [m]; of a ball the edges are zero.
    pose: of the box in the frame of a's owner (12-tuple).
    """
    none = a.vertices[0, :0]
    limit = margin + (a.radius[i] + radius)
    return (
        _core_gap(a, i, np.int64(BOX), half, none, none, none, pose, axis, limit, limit, 1e-9)
        > limit
    )
