"""The rotation logarithm and the inverse of its left Jacobian, well-behaved from angle 0 to pi.

With R = exp([e]x) and a body turning with angular velocity w (expressed in the frame R maps into),
de/dt = Jl^-1(e) w, where

    Jl^-1(e) = I - [e]x / 2 + (1 / t^2 - cot(t / 2) / (2 t)) [e]x^2,    t = |e|.

The half-angle cotangent stays finite at t = pi, where the usual (1 + cos t) / sin t is 0 / 0.
"""

import numpy as np

from cvqmpt_lab.jit import kernel

SMALL_ANGLE = 1e-5  # [rad] below it, series are exact to double precision
NEAR_PI = 1e-4  # [rad] above pi - NEAR_PI, the axis is read from the symmetric part


@kernel
def _axis_near_pi(a, b, c, cosine, angle, x, y, z):
    """Rotation vector near angle pi: (R + R^T) / 2 = cos(t) I + (1 - cos(t)) u u^T holds the axis u."""
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
    """Axis times angle (3 floats) [rad] of the rotation with columns a, b, c; the angle lies in [0, pi]."""
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
    """Factor of [e]x^2 in Jl^-1(e), and |e|^2 [rad^2], of a rotation vector e."""
    square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    if square < 1e-6:
        return 1.0 / 12.0 + square / 720.0, square
    angle = np.sqrt(square)
    return 1.0 / square - 0.5 / (angle * np.tan(0.5 * angle)), square
