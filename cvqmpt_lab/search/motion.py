"""The planning space in compiled code, and motions in it: projected steps and the fine check.

The compiled checker finds collisions; when `exact` is set, a callback into Python (coal) does.
"""

from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.base.jit import (
    call_address,
    called_at_address,
    entry,
    kernel,
    placed,
    taken_from,
)
from cvqmpt_lab.collision.checker import CONTACT, safe_advance
from cvqmpt_lab.collision.geometry import RobotGeometry, SceneGeometry
from cvqmpt_lab.constraints.project import ProjectionScratch, project
from cvqmpt_lab.constraints.regions import Regions, residual
from cvqmpt_lab.robot.kinematics import Kinematics, forward_kinematics

# rows of Space.counters
(
    PROJECTIONS,
    NEWTON_ITERATIONS,
    STATE_CHECKS,
    ITERATIONS,
    CLEARANCES,
    EXTENSIONS,
    DRAW_PROJECTIONS,
    DRAW_NEWTON_ITERATIONS,
) = range(8)
TRAPPED, ADVANCED, TARGET_REACHED = range(3)  # results of a step, as in RRT-Connect
# OMPL's lambda: largest ratio of a projected step's length to the planned one, and of a motion's
# length to the straight distance
MAX_LENGTH_RATIO = 2.0
# bisection ends when straight pieces are at most this many steps long; below MAX_LENGTH_RATIO
MAX_BISECTED_STEPS = 1.5
SAME_STATE_RAD = 1e-9  # states closer than this are the same


class Space(NamedTuple):
    """Everything a planning kernel needs."""

    kinematics: Kinematics  # of the robot
    regions: Regions  # the constraint
    robot: RobotGeometry  # convex pieces
    scene: SceneGeometry  # obstacles
    tolerance: float  # largest |F| after projection [m, rad]
    chord: float  # largest |F| on straight motions between two states [m, rad]
    max_iterations: int  # Newton steps per projection
    step: float  # longest motion between neighbouring states [rad]
    resolution: float  # spacing of the exact backend's final check of a motion [rad]
    margin: float  # distance kept from obstacles [m]
    exact: bool  # whether states are checked through the callback
    check: int  # address of the callback; numba needs 0.5 ms a call for the type of an object
    query: Annotated[np.ndarray, "n"]  # configuration that the callback checks
    # configurations that collide for the compiled checker but not for the exact one; near them the
    # callback decides
    doubtful: Annotated[np.ndarray, "doubtful n"]
    # when joint j moves by dq[j], no point of the robot moves more than swing[j] * |dq[j]| [m/rad]
    swing: Annotated[np.ndarray, "n"]
    counters: Annotated[np.ndarray, "int64 8"]  # PROJECTIONS to DRAW_NEWTON_ITERATIONS
    state: Annotated[np.ndarray, "n"]  # work array
    scratch: ProjectionScratch  # work arrays of projections
    ends: Annotated[np.ndarray, "2 n"]  # work array of `motion_free`
    proven: Annotated[np.ndarray, "int64 1"]  # segments that the last `blocked_segment` proved
    # largest |dq_j| of each joint per metre of sweep on a stretch, see `blocked_segment`
    motion: Annotated[np.ndarray, "n"]
    balls: Annotated[np.ndarray, "bodies 4"]  # work array of `safe_advance`
    # addresses of entries that are called without a copy of their machine code
    projection: int  # of `project_at`
    advance: int  # of `advance_at`
    bisection: int  # of `bisect_motion`
    proof: int  # of `blocked_segment`
    here: int = 0  # address of this tuple, written by `placed` where an entry begins


_space_at = taken_from(Space)


@entry
def project_at(here: int, q: Annotated[np.ndarray, "n"]):
    """Project q (n,) in place and count it, in the space at an address.

    Returns:
        Number of Newton steps; negative if the projection failed. The scratch then holds the link
        poses.
    """
    space = _space_at(here)
    iterations = project(
        space.kinematics, space.regions, q, space.tolerance, space.max_iterations, space.scratch
    )
    if space.scratch.residual.shape[0] > 0:
        space.counters[PROJECTIONS] += 1
        space.counters[NEWTON_ITERATIONS] += iterations if iterations >= 0 else -1 - iterations
    return iterations


_projection = called_at_address(project_at)


@kernel(inline="source")
def project_state(space, q):
    """Project q (n,) in place and count it.

    Returns:
        True on success; the scratch then holds the link poses.
    """
    return _projection(space.projection, (space.here, q)) >= 0


@kernel(inline="source")
def _near_doubtful(space, q):
    """Whether q (n,) lies close to a doubtful configuration."""
    radius = 0.2  # [rad]
    for i in range(space.doubtful.shape[0]):
        square = 0.0
        for j in range(q.shape[0]):
            square += (q[j] - space.doubtful[i, j]) * (q[j] - space.doubtful[i, j])
        if square < radius * radius:
            return True
    return False


