"""Newton projection onto a constraint manifold: the paper's Algorithm 1 with its missing inverse.

    q <- q - J^T (J J^T)^-1 F(q),  until |F(q)| <= tolerance.

Only rows outside their bounds enter a step (the others are zero), J J^T is damped a little so that
zero and dependent rows do no harm, and every step is clipped to the joint limits.
"""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.kernels.compiling import driver, inlined
from cvqmpt_lab.kernels.kinematics import forward_kinematics
from cvqmpt_lab.kernels.task_space_region import residual_and_jacobian

DAMPING = 1e-9  # relative to the trace of J J^T
LONGEST_STEP = 1.0  # [rad] Newton steps are shortened to this norm


class ProjectionScratch(NamedTuple):
    """Work arrays: link poses, residual (m,), Jacobian (m, n), normal matrix (m, m), step (n,)."""

    link_rotation: np.ndarray
    link_translation: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    normal: np.ndarray
    step: np.ndarray


def projection_scratch(n: int, m: int) -> ProjectionScratch:
    """Work arrays for n joints and m bounded rows."""
    return ProjectionScratch(
        np.zeros((n + 1, 3, 3)),
        np.zeros((n + 1, 3)),
        np.zeros(m),
        np.zeros((m, n)),
        np.zeros((m, m)),
        np.zeros(n),
    )


@inlined
def _solve_normal_equations(scratch):
    """Overwrite scratch.residual with (J J^T + damping)^-1 residual by Cholesky factorisation."""
    jacobian, normal, x = scratch.jacobian, scratch.normal, scratch.residual
    m, n = jacobian.shape
    trace = 0.0
    for i in range(m):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += jacobian[i, k] * jacobian[j, k]
            normal[i, j] = total
        trace += normal[i, i]
    damping = DAMPING * trace + 1e-14
    for i in range(m):
        normal[i, i] += damping
        for j in range(i + 1):
            total = normal[i, j]
            for k in range(j):
                total -= normal[i, k] * normal[j, k]
            if i == j:
                normal[i, i] = np.sqrt(max(total, damping))
            else:
                normal[i, j] = total / normal[j, j]
    for i in range(m):
        for k in range(i):
            x[i] -= normal[i, k] * x[k]
        x[i] /= normal[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            x[i] -= normal[k, i] * x[k]
        x[i] /= normal[i, i]


@inlined
def newton_step(scratch, out):
    """Write the minimum-norm step -J^T (J J^T)^-1 F into out (n,); overwrites scratch.residual."""
    _solve_normal_equations(scratch)
    m, n = scratch.jacobian.shape
    square = 0.0
    for j in range(n):
        out[j] = 0.0
        for i in range(m):
            out[j] -= scratch.jacobian[i, j] * scratch.residual[i]
        square += out[j] * out[j]
    if square > LONGEST_STEP * LONGEST_STEP:
        scale = LONGEST_STEP / np.sqrt(square)
        for j in range(n):
            out[j] *= scale


@inlined
def project(kinematics, regions, q, tolerance, max_iterations, scratch):
    """Move q (n,) in place onto the manifold and inside the joint limits.

    Returns
    -------
    Newton iterations used, or -1 - iterations when |F| > tolerance after max_iterations.
    On success scratch holds the link poses of q, ready for a collision check.
    """
    for j in range(q.shape[0]):
        q[j] = min(max(q[j], kinematics.lower[j]), kinematics.upper[j])
    iteration = 0
    while True:
        forward_kinematics(kinematics, q, scratch.link_rotation, scratch.link_translation)
        if scratch.residual.shape[0] == 0:
            return 0
        residual_and_jacobian(
            kinematics,
            regions,
            scratch.link_rotation,
            scratch.link_translation,
            False,
            scratch.residual,
            scratch.jacobian,
        )
        square = 0.0
        for i in range(scratch.residual.shape[0]):
            square += scratch.residual[i] * scratch.residual[i]
        if square <= tolerance * tolerance:
            return iteration
        if iteration == max_iterations or not np.isfinite(square):
            return -1 - iteration
        newton_step(scratch, scratch.step)
        for j in range(q.shape[0]):
            q[j] = min(max(q[j] + scratch.step[j], kinematics.lower[j]), kinematics.upper[j])
        iteration += 1


@driver
def project_batch(kinematics, regions, configurations, tolerance, max_iterations, scratch):
    """Project every row of configurations (b, n) in place; returns iterations (b,), < 0 where it failed."""
    iterations = np.empty(configurations.shape[0], np.int64)
    for i in range(configurations.shape[0]):
        iterations[i] = project(kinematics, regions, configurations[i], tolerance, max_iterations, scratch)
    return iterations
