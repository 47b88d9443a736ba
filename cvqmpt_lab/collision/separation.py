"""Separation of two convex shapes by GJK (Gilbert, Johnson and Keerthi 1988), in scalars.

"Separated" is proven: it is returned only where an empty slab between both shapes was measured. The
inner step finds the nearest point to the origin on a simplex of up to four points, by the
Voronoi-region tests in Ericson, "Real-Time Collision Detection", section 5.1. The functions of this
step return ``(n, p0, p1, p2, v)``: the n corners of the smallest face that holds the nearest point
(entries after the n-th are unused) and that point v. n = 4: the origin is enclosed, and v is zero.
Points are tuples of three floats [m].
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import kernel

HULL, BOX, CYLINDER, SPHERE = 0, 1, 2, 3  # kinds of convex shapes
MAX_HULL_VERTICES = 1 << 16
IDENTITY = (
    1.0,
    0.0,
    0.0,
    0.0,
    1.0,
    0.0,
    0.0,
    0.0,
    1.0,
    0.0,
    0.0,
    0.0,
)  # pose: rotation by rows, translation [m]


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
    """Whether the origin may be on the other side of face abc than the opposite corner.

    Also true for a tetrahedron so flat that rounding errors decide the sign.
    """
    normal = _cross(_minus(b, a), _minus(c, a))
    side_origin = -dot(a, normal)
    side_opposite = dot(_minus(opposite, a), normal)
    scale = dot(normal, normal)
    # the height over the face is at most 1e-6 of the corner's distance from the origin
    if side_opposite * side_opposite <= 1e-12 * scale * dot(opposite, opposite):
        return True
    return side_origin * side_opposite < 0.0


@kernel
def _nearest_on_tetrahedron(a, b, c, d):
    """Nearest point to the origin on tetrahedron abcd, d its newest corner; n = 4: it is inside."""
    found, best = (4, a, b, c, (0.0, 0.0, 0.0)), np.inf
    for p, q, opposite in ((a, b, c), (b, c, a), (c, a, b)):
        if _beyond_face(d, p, q, opposite):
            face = _nearest_on_triangle(d, p, q)
            distance2 = dot(face[4], face[4])
            if distance2 < best:
                found, best = face, distance2
    return found


@kernel(inline="machine")
def nearest_on_simplex(n, p0, p1, p2, newest):
    """Nearest point to the origin on the hull of the first n points and the newest one.

    Args:
        n: number of points before the newest, 0 to 3.
        p0: point, 3-tuple [m].
        p1: the same.
        p2: the same.
        newest: the same.
    """
    if n == 0:
        return 1, newest, newest, newest, newest
    if n == 1:
        return _nearest_on_segment(newest, p0)
    if n == 2:
        return _nearest_on_triangle(newest, p0, p1)
    return _nearest_on_tetrahedron(p0, p1, p2, newest)


class ConvexShapes(NamedTuple):
    """Convex shapes: a core (see `Core`) inflated by ``radius``; a sphere is an inflated point.

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
    # vertices of all hulls, one row per coordinate, so that loops vectorise [m]
    vertices: Annotated[np.ndarray, "3 vertices"]


@kernel(inline="machine")
def _hull_support(x, y, z, size, d):
    """Vertex s_H(d) = argmax_p p . d among the vertices p, to about 1e-10 of the hull's size.

    The low bits of each projection, made positive, hold the index of its vertex: the search becomes
    a maximum of integers, the only form that compiles to vector instructions.

    Args:
        x: coordinates of the vertices (n,) [m].
        y: (n,) [m].
        z: (n,) [m].
        size: largest |x|, |y|, |z| of the vertices, 3-tuple [m].
        d: direction, 3-tuple.
    """
    index_mask = np.int64(MAX_HULL_VERTICES - 1)
    offset = 1.001 * (size[0] * abs(d[0]) + size[1] * abs(d[1]) + size[2] * abs(d[2])) + 1e-200
    best = np.int64(0)
    for i in range(x.shape[0]):
        projection = np.float64(x[i] * d[0] + y[i] * d[1] + z[i] * d[2] + offset)
        best = max(best, (projection.view(np.int64) & ~index_mask) | i)
    k = min(best & index_mask, x.shape[0] - 1)
    return x[k], y[k], z[k]


class Core(NamedTuple):
    """One shape of `ConvexShapes` without its inflation, posed."""

    kind: np.int64  # HULL, BOX, CYLINDER or SPHERE
    size: tuple[float, float, float]  # as of `ConvexShapes` [m]
    x: np.ndarray  # (n,) coordinates of a hull's vertices; of other shapes (0,) [m]
    y: np.ndarray
    z: np.ndarray
    pose: tuple[float, ...]  # 9 rotation entries by rows, then 3 of translation [m]


@kernel(inline="machine")
def compose(r, t, pose):
    """Product of a pose (12-tuple) and the pose (r (3, 3), t (3,)) given in its frame."""
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
def _core(shapes, i, pose):
    """Core of shape i; pose: of its owner (12-tuple)."""
    start, count = shapes.vertex_start[i], shapes.vertex_count[i]
    return Core(
        shapes.kind[i],
        (shapes.size[i, 0], shapes.size[i, 1], shapes.size[i, 2]),
        shapes.vertices[0, start : start + count],
        shapes.vertices[1, start : start + count],
        shapes.vertices[2, start : start + count],
        pose
        if shapes.kind[i] == HULL
        else compose(shapes.rotation[i], shapes.translation[i], pose),
    )