@entry
def advance_at(here: int, q: Annotated[np.ndarray, "n"], advance: float):
    """Return the largest advance [m] for which the robot keeps the margin of a space, or CONTACT.

    Args:
        here: address of the space. Its scratch holds the link poses of q, its `motion` the motion
            of the joints, see `checker.safe_advance`. The exact backend checks the state alone.
        q: (n,) [rad or m].
        advance: the largest one of interest [m].
    """
    space = _space_at(here)
    space.counters[STATE_CHECKS] += 1
    if not space.exact:
        advance = safe_advance(
            space.scratch.link_rotation,
            space.scratch.link_translation,
            space.robot,
            space.scene,
            space.margin,
            space.motion,
            advance,
            space.balls,
        )
        if advance >= 0.0 or not _near_doubtful(space, q):
            return advance
    for j in range(q.shape[0]):
        space.query[j] = q[j]
    return 0.0 if call_address(space.check) else CONTACT


_advance = called_at_address(advance_at, float)


@kernel(inline="source")
def _posed_advance(space, q, advance):
    """Call `advance_at` at its address."""
    return _advance(space.advance, (space.here, q, advance))


@kernel(inline="source")
def posed_state_valid(space, q):
    """Whether q, whose link poses the scratch holds, keeps the distance space.margin."""
    return _posed_advance(space, q, 0.0) >= 0.0


@kernel(inline="source")
def state_valid(space, q):
    """Whether q (n,) is free of collision."""
    forward_kinematics(
        space.kinematics, q, space.scratch.link_rotation, space.scratch.link_translation
    )
    return posed_state_valid(space, q)


@entry
def states_valid(
    space: Space,
    configurations: Annotated[np.ndarray, "count n"],
    out: Annotated[np.ndarray, "bool count"],
):
    """Write whether each configuration (b, n) is free of collision into out (b,) bool."""
    space = placed(space)
    for i in range(configurations.shape[0]):
        out[i] = state_valid(space, configurations[i])


@kernel(inline="machine")
def distance(a, b):
    """|a - b|, the Euclidean distance of two configurations (n,) [rad]."""
    square = 0.0
    for j in range(a.shape[0]):
        square += (a[j] - b[j]) * (a[j] - b[j])
    return np.sqrt(square)


@kernel
def step_towards(space, origin, target, longest, out):
    """One step of ConstrainedExtend (paper, Algorithm 3): move, project, check.

        q_new = Project(q + min(1, step / |q_target - q|) (q_target - q))

    A step is refused when projection fails, when it is longer than MAX_LENGTH_RATIO * step or
    `longest`, when it does not come closer to the target, or when it collides.

    Args:
        space: the planning space.
        origin: q (n,) [rad or m].
        target: q_target (n,) [rad or m].
        longest: upper bound of the step's length [rad].
        out: (n,), written: q_new unless the result is TRAPPED.

    Returns:
        TRAPPED, ADVANCED or TARGET_REACHED.
    """
    n = origin.shape[0]
    remaining = distance(origin, target)
    fraction = min(1.0, space.step / remaining)
    for j in range(n):
        out[j] = origin[j] + fraction * (target[j] - origin[j])
    if not project_state(space, out):
        return TRAPPED
    moved = distance(origin, out)
    left = distance(out, target)
    if moved > MAX_LENGTH_RATIO * space.step or moved > longest:
        return TRAPPED
    if left >= remaining or moved < SAME_STATE_RAD:
        return TRAPPED
    if not posed_state_valid(space, out):
        return TRAPPED
    return TARGET_REACHED if left < SAME_STATE_RAD else ADVANCED


@entry
def bisect_motion(
    space: Space,
    origin: Annotated[np.ndarray, "n"],
    target: Annotated[np.ndarray, "n"],
    longest: float,
    out: Annotated[np.ndarray, "capacity n"],
):
    """Connect two states on the manifold by projected midpoints, from coarse to fine.

    Project((a + b) / 2) is inserted between neighbours a and b. Most motions that fail do so after
    few states.

    Args:
        space: the planning space.
        origin: first state (n,) [rad or m].
        target: last state (n,) [rad or m].
        longest: longer motions are refused [rad].
        out: written, the states after origin, up to and including target.

    Returns:
        Number of states; 0 when a projection fails, a state collides, or two neighbours are too far
        apart.
    """
    space = placed(space)
    pieces = 1
    while distance(origin, target) > MAX_BISECTED_STEPS * space.step * pieces:
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
    if length > MAX_LENGTH_RATIO * space.step:
        return 0
    for k in range(1, pieces):
        gap = distance(out[k - 1], out[k])
        length += gap
        if gap > MAX_LENGTH_RATIO * space.step or length > longest:
            return 0
    return pieces


