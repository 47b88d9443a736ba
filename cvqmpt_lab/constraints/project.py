"""Project (the paper's Algorithm 1): Newton's method onto the constraint manifold {q : F(q) = 0}.

    while |F(q)| > tol:   q <- q - J(q)^+ F(q),    J^+ = J^T (J J^T)^-1

F (m,) and J (m, n) are the residual and Jacobian of task-space regions, see `regions` [m, rad]; the
paper prints J for J^+. Only rows outside their bounds enter a step (the others are zero); J J^T is
damped a little, so that zero and dependent rows do no harm. A joint that stands at a limit and
would be pushed beyond it is held and the step computed again without it; what still leaves the
limits is clipped.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import entry, kernel
from cvqmpt_lab.constraints.regions import Regions, jacobian, residual
from cvqmpt_lab.robot.kinematics import Kinematics, forward_kinematics

PROJECTION_TOLERANCE = 1e-4  # [m, rad] on |F|, OMPL's default
PROJECTION_STEPS = 50  # Newton steps at most, OMPL's default
DAMPING = 1e-9  # relative to the trace of J J^T
LONGEST_STEP = 1.0  # [rad] Newton steps are shortened to this norm
# with stop_on_stall, the first step that leaves more than this share of |F| is the last
STALLED = 0.9


class ProjectionScratch(NamedTuple):
    """Work arrays of a projection with n joints, k regions and m bounded rows."""

    link_rotation: Annotated[np.ndarray, "p 3 3"]  # link poses
    link_translation: Annotated[np.ndarray, "p 3"]  # link poses [m]
    displacement: Annotated[np.ndarray, "k 18"]  # written by `residual` for `jacobian`
    residual: Annotated[np.ndarray, "m"]  # F [m, rad]
    jacobian: Annotated[np.ndarray, "m n"]  # J
    normal: Annotated[np.ndarray, "m m"]  # Cholesky factor of J J^T
    multiplier: Annotated[np.ndarray, "m"]  # (J J^T)^-1 F
    step: Annotated[np.ndarray, "n"]  # Newton step [rad or m]


def projection_scratch(kinematics: Kinematics, regions: Regions) -> ProjectionScratch:
    """Work arrays for n planned joints and the m bounded rows of regions."""
    m, n, rows = len(regions.axis), len(kinematics.lower), len(kinematics.parent) + 1
    shapes: tuple[Any, ...] = (
        (rows, 3, 3),
        (rows, 3),
        (len(regions.link), 18),
        m,
        (m, n),
        (m, m),
        m,
        n,
    )
    return ProjectionScratch(*map(np.zeros, shapes))


@kernel(inline="source")
def _solve_normal_equations(scratch):
    """Write (J J^T + damping)^-1 residual into scratch.multiplier by Cholesky factorisation."""
    rows, normal, x = scratch.jacobian, scratch.normal, scratch.multiplier
    m, n = rows.shape
    trace = 0.0
    for i in range(m):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += rows[i, k] * rows[j, k]
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
        x[i] = scratch.residual[i]
        for k in range(i):
            x[i] -= normal[i, k] * x[k]
        x[i] /= normal[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            x[i] -= normal[k, i] * x[k]
        x[i] /= normal[i, i]


@kernel(inline="source")
def newton_step(scratch, out):
    """Write the minimum-norm step -J^T (J J^T)^-1 F into out (n,)."""
    _solve_normal_equations(scratch)
    m, n = scratch.jacobian.shape
    square = 0.0
    for j in range(n):
        out[j] = 0.0
        for i in range(m):
            out[j] -= scratch.jacobian[i, j] * scratch.multiplier[i]
        square += out[j] * out[j]
    if square > LONGEST_STEP * LONGEST_STEP:
        scale = LONGEST_STEP / np.sqrt(square)
        for j in range(n):
            out[j] *= scale


@kernel(inline="source")
def _hold_joints_at_limits(kinematics, q, scratch):
    """Zero the columns of J of joints that would leave a limit; return whether there are any."""
    found = False
    for j in range(q.shape[0]):
        below = q[j] <= kinematics.lower[j] and scratch.step[j] < 0.0
        if below or (q[j] >= kinematics.upper[j] and scratch.step[j] > 0.0):
            found = True
            for i in range(scratch.jacobian.shape[0]):
                scratch.jacobian[i, j] = 0.0
    return found


@kernel(inline="source")
def newton(kinematics, regions, q, tolerance, max_iterations, stop_on_stall, scratch):
    """Project q (n,) in place by Newton's method, see the head of this file.

    Args:
        kinematics: kinematics of the robot.
        regions: the constraint.
        q: (n,), projected in place [rad or m].
        tolerance: of |F| [m, rad].
        max_iterations: Newton steps at most.
        stop_on_stall: whether to give up as soon as |F| hardly falls, see STALLED.
        scratch: work arrays.

    Returns:
        Number of Newton steps k, or -1 - k on failure.
    """
    for j in range(q.shape[0]):
        q[j] = min(max(q[j], kinematics.lower[j]), kinematics.upper[j])
    rotation, translation = scratch.link_rotation, scratch.link_translation
    iteration, before = 0, np.inf
    while True:
        forward_kinematics(kinematics, q, rotation, translation)
        square = residual(regions, q, rotation, translation, scratch.residual, scratch.displacement)
        if square <= tolerance * tolerance:
            return iteration
        stalled = stop_on_stall and square > STALLED * STALLED * before
        if iteration == max_iterations or stalled or not np.isfinite(square):
            return -1 - iteration
        before = square
        outside, J = scratch.residual, scratch.jacobian
        jacobian(
            kinematics, regions, q, rotation, translation, scratch.displacement, False, outside, J
        )
        for _ in range(2):
            newton_step(scratch, scratch.step)
            if not _hold_joints_at_limits(kinematics, q, scratch):
                break
        for j in range(q.shape[0]):
            q[j] = min(max(q[j] + scratch.step[j], kinematics.lower[j]), kinematics.upper[j])
        iteration += 1


@entry(inline="machine")
def project(
    kinematics: Kinematics,
    regions: Regions,
    q: Annotated[np.ndarray, "n"],
    tolerance: float,
    max_iterations: int,
    scratch: ProjectionScratch,
):
    """Algorithm 1: move q in place onto the manifold and inside the joint limits.

        while |F(q)| > tolerance:   q <- q - J^+(q) F(q)

    On success scratch holds the link poses of q, ready for a collision check.

    Args:
        kinematics: kinematics of the robot.
        regions: the constraint.
        q: (n,), changed [rad or m].
        tolerance: of |F| [m, rad].
        max_iterations: Newton steps at most.
        scratch: work arrays.

    Returns:
        Newton steps taken, or -1 - steps on failure.
    """
    return newton(kinematics, regions, q, tolerance, max_iterations, False, scratch)


@entry
def reach_poses(
    kinematics: Kinematics,
    regions: Regions,
    rotations: Annotated[np.ndarray, "count 3 3"],
    translations: Annotated[np.ndarray, "count 3"],
    configurations: Annotated[np.ndarray, "count attempts n"],
    tolerance: float,
    max_iterations: int,
    scratch: ProjectionScratch,
    iterations: Annotated[np.ndarray, "int64 count attempts"],
):
    """Project configurations in place onto poses of the first region's reference frame.

    Args:
        kinematics: kinematics of the robot.
        regions: the constraint; the reference frame of its first region is overwritten.
        rotations: (k, 3, 3) of the poses.
        translations: (k, 3) of the poses [m].
        configurations: (k, a, n), a seeds for each pose, projected in place [rad or m].
        tolerance: of |F| [m, rad].
        max_iterations: Newton steps at most.
        scratch: work arrays.
        iterations: (k, a), written, as `project` returns them.
    """
    for i in range(configurations.shape[0]):
        for row in range(3):
            regions.reference_translation[0, row] = translations[i, row]
            for column in range(3):
                regions.reference_rotation[0, row, column] = rotations[i, row, column]
        for k in range(configurations.shape[1]):
            q = configurations[i, k]
            iterations[i, k] = project(kinematics, regions, q, tolerance, max_iterations, scratch)
