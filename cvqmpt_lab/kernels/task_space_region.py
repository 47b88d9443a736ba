"""Residual and Jacobian of stacked task-space regions, on plain arrays.

A region bounds the pose of an end frame e seen from a reference frame w (Berenson et al. 2011):

    T = (T0_w)^-1  T0_e  (Tw_e)^-1,    x = (translation of T, rotation logarithm of T),

with residual = signed distance of x outside [lower, upper], zero inside. Several regions stack their
rows: their intersection. No rows at all is the unconstrained problem.
"""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.kernels.compiling import driver, inlined
from cvqmpt_lab.kernels.kinematics import forward_kinematics
from cvqmpt_lab.kernels.rotation import log_map_factor, rotation_vector


class Regions(NamedTuple):
    """k stacked regions with m bounded rows in all.

    Attributes
    ----------
    link, base: (k,) int64, pose rows carrying the end frame and the reference frame (base 0 = world).
    end_rotation, end_translation: (k, 3, 3), (k, 3): T_link_e (Tw_e)^-1.
    reference_rotation, reference_translation: (k, 3, 3), (k, 3): T_base_w.
    region: (m,) int64, region of each row; axis: (m,) int64, 0-2 position, 3-5 rotation vector.
    lower, upper: (m,) bounds [m or rad].
    """

    link: np.ndarray
    base: np.ndarray
    end_rotation: np.ndarray
    end_translation: np.ndarray
    reference_rotation: np.ndarray
    reference_translation: np.ndarray
    region: np.ndarray
    axis: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@inlined
def _turned(rotation, i, x, y, z):
    """rotation[i] applied to (x, y, z)."""
    return (
        rotation[i, 0, 0] * x + rotation[i, 0, 1] * y + rotation[i, 0, 2] * z,
        rotation[i, 1, 0] * x + rotation[i, 1, 1] * y + rotation[i, 1, 2] * z,
        rotation[i, 2, 0] * x + rotation[i, 2, 1] * y + rotation[i, 2, 2] * z,
    )


@inlined
def _turned_back(rotation, i, x, y, z):
    """Transpose of rotation[i] applied to (x, y, z)."""
    return (
        rotation[i, 0, 0] * x + rotation[i, 1, 0] * y + rotation[i, 2, 0] * z,
        rotation[i, 0, 1] * x + rotation[i, 1, 1] * y + rotation[i, 2, 1] * z,
        rotation[i, 0, 2] * x + rotation[i, 1, 2] * y + rotation[i, 2, 2] * z,
    )


@inlined
def _into_reference(regions, k, link_rotation, x, y, z):
    """A world vector in the axes of reference frame w of region k."""
    base = regions.base[k]
    if base != 0:
        x, y, z = _turned_back(link_rotation, base, x, y, z)
    return _turned_back(regions.reference_rotation, k, x, y, z)


@inlined
def _displacement(regions, k, link_rotation, link_translation):
    """End point in the world (3), then displacement of region k: position (3), rotation vector (3)."""
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
    vector = rotation_vector(
        _into_reference(regions, k, link_rotation, a[0], a[1], a[2]),
        _into_reference(regions, k, link_rotation, b[0], b[1], b[2]),
        _into_reference(regions, k, link_rotation, c[0], c[1], c[2]),
    )
    return end, position, vector


@inlined
def _relative_velocity(kinematics, regions, k, j, link_rotation, link_translation, end):
    """Velocity (3) and angular velocity (3) of the end frame against the reference, per unit of joint j."""
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
    dx = end[0] - link_translation[j + 1, 0]
    dy = end[1] - link_translation[j + 1, 1]
    dz = end[2] - link_translation[j + 1, 2]
    linear = _into_reference(
        regions, k, link_rotation, zy * dz - zz * dy, zz * dx - zx * dz, zx * dy - zy * dx
    )
    return linear, _into_reference(regions, k, link_rotation, zx, zy, zz)


@inlined
def _pick(vector, axis):
    """Component 0, 1 or 2 of a triple."""
    return vector[0] if axis == 0 else (vector[1] if axis == 1 else vector[2])


@inlined
def residual_and_jacobian(kinematics, regions, link_rotation, link_translation, full, out, jacobian):
    """Write residual (m,) and its Jacobian (m, n); link poses come from forward_kinematics.

    full: rows inside their bounds keep the derivative of x instead of zero (the full-rank form
    that tangent-space planners need).
    """
    n = kinematics.parent.shape[0]
    m = regions.region.shape[0]
    first = 0
    for k in range(regions.link.shape[0]):
        end, position, vector = _displacement(regions, k, link_rotation, link_translation)
        last = first
        any_active = full
        while last < m and regions.region[last] == k:
            axis = regions.axis[last]
            x = _pick(position, axis) if axis < 3 else _pick(vector, axis - 3)
            out[last] = min(x - regions.lower[last], 0.0) + max(x - regions.upper[last], 0.0)
            any_active = any_active or out[last] != 0.0
            last += 1
        if not any_active:
            for row in range(first, last):
                for j in range(n):
                    jacobian[row, j] = 0.0
            first = last
            continue
        factor, square = log_map_factor(vector)
        for j in range(n):
            v, w = _relative_velocity(kinematics, regions, k, j, link_rotation, link_translation, end)
            dot = vector[0] * w[0] + vector[1] * w[1] + vector[2] * w[2]
            rest = 1.0 - factor * square
            rate = (  # Jl^-1(vector) w
                rest * w[0] + factor * dot * vector[0] - 0.5 * (vector[1] * w[2] - vector[2] * w[1]),
                rest * w[1] + factor * dot * vector[1] - 0.5 * (vector[2] * w[0] - vector[0] * w[2]),
                rest * w[2] + factor * dot * vector[2] - 0.5 * (vector[0] * w[1] - vector[1] * w[0]),
            )
            for row in range(first, last):
                axis = regions.axis[row]
                if out[row] == 0.0 and not full:
                    jacobian[row, j] = 0.0
                else:
                    jacobian[row, j] = _pick(v, axis) if axis < 3 else _pick(rate, axis - 3)
        first = last


@driver
def batch_residual_and_jacobian(kinematics, regions, configurations, full):
    """Residuals (b, m) and Jacobians (b, m, n) of configurations (b, n)."""
    b, n = configurations.shape
    m = regions.region.shape[0]
    link_rotation, link_translation = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    residuals, jacobians = np.zeros((b, m)), np.zeros((b, m, n))
    for i in range(b):
        forward_kinematics(kinematics, configurations[i], link_rotation, link_translation)
        residual_and_jacobian(
            kinematics, regions, link_rotation, link_translation, full, residuals[i], jacobians[i]
        )
    return residuals, jacobians
