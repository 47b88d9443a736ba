"""Residual F(q) and Jacobian J(q) of stacked task-space regions, compiled, on plain arrays.

A region bounds the pose of an end frame e seen from a reference frame w (Berenson et al. 2011):

    T = (T0_w)^-1  T0_e  (Tw_e)^-1,    x = (translation of T, rotation vector of T),

F = signed distance of x outside [lower, upper], zero inside. Several regions stack their rows:
their intersection. No rows at all is the unconstrained problem. The rotation vector e of R =
exp([e]x) has de/dt = Jl^-1(e) w, with the angular velocity w in the frame that R maps into, and

    Jl^-1(e) = I - [e]x / 2 + (1 / t^2 - cot(t / 2) / (2 t)) [e]x^2,    t = |e|.

cot(t / 2) stays finite at t = pi, where the usual (1 + cos t) / sin t is 0 / 0.

One more entry of x is the tilt, the angle between a = (0, 0, 1) and b = R a, with c = a x b:

    tilt = atan2(|c|, a . b),    d tilt / dt = c . w / |c|.

Its bound is a cone. F is smooth at the bound; where c = 0, inside it, the derivative is set to 0.

The last three entries of x are of the position p of e in w alone, and of b:

    distance d = |p|,                       d distance / dt = p . v / d,
    radius = |(p_x, p_y)|, from w's z axis,  d radius / dt = (p_x v_x + p_y v_y) / radius,
    bearing = atan2(|g|, -p . b), g = p x b, of the origin of w off b as e sees it,

    d bearing / dt = (v . b - (p . v) (p . b) / d^2 - g . w) / |g|.

v is the velocity of p in w. Their derivatives, too, are set to 0 where the denominator is 0.

Functions may stand beside regions. A function at an address, of machine code or of Python, computes
x(q) and dx/dq of rows of its own, and F is the signed distance of these x outside their bounds.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import call_function, entry, kernel
from cvqmpt_lab.robot.kinematics import Kinematics, forward_kinematics

SMALL_ANGLE = 1e-5  # [rad] below it, series are exact to double precision
NEAR_PI = 1e-4  # [rad] above pi - NEAR_PI, the axis is read from the symmetric part


@kernel
def _axis_near_pi(a, b, c, cosine, angle, x, y, z):
    """Rotation vector t u near angle pi: (R + R^T) / 2 = cos(t) I + (1 - cos(t)) u u^T."""
    if a[0] >= b[1] and a[0] >= c[2]:
        ux, uy, uz = a[0] - cosine, 0.5 * (a[1] + b[0]), 0.5 * (a[2] + c[0])
    elif b[1] >= c[2]:
        ux, uy, uz = 0.5 * (a[1] + b[0]), b[1] - cosine, 0.5 * (b[2] + c[1])
    else:
        ux, uy, uz = 0.5 * (a[2] + c[0]), 0.5 * (b[2] + c[1]), c[2] - cosine
    scale = angle / np.sqrt(ux * ux + uy * uy + uz * uz)
    if ux * x + uy * y + uz * z < 0.0:
        scale = -scale
    return scale * ux, scale * uy, scale * uz


@kernel
def rotation_vector(a, b, c):
    """Log(R) = axis * angle [rad] (3 floats), angle in [0, pi], of R with columns a, b, c."""
    x, y, z = 0.5 * (b[2] - c[1]), 0.5 * (c[0] - a[2]), 0.5 * (a[1] - b[0])
    sine = np.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (a[0] + b[1] + c[2] - 1.0)
    angle = np.arctan2(sine, cosine)
    if angle > np.pi - NEAR_PI:
        return _axis_near_pi(a, b, c, cosine, angle, x, y, z)
    scale = angle / sine if sine > SMALL_ANGLE else 1.0 + angle * angle / 6.0
    return scale * x, scale * y, scale * z


@kernel(inline="machine")
def log_map_factor(e):
    """1 / t^2 - cot(t / 2) / (2 t), the factor of [e]x^2 in Jl^-1(e), and t^2 = |e|^2 [rad^2]."""
    square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    if square < 1e-6:
        return 1.0 / 12.0 + square / 720.0, square
    angle = np.sqrt(square)
    return 1.0 / square - 0.5 / (angle * np.tan(0.5 * angle)), square


class Regions(NamedTuple):
    """k stacked regions and some functions with m bounded rows in all.

    Rows are sorted by region, then axis; rows of functions follow, in order. For a function at an
    address see `FunctionRows`.
    """

    link: Annotated[np.ndarray, "int64 k"]  # Pose row carrying the end frame
    base: Annotated[np.ndarray, "int64 k"]  # Pose row carrying the reference frame (0 = world)
    end_rotation: Annotated[np.ndarray, "k 3 3"]  # Rotation of T_link_e (Tw_e)^-1
    end_translation: Annotated[np.ndarray, "k 3"]  # Its translation [m]
    reference_rotation: Annotated[np.ndarray, "k 3 3"]  # Rotation of T_base_w
    reference_translation: Annotated[np.ndarray, "k 3"]  # Its translation [m]
    region: Annotated[np.ndarray, "int64 m"]  # Region of each row; k + f for function f
    axis: Annotated[np.ndarray, "int64 m"]  # Row of `task_space_region.ROWS`; else -1
    lower: Annotated[np.ndarray, "m"]  # Bounds [m or rad]
    upper: Annotated[np.ndarray, "m"]  # Bounds [m or rad]
    functions: Annotated[np.ndarray, "int64 functions 2"]  # Address, number of first parameter
    parameters: Annotated[np.ndarray, "parameters"]  # Of all functions


class FunctionRows(NamedTuple):
    """A function of rows x(q) at an address, and bounds on them.

    It is called as ``int64 f(int64 derivative, int64 n, int64 m, double *q, double *rotation,
    double *translation, double *parameters, double *out)`` with the link poses of q, see
    `forward_kinematics`. It writes x (m,), or dx/dq (m, n) where derivative is 1, and returns 0, or
    another number if it fails. An entry with ``inline="never"`` is such a function.
    """

    address: int
    lower: np.ndarray  # (m,), bounds of x
    upper: np.ndarray  # (m,), bounds of x
    parameters: np.ndarray = np.empty(0)


def no_regions() -> Regions:
    """No region, no function: every configuration satisfies the constraint."""
    none, numbers = np.empty(0, dtype=np.int64), np.empty(0)
    rotations, translations = np.empty((0, 3, 3)), np.empty((0, 3))
    return Regions(
        link=none,
        base=none,
        end_rotation=rotations,
        end_translation=translations,
        reference_rotation=rotations,
        reference_translation=translations,
        region=none,
        axis=none,
        lower=numbers,
        upper=numbers,
        functions=np.empty((0, 2), dtype=np.int64),
        parameters=numbers,
    )


@kernel(inline="machine")
def _turned(rotation, i, x, y, z):
    """rotation[i] applied to (x, y, z)."""
    return (
        rotation[i, 0, 0] * x + rotation[i, 0, 1] * y + rotation[i, 0, 2] * z,
        rotation[i, 1, 0] * x + rotation[i, 1, 1] * y + rotation[i, 1, 2] * z,
        rotation[i, 2, 0] * x + rotation[i, 2, 1] * y + rotation[i, 2, 2] * z,
    )


@kernel(inline="machine")
def _turned_back(rotation, i, x, y, z):
    """Transpose of rotation[i] applied to (x, y, z)."""
    return (
        rotation[i, 0, 0] * x + rotation[i, 1, 0] * y + rotation[i, 2, 0] * z,
        rotation[i, 0, 1] * x + rotation[i, 1, 1] * y + rotation[i, 2, 1] * z,
        rotation[i, 0, 2] * x + rotation[i, 1, 2] * y + rotation[i, 2, 2] * z,
    )


@kernel(inline="machine")
def _into_reference(regions, k, link_rotation, x, y, z):
    """A world vector in the axes of reference frame w of region k."""
    base = regions.base[k]
    if base != 0:
        x, y, z = _turned_back(link_rotation, base, x, y, z)
    return _turned_back(regions.reference_rotation, k, x, y, z)


@kernel(inline="source")
def _displacement(regions, k, link_rotation, link_translation):
    """End point in the world (3); of region k: position (3), columns of R (3, 3)."""
    link, base = regions.link[k], regions.base[k]
    offset, origin = regions.end_translation, regions.reference_translation
    x, y, z = _turned(link_rotation, link, offset[k, 0], offset[k, 1], offset[k, 2])
    end = (
        x + link_translation[link, 0],
        y + link_translation[link, 1],
        z + link_translation[link, 2],
    )
    x, y, z = _turned(link_rotation, base, origin[k, 0], origin[k, 1], origin[k, 2])
    position = _into_reference(
        regions,
        k,
        link_rotation,
        end[0] - x - link_translation[base, 0],
        end[1] - y - link_translation[base, 1],
        end[2] - z - link_translation[base, 2],
    )
    turn = regions.end_rotation
    a = _turned(link_rotation, link, turn[k, 0, 0], turn[k, 1, 0], turn[k, 2, 0])
    b = _turned(link_rotation, link, turn[k, 0, 1], turn[k, 1, 1], turn[k, 2, 1])
    c = _turned(link_rotation, link, turn[k, 0, 2], turn[k, 1, 2], turn[k, 2, 2])
    columns = (
        _into_reference(regions, k, link_rotation, a[0], a[1], a[2]),
        _into_reference(regions, k, link_rotation, b[0], b[1], b[2]),
        _into_reference(regions, k, link_rotation, c[0], c[1], c[2]),
    )
    return end, position, columns


@kernel(inline="source")
def _relative_velocity(kinematics, regions, k, j, link_rotation, link_translation, end, linear):
    """Velocity (3; zero unless linear) and angular velocity (3) of e in w, per unit of joint j.

    The joint may be one that mimics a planned joint.
    """
    with_link = kinematics.moves[j, regions.link[k]]
    if with_link == kinematics.moves[j, regions.base[k]]:  # both or neither move
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    sign = 1.0 if with_link else -1.0
    zx, zy, zz = (
        sign * link_rotation[j + 1, 0, 2],
        sign * link_rotation[j + 1, 1, 2],
        sign * link_rotation[j + 1, 2, 2],
    )
    if kinematics.prismatic[j]:
        return _into_reference(regions, k, link_rotation, zx, zy, zz), (0.0, 0.0, 0.0)
    angular = _into_reference(regions, k, link_rotation, zx, zy, zz)
    if not linear:
        return (0.0, 0.0, 0.0), angular
    dx = end[0] - link_translation[j + 1, 0]
    dy = end[1] - link_translation[j + 1, 1]
    dz = end[2] - link_translation[j + 1, 2]
    velocity = _into_reference(
        regions, k, link_rotation, zy * dz - zz * dy, zz * dx - zx * dz, zx * dy - zy * dx
    )
    return velocity, angular


@kernel(inline="machine")
def _pick(vector, axis):
    """Component 0, 1 or 2 of a triple."""
    return vector[0] if axis == 0 else (vector[1] if axis == 1 else vector[2])


@kernel(inline="machine")
def _kinds_of_rows(regions, k, first):
    """Whether region k, its rows from first on, bounds tilt, rotation vector, and rows 7 to 9."""
    tilts = turns = places = False
    row = first
    while row < regions.region.shape[0] and regions.region[row] == k:
        tilts = tilts or regions.axis[row] == 6
        turns = turns or 2 < regions.axis[row] < 6
        places = places or regions.axis[row] > 6
        row += 1
    return tilts, turns, places


@kernel(inline="machine")
def _crossed(a, b):
    """Cross product of a and b (3)."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(inline="machine")