_bisection = called_at_address(bisect_motion)


@kernel(inline="source")
def motion_between(space, origin, target, longest, out):
    """Call `bisect_motion` at its address.

    Args:
        space: the planning space.
        origin: first state (n,) [rad or m].
        target: last state (n,) [rad or m].
        longest: longer motions are refused [rad].
        out: (capacity, n), written as by `bisect_motion`.
    """
    return _bisection(space.bisection, (space, origin, target, longest, out))


@kernel(inline="source")
def _place_between(space, a, b, fraction):
    """Write q = a + fraction (b - a) into space.state and pose its links."""
    for j in range(a.shape[0]):
        space.state[j] = a[j] + fraction * (b[j] - a[j])
    forward_kinematics(
        space.kinematics, space.state, space.scratch.link_rotation, space.scratch.link_translation
    )


@kernel(inline="source")
def _near_half_turn(space):
    """Whether the rotation to a region is by almost pi, in the state of the last residual."""
    # [rad] below this angle, one segment cannot reach pi
    limit = 2.8
    displacement = space.scratch.displacement
    for k in range(displacement.shape[0]):
        x, y, z = displacement[k, 6], displacement[k, 7], displacement[k, 8]
        if x * x + y * y + z * z > limit * limit:
            return True
    return False


@kernel
def chord_on_manifold(space, a, b):
    """Whether |F| stays below space.chord on the straight motion between states on the manifold.

    |F| is largest in the middle, except near the kink of the rotation vector at angle pi: there it
    may have a peak anywhere, and the motion is checked in small steps.
    """
    spacing = 1.25e-3  # [rad] of these steps
    scratch = space.scratch
    if scratch.residual.shape[0] == 0:
        return True
    k, pieces = 1, 2
    while k < pieces:
        _place_between(space, a, b, k / pieces)
        violation = residual(
            space.regions,
            space.state,
            scratch.link_rotation,
            scratch.link_translation,
            scratch.residual,
            scratch.displacement,
        )
        if not violation <= space.chord * space.chord:  # nan of a function that fails
            return False
        k += 1
        if pieces == 2 and _near_half_turn(space):
            k, pieces = 1, max(3, int(np.ceil(distance(a, b) / spacing)))
    return True


@kernel
def _sweep(space, states, i):
    """Upper bound of the way of any point of the robot on segment i of a path [m]."""
    sweep = 0.0
    for j in range(states.shape[1]):
        sweep += abs(states[i + 1, j] - states[i, j]) * space.swing[j]
    return sweep


@kernel
def _moved_along(space, states, count, place, way):
    """Return the place after `way` metres of sweep, at the longest the end of the path.

    A place is the number of a segment and the fraction of it; way: negative is backwards.
    """
    i = min(int(place), count - 2)
    fraction = place - i
    while True:
        sweep = _sweep(space, states, i)
        left = (1.0 - fraction if way > 0.0 else fraction) * sweep
        if abs(way) <= left:
            return i + (fraction + way / sweep if sweep > 0.0 else fraction)
        if way > 0.0 and i == count - 2:
            return float(count - 1)
        if way <= 0.0 and i == 0:
            return 0.0
        way -= np.copysign(left, way)
        i += 1 if way > 0.0 else -1
        fraction = 0.0 if way > 0.0 else 1.0


@kernel
def _set_motion(space, states, count, begin, end):
    """Write the largest |dq_j| per metre of sweep between two places into space.motion."""
    space.motion[:] = 0.0
    for i in range(int(begin), min(int(end), count - 2) + 1):
        sweep = _sweep(space, states, i)
        for j in range(states.shape[1] if sweep > 0.0 else 0):
            change = abs(states[i + 1, j] - states[i, j]) / sweep
            space.motion[j] = max(space.motion[j], change)


@kernel(inline="source")
def _blocked_for_exact(space, states, count):
    """Return as `blocked_segment`, for the exact backend: states every space.resolution."""
    for i in range(count - 1):
        space.proven[0] = i
        pieces = 1
        while distance(states[i], states[i + 1]) > space.resolution * pieces:
            pieces *= 2
        for k in range(1, pieces + 1):
            _place_between(space, states[i], states[i + 1], k / pieces)
            if not posed_state_valid(space, space.state):
                return i
    space.proven[0] = count - 1
    return -1