@kernel(inline="machine")
def _support(core, d):
    """Point of a core, in its own frame, farthest along d (3-tuple)."""
    size = core.size
    if core.kind == HULL:
        return _hull_support(core.x, core.y, core.z, size, d)
    if core.kind == BOX:
        return np.copysign(size[0], d[0]), np.copysign(size[1], d[1]), np.copysign(size[2], d[2])
    if core.kind == CYLINDER:
        length = np.sqrt(d[0] * d[0] + d[1] * d[1])
        scale = size[0] / length if length > 0.0 else 0.0
        return scale * d[0], scale * d[1], np.copysign(size[2], d[2])
    return 0.0, 0.0, 0.0


@kernel(inline="machine")
def _posed_support(core, d):
    """Point of a posed core farthest along d (3-tuple)."""
    pose = core.pose
    local = (
        pose[0] * d[0] + pose[3] * d[1] + pose[6] * d[2],
        pose[1] * d[0] + pose[4] * d[1] + pose[7] * d[2],
        pose[2] * d[0] + pose[5] * d[1] + pose[8] * d[2],
    )
    s = _support(core, local)
    return (
        pose[0] * s[0] + pose[1] * s[1] + pose[2] * s[2] + pose[9],
        pose[3] * s[0] + pose[4] * s[1] + pose[5] * s[2] + pose[10],
        pose[6] * s[0] + pose[7] * s[1] + pose[8] * s[2] + pose[11],
    )


@kernel
def _widest_slab(a, b, axis, limit, least):
    """Width [m] of the widest empty slab found between two cores by GJK.

    With supports s_A, s_B and a direction v from B towards A, the empty slab across v is

        gap(v) = v . (s_A(-v) - s_B(v)) / |v|

    The next v is the point nearest to the origin on the simplex of the last s_A - s_B. Stops when a
    slab is wider than the limit, when the distance of the cores is known to be at most `least`, or
    when the widest slab is within 1e-9 m of the distance. Below the limit, four fifths of the
    distance beyond `least` are enough.

    Args:
        a: a core; a hull must be in its owner's frame (its pose is not applied).
        b: another core.
        axis: first direction, 3-tuple from b towards a of any length.
        limit: width [m]; the search stops at a wider slab.
        least: smaller distances are not measured [m]; the limit: only whether a slab is wider.

    Returns:
        The width; zero or less where no slab was found.
    """
    v = axis
    n = np.int64(0)
    p0 = p1 = p2 = axis
    widest = -np.inf
    known = False
    for _ in range(64):  # converges in a few iterations, except for rounding errors
        length = np.sqrt(dot(v, v))
        away = (-v[0], -v[1], -v[2])
        s_a = _support(a, away) if a.kind == HULL else _posed_support(a, away)
        s_b = _posed_support(b, v)
        w = (s_a[0] - s_b[0], s_a[1] - s_b[1], s_a[2] - s_b[2])
        gap = dot(v, w) / length if length > 0.0 else -np.inf
        if gap > widest:
            widest = gap
            if gap > limit:
                return widest
        if known and not length - gap > 1e-9:
            return widest
        n, p0, p1, p2, v = nearest_on_simplex(n, p0, p1, p2, w)
        length2 = dot(v, v)
        if n == 4 or not length2 > least * least or (known and length2 >= length * length):
            return widest
        if not length2 > limit * limit and widest - least > 0.8 * (np.sqrt(length2) - least):
            return widest
        known = True
    return widest


@kernel(inline="machine")
def slab_between(a, i, b, j, pose, axis, enough, least):
    """Width of an empty slab between two shapes: a proven lower bound of their distance [m].

    The slab was measured with the support points of both shapes.

    Args:
        a: shapes.
        i: number of a shape of a.
        b: shapes.
        j: number of a shape of b.
        pose: pose of b's owner in the frame of a's owner (12-tuple).
        axis: first direction, 3-tuple from b towards a of any length, in the frame of a's owner.
        enough: the search stops at a wider slab [m].
        least: smaller distances are not measured, see `_widest_slab` [m].
    """
    inflation = a.radius[i] + b.radius[j]
    first, second = _core(a, i, IDENTITY), _core(b, j, pose)
    return _widest_slab(first, second, axis, enough + inflation, least + inflation) - inflation


@kernel(inline="machine")
def slab_to_box(a, i, half, radius, pose, axis, enough, least):
    """Width of an empty slab between shape i of a and an inflated box, as `slab_between` [m].

    Args:
        a: shapes.
        i: number of a shape of a.
        half: half edges of the box, 3-tuple [m]; zero for a ball.
        radius: inflation of the box [m].
        pose: pose of the box in the frame of a's owner (12-tuple).
        axis: first direction, as in `slab_between`.
        enough: as in `slab_between` [m].
        least: as in `slab_between` [m].
    """
    none = a.vertices[0, :0]
    box = Core(np.int64(BOX), half, none, none, none, pose)
    inflation = a.radius[i] + radius
    slab = _widest_slab(_core(a, i, IDENTITY), box, axis, enough + inflation, least + inflation)
    return slab - inflation