def _dot(a, b):
    """Scalar product of a and b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(inline="machine")
def _write_place(p, b, out):
    """Write distance, radius and bearing of a position p into out[10:13], and b into out[15:18]."""
    g = _crossed(p, b)
    out[10] = np.sqrt(_dot(p, p))
    out[11] = np.sqrt(p[0] * p[0] + p[1] * p[1])
    out[12] = np.arctan2(np.sqrt(_dot(g, g)), -_dot(p, b))
    for a in range(3):
        out[15 + a] = _pick(b, a)


@kernel(inline="machine")
def _place_rate(axis, x, v, w):
    """Rate of distance (axis 7), radius (8) or bearing (9) at a row x of `displacement`.

    v is the velocity of p, w the angular velocity of b.
    """
    p, b, distance, radius = (x[3], x[4], x[5]), (x[15], x[16], x[17]), x[10], x[11]
    if axis == 8:
        return (p[0] * v[0] + p[1] * v[1]) / radius if radius > 0.0 else 0.0
    if distance == 0.0:
        return 0.0
    along = _dot(p, v) / distance
    if axis == 7:
        return along
    g = _crossed(p, b)
    across = np.sqrt(_dot(g, g))
    return (
        (_dot(v, b) - along * _dot(p, b) / distance - _dot(g, w)) / across if across > 0.0 else 0.0
    )


@kernel
def _call(regions, f, first, derivative, q, link_rotation, link_translation, out):
    """Write x, or dx/dq, of function f, whose first row is first, into rows of out.

    Return the row after its last one, and whether the function succeeded.
    """
    last = first
    while last < regions.region.shape[0] and regions.region[last] == regions.region[first]:
        last += 1
    failed = call_function(
        regions.functions[f, 0],
        (
            derivative,
            q.shape[0],
            last - first,
            q.ctypes.data,
            link_rotation.ctypes.data,
            link_translation.ctypes.data,
            regions.parameters[regions.functions[f, 1] :].ctypes.data,
            out[first:].ctypes.data,
        ),
    )
    return last, failed == 0


@kernel
def _function_residual(regions, q, link_rotation, link_translation, first, out):
    """Write F of the rows of functions, from row first on, into out (m,); return its square."""
    square = 0.0
    for f in range(regions.functions.shape[0]):
        last, done = _call(regions, f, first, 0, q, link_rotation, link_translation, out)
        for row in range(first, last):
            x, lower, upper = out[row], regions.lower[row], regions.upper[row]
            out[row] = min(x - lower, 0.0) + max(x - upper, 0.0)
            if not (done and np.isfinite(x)):
                out[row] = np.nan
            square += out[row] * out[row]
        first = last
    return square


@kernel
def _function_jacobian(
    regions, q, link_rotation, link_translation, first, full, out_of_bounds, out
):
    """Write dF/dq of the rows of functions, from row first on, into out, see `jacobian`."""
    for f in range(regions.functions.shape[0]):
        last, done = _call(regions, f, first, 1, q, link_rotation, link_translation, out)
        for row in range(first, last):
            if not done or (out_of_bounds[row] == 0.0 and not full):
                out[row, :] = 0.0
        first = last


@kernel(inline="machine")
def residual(regions, q, link_rotation, link_translation, out, displacement):
    """Write F = min(x - lower, 0) + max(x - upper, 0) (m,) into out; return |F|^2.

    x is the displacement of the regions, see the head of this file. It is nan where a function
    fails.

    Args:
        regions: k regions with m bounded rows.
        q: (n,) [rad or m].
        link_rotation: (p, 3, 3) by `forward_kinematics`.
        link_translation: (p, 3) by `forward_kinematics` [m].
        out: (m,), written: F [m, rad].
        displacement: (k, 18), written for `jacobian`: end point in the world and x of each region,
            x and y of c / |c|, and b. Of x, tilt, distance, radius and bearing are written where
            they are bounded; the rotation vector is 0 where only these are.
    """
    m = regions.region.shape[0]
    first, square = 0, 0.0
    for k in range(regions.link.shape[0]):
        end, position, columns = _displacement(regions, k, link_rotation, link_translation)
        tilts, turns, places = _kinds_of_rows(regions, k, first)
        vector = (0.0, 0.0, 0.0)
        if turns or not (tilts or places):
            vector = rotation_vector(columns[0], columns[1], columns[2])
        if tilts:
            x, y, z = columns[2]
            sine = np.sqrt(x * x + y * y)
            scale = 1.0 / sine if sine > 0.0 else 0.0
            displacement[k, 9] = np.arctan2(sine, z)
            displacement[k, 13] = -scale * y
            displacement[k, 14] = scale * x
        if places:
            _write_place(position, columns[2], displacement[k])
        for a in range(3):
            displacement[k, a] = _pick(end, a)
            displacement[k, 3 + a] = _pick(position, a)
            displacement[k, 6 + a] = _pick(vector, a)
        while first < m and regions.region[first] == k:
            x = displacement[k, 3 + regions.axis[first]]
            out[first] = min(x - regions.lower[first], 0.0) + max(x - regions.upper[first], 0.0)
            square += out[first] * out[first]
            first += 1
    if first < m:
        square += _function_residual(regions, q, link_rotation, link_translation, first, out)
    return square


@kernel(inline="source")
def _log_map_rate(vector, factor, square, w):
    """Jl^-1(vector) w: rate of the rotation vector of a frame turning with angular velocity w."""
    dot = factor * (vector[0] * w[0] + vector[1] * w[1] + vector[2] * w[2])
    rest = 1.0 - factor * square
    return (
        rest * w[0] + dot * vector[0] - 0.5 * (vector[1] * w[2] - vector[2] * w[1]),
        rest * w[1] + dot * vector[1] - 0.5 * (vector[2] * w[0] - vector[0] * w[2]),
        rest * w[2] + dot * vector[2] - 0.5 * (vector[0] * w[1] - vector[1] * w[0]),
    )


@kernel(inline="machine")
def jacobian(
    kinematics, regions, q, link_rotation, link_translation, displacement, full, out_of_bounds, out
):
    """Write J = dF/dq (m, n) into out: of v_j, Jl^-1(e) w_j, c . w_j / |c| ... for each joint j.

    v_j and w_j are the velocity and angular velocity of the end frame against the reference. Joints
    that mimic a planned joint come last; they are added to its column.

    Args:
        kinematics: kinematics of the robot.
        regions: k regions with m bounded rows.
        q: (n,) [rad or m].
        link_rotation: (p, 3, 3) by `forward_kinematics`.
        link_translation: (p, 3) by `forward_kinematics` [m].
        displacement: (k, 18), written by `residual` for the same link poses.
        full: rows inside their bounds keep the derivative of x instead of zero (the full-rank form
            that tangent-space planners need).
        out_of_bounds: (m,), F written by `residual`.
        out: (m, n), written: J.
    """
    n = kinematics.lower.shape[0]
    m = regions.region.shape[0]
    first = 0
    for k in range(regions.link.shape[0]):
        last, active = first, full
        while last < m and regions.region[last] == k:
            active = active or out_of_bounds[last] != 0.0
            last += 1
        if not active:
            for row in range(first, last):
                for j in range(n):
                    out[row, j] = 0.0
            first = last
            continue
        end = displacement[k, 0], displacement[k, 1], displacement[k, 2]
        vector = displacement[k, 6], displacement[k, 7], displacement[k, 8]
        factor, square = log_map_factor(vector)
        # rows of a region are sorted by axis
        bounds_position = regions.axis[first] < 3 or regions.axis[last - 1] > 6
        for place in range(kinematics.order.shape[0]):
            joint = kinematics.order[place]
            j = kinematics.entry[joint]
            v, w = _relative_velocity(
                kinematics, regions, k, joint, link_rotation, link_translation, end, bounds_position
            )
            rate = _log_map_rate(vector, factor, square, w)
            for row in range(first, last):
                axis = regions.axis[row]
                if out_of_bounds[row] == 0.0 and not full:
                    value = 0.0
                elif axis == 6:
                    value = displacement[k, 13] * w[0] + displacement[k, 14] * w[1]
                elif axis > 6:
                    value = _place_rate(axis, displacement[k], v, w)
                else:
                    value = _pick(v, axis) if axis < 3 else _pick(rate, axis - 3)
                if place < n:
                    out[row, j] = value
                else:
                    out[row, j] += kinematics.multiplier[joint] * value
        first = last
    if first < m:
        _function_jacobian(
            regions, q, link_rotation, link_translation, first, full, out_of_bounds, out
        )


@entry
def batch_residual_and_jacobian(
    kinematics: Kinematics,
    regions: Regions,
    configurations: Annotated[np.ndarray, "count n"],
    full: bool,
    rotation: Annotated[np.ndarray, "p 3 3"],
    translation: Annotated[np.ndarray, "p 3"],
    displacement: Annotated[np.ndarray, "k 18"],
    residuals: Annotated[np.ndarray, "count m"],
    jacobians: Annotated[np.ndarray, "count m n"],
):
    """Write F and dF/dq of a batch of configurations.

    Args:
        kinematics: kinematics of the robot.
        regions: k regions with m bounded rows.
        configurations: (b, n) [rad or m].
        full: see `jacobian`.
        rotation: (p, 3, 3) work array.
        translation: (p, 3) work array.
        displacement: (k, 18) work array.
        residuals: (b, m), written: F [m, rad].
        jacobians: (b, m, n), written: dF/dq.
    """
    for i in range(configurations.shape[0]):
        forward_kinematics(kinematics, configurations[i], rotation, translation)
        q = configurations[i]
        residual(regions, q, rotation, translation, residuals[i], displacement)
        jacobian(
            kinematics,
            regions,
            q,
            rotation,
            translation,
            displacement,
            full,
            residuals[i],
            jacobians[i],
        )