@entry
def blocked_segment(space: Space, states: Annotated[np.ndarray, "count n"], count: int):
    """Return a segment of a path whose straight joint motion is not free of collision, or -1.

    One proof covers stretches of many segments. The robot at q, inside the stretch, has the
    distances d_b from obstacles (and pairs of bodies from each other). It is free on the whole
    stretch if no point of body b moves further than d_b on the way from q (Schwarzer, Saha and
    Latombe 2005; here with one distance for each body):

        d_b(q) > sum_j swing_bj |dq_j|

    Lengths on the path are measured by its sweep, sum_j swing_j |dq_j| with the largest swings of
    all bodies [m]. The check goes forward by what the last distances proved, twice as far as they
    reach. A stretch that is not proven is halved until its sweep is at most the margin that every
    free state keeps. The exact backend computes no distances: it checks states every
    space.resolution. Afterwards space.proven holds the number of segments, from the first one on,
    that are proven to be free.

    Args:
        space: the planning space.
        states: the path [rad or m]; the first state is not in collision.
        count: number of its states.
    """
    space = placed(space)
    finest = 5e-5  # [m] least way of a point between states that are checked
    longest = 0.4  # [m] largest sweep that is proven to both sides of a state
    beyond = 2.5  # asked distance over the distance to the proven part
    space.proven[0] = 0
    if count < 2:
        return -1
    if space.exact:
        return _blocked_for_exact(space, states, count)
    left = 0.0  # sweep of the path after place `done`, up to which it is proven [m]
    for i in range(count - 1):
        left += _sweep(space, states, i)
    if not left < np.inf:
        return 0
    shortest, half, done = max(space.margin, finest), 0.05, 0.0
    # a stretch further on that is already proven: remaining sweep at its two ends, and its end
    ahead_begin, ahead_left, ahead_done = -np.inf, 0.0, 0.0
    while True:
        half = min(half, left)
        place = _moved_along(space, states, count, done, half)
        wanted = min(beyond * half, longest)
        begin = _moved_along(space, states, count, place, -wanted)
        end = _moved_along(space, states, count, place, wanted)
        _set_motion(space, states, count, begin, end)
        i = min(int(place), count - 2)
        _place_between(space, states[i], states[i + 1], place - i)
        advance = _posed_advance(space, space.state, wanted)
        if advance == CONTACT:
            space.proven[0] = int(done)
            return i
        advance = max(advance, shortest)
        end = _moved_along(space, states, count, place, advance)
        if advance < half:
            # the stretch before it is still to be proven
            ahead_begin, ahead_left, ahead_done = left - half + advance, left - half - advance, end
            half = max(0.5 * (half - advance), shortest)
            continue
        left, done = left - half - advance, end
        if left <= ahead_begin:
            if ahead_left < left:
                left, done = ahead_left, ahead_done
            ahead_begin = -np.inf
        if left <= 0.0:
            space.proven[0] = count - 1
            return -1
        half = min(0.7 * advance, longest / beyond)


_proof = called_at_address(blocked_segment)


@kernel(inline="source")
def path_blocked(space, states, count):
    """Call `blocked_segment` at its address."""
    return _proof(space.proof, (space, states, count))


@entry
def motion_free(space: Space, a: Annotated[np.ndarray, "n"], b: Annotated[np.ndarray, "n"]):
    """Whether b and every state of the straight joint motion towards it are free of collision."""
    space = placed(space)
    for j in range(a.shape[0]):
        space.ends[0, j], space.ends[1, j] = a[j], b[j]
    return path_blocked(space, space.ends, 2) < 0


@kernel(inline="source")
def segment_valid(space, a, b):
    """Whether the straight joint motion between a and b stays close to the manifold and is free."""
    return chord_on_manifold(space, a, b) and motion_free(space, a, b)


@entry
def edge_verdicts(
    space: Space,
    nodes: Annotated[np.ndarray, "nodes n"],
    edges: Annotated[np.ndarray, "int32 edges 2"],
    node_free: Annotated[np.ndarray, "bool nodes"],
    edge_free: Annotated[np.ndarray, "bool edges"],
    most_checks: int,
):
    """Write whether the straight motions of edges are free of collision.

    Args:
        space: the planning space.
        nodes: configurations (k, n) [rad or m].
        edges: (e, 2), pairs of rows of nodes.
        node_free: (k,), whether nodes are free.
        edge_free: (e,), written; edges that are False before the call stay blocked.
        most_checks: upper bound of state checks.

    Returns:
        False if the check ended early because most_checks was reached.
    """
    space = placed(space)
    checks = space.counters[STATE_CHECKS] + most_checks
    for e in range(edges.shape[0]):
        if space.counters[STATE_CHECKS] > checks:
            return False
        a, b = edges[e, 0], edges[e, 1]
        edge_free[e] = (
            edge_free[e]
            and node_free[a]
            and node_free[b]
            and motion_free(space, nodes[a], nodes[b])
        )
    return True
