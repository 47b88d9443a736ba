"""Nearest point to the origin on a simplex of up to four points, in scalars (the inner step of GJK).

Voronoi-region tests after Ericson, "Real-Time Collision Detection", section 5.1. Each function returns
``(n, p0, p1, p2, v)``: the smallest face that carries the nearest point (its first n points count) and that
point v. Points are tuples of three floats [m].
"""

from cvqmpt_lab.jit import kernel

_ORIGIN = (0.0, 0.0, 0.0)
_FLAT = 1e-12


@kernel
def dot(a, b):
    """Return the inner product of two 3-tuples."""
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
    # The foot of the perpendicular from the origin, along the normal: accurate even far from the corners.
    height = dot(normal, a) / area2
    return 3, a, b, c, (height * normal[0], height * normal[1], height * normal[2])


@kernel
def _beyond_face(a, b, c, opposite):
    """Return whether the origin may lie beyond face abc, seen from the opposite corner (flat: yes)."""
    normal = _cross(_minus(b, a), _minus(c, a))
    side_origin = -dot(a, normal)
    side_opposite = dot(_minus(opposite, a), normal)
    scale = dot(normal, normal)
    if side_opposite * side_opposite <= _FLAT * scale * dot(opposite, opposite):
        return True
    return side_origin * side_opposite < 0.0


@kernel
def _nearest_on_tetrahedron(a, b, c, d):
    """Return the nearest point on tetrahedron abcd, where d is the newest corner; n = 4 when it encloses."""
    found = (4, a, b, c, _ORIGIN)
    best = 1e300
    if _beyond_face(d, a, b, c):
        face = _nearest_on_triangle(d, a, b)
        found, best = face, dot(face[4], face[4])
    if _beyond_face(d, b, c, a):
        face = _nearest_on_triangle(d, b, c)
        distance2 = dot(face[4], face[4])
        if distance2 < best:
            found, best = face, distance2
    if _beyond_face(d, c, a, b):
        face = _nearest_on_triangle(d, c, a)
        distance2 = dot(face[4], face[4])
        if distance2 < best:
            found, best = face, distance2
    return found


@kernel(inline="machine")
def nearest_on_simplex(n, p0, p1, p2, newest):
    """Return the nearest point to the origin on the hull of the first n points and the newest one."""
    if n == 0:
        return 1, newest, newest, newest, newest
    if n == 1:
        return _nearest_on_segment(newest, p0)
    if n == 2:
        return _nearest_on_triangle(newest, p0, p1)
    return _nearest_on_tetrahedron(p0, p1, p2, newest)
