"""Motions on the constraint manifold: one projected step, and the fine check of a finished motion."""

import numpy as np

from cvqmpt_lab.kernels.compiling import inlined, kernel
from cvqmpt_lab.kernels.kinematics import forward_kinematics
from cvqmpt_lab.kernels.space import posed_state_valid, project_state, state_valid
from cvqmpt_lab.kernels.task_space_region import residual_and_jacobian

STOPPED, ADVANCED, REACHED = range(3)
DEVIATION = (
    2.0  # OMPL's lambda: a projected step may be this much longer than planned, a motion than straight
)
GAP = 1.5  # midpoints stop when straight pieces are this many steps long: below DEVIATION
CHORD = 5e-4  # [m, rad] a straight motion between two states may leave the planned bounds by this
MOST_HALVINGS = 8
CLOSE = 1e-9  # [rad] two states closer than this are one


@inlined
def distance(a, b):
    """Euclidean distance of two configurations (n,) [rad]."""
    square = 0.0
    for j in range(a.shape[0]):
        square += (a[j] - b[j]) * (a[j] - b[j])
    return np.sqrt(square)


@kernel
def step_towards(space, origin, target, allowance, out):
    """One step of ConstrainedExtend (paper, Algorithm 3): move, project, check.

    Parameters
    ----------
    origin, target: (n,). allowance: how much longer the motion may still become [rad].
    out: (n,), the new state when the result is not STOPPED.

    Returns
    -------
    STOPPED, ADVANCED or REACHED. A step is refused when projection fails, drifts further than
    DEVIATION * step, exceeds the allowance, does not come closer to the target, or collides.
    """
    n = origin.shape[0]
    remaining = distance(origin, target)
    fraction = min(1.0, space.step / remaining)
    for j in range(n):
        out[j] = origin[j] + fraction * (target[j] - origin[j])
    if not project_state(space, out):
        return STOPPED
    moved = distance(origin, out)
    left = distance(out, target)
    if moved > DEVIATION * space.step or moved > allowance or left >= remaining or moved < CLOSE:
        return STOPPED
    if not posed_state_valid(space, out):
        return STOPPED
    return REACHED if left < CLOSE else ADVANCED


@kernel
def bisect_motion(space, origin, target, longest, out):
    """Join origin and target on the manifold by projected midpoints, coarse to fine, so that failure is early.

    Parameters
    ----------
    longest: give up when the motion becomes longer than this [rad].
    out: (k, n) room for the states after origin, the last of which is target.

    Returns
    -------
    Number of states written, or 0 when a state cannot be projected, collides, or lies too far from its neighbour.
    """
    pieces = 1
    while distance(origin, target) > GAP * space.step * pieces:
        pieces *= 2
    if pieces > out.shape[0]:
        return 0
    for j in range(target.shape[0]):
        out[pieces - 1, j] = target[j]
    stride = pieces
    while stride > 1:
        half = stride // 2
        for k in range(half, pieces, stride):  # state k lies in row k - 1
            for j in range(target.shape[0]):
                left = origin[j] if k == half else out[k - half - 1, j]
                out[k - 1, j] = 0.5 * (left + out[k + half - 1, j])
            if not project_state(space, out[k - 1]) or not posed_state_valid(space, out[k - 1]):
                return 0
        stride = half
    length = distance(origin, out[0])
    if length > DEVIATION * space.step:
        return 0
    for k in range(1, pieces):
        gap = distance(out[k - 1], out[k])
        length += gap
        if gap > DEVIATION * space.step or length > longest:
            return 0
    return pieces


@kernel
def chord_on_manifold(space, a, b):
    """Whether the straight joint motion between two states on the manifold stays within CHORD of it.

    Looked at every space.resolution: the middle is not always worst, the rotation vector has a kink at angle pi.
    """
    residual = space.scratch.residual
    if residual.shape[0] == 0:
        return True
    rotation, translation = space.scratch.link_rotation, space.scratch.link_translation
    pieces = int(np.ceil(distance(a, b) / space.resolution))
    for k in range(1, pieces):
        fraction = k / pieces
        for j in range(a.shape[0]):
            space.state[j] = a[j] + fraction * (b[j] - a[j])
        forward_kinematics(space.kinematics, space.state, rotation, translation)
        residual_and_jacobian(
            space.kinematics, space.regions, rotation, translation, False, residual, space.scratch.jacobian
        )
        for i in range(residual.shape[0]):
            if abs(residual[i]) > CHORD:
                return False
    return True


@kernel
def motion_free(space, a, b):
    """Whether b and the straight joint motion towards it are free of collision at space.resolution."""
    if not state_valid(space, b):
        return False
    pieces = int(np.ceil(distance(a, b) / space.resolution))
    stride = 1
    while stride < pieces:
        stride *= 2
    while stride > 1:  # coarse to fine: a collision is found early
        for k in range(stride // 2, pieces, stride):
            fraction = k / pieces
            for j in range(a.shape[0]):
                space.state[j] = a[j] + fraction * (b[j] - a[j])
            if not state_valid(space, space.state):
                return False
        stride //= 2
    return True


@inlined
def segment_valid(space, a, b):
    """Whether the straight joint motion between a and b stays close to the manifold and is free."""
    return chord_on_manifold(space, a, b) and motion_free(space, a, b)


@kernel
def refine_and_check(space, states, count, out):
    """Copy a path into out (k, n), with projected states put in until every straight motion is short and good.

    Parameters
    ----------
    states: (m, n), first count rows the path.

    Returns
    -------
    written: number of states in out. bad: first segment of the given path that cannot be mended or
    is not free, or -1.
    """
    n = states.shape[1]
    for j in range(n):
        out[0, j] = states[0, j]
    written, i = 1, 1
    while i < count:
        if written >= out.shape[0]:
            return written, i - 1
        for j in range(n):
            out[written, j] = states[i, j]
        halvings = 0
        while distance(out[written - 1], out[written]) > DEVIATION * space.step or not chord_on_manifold(
            space, out[written - 1], out[written]
        ):
            for j in range(n):
                out[written, j] = 0.5 * (out[written - 1, j] + out[written, j])
            halvings += 1
            if halvings > MOST_HALVINGS or not project_state(space, out[written]):
                return written, i - 1
        if not motion_free(space, out[written - 1], out[written]):
            return written, i - 1
        written += 1
        if halvings == 0:
            i += 1
    return written, -1
