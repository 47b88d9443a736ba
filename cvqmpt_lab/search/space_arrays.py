"""The planning space as the kernels see it: one bundle of arrays, and the check of one state.

Collision is answered by the compiled checker, or, when `exact` is set, by a callback into Python
(coal): the planners above are the same compiled code with either.
"""

import ctypes
from collections.abc import Callable
from typing import Annotated, NamedTuple

import numpy as np

from cvqmpt_lab.collision.checker import FREE, first_contact
from cvqmpt_lab.collision.geometry import RobotGeometry, SceneGeometry
from cvqmpt_lab.constraints.project import ProjectionScratch, project
from cvqmpt_lab.constraints.regions import Regions, jacobian, residual
from cvqmpt_lab.jit import call_address, entry, kernel
from cvqmpt_lab.robot.kinematics import Kinematics, forward_kinematics

PROJECTIONS, NEWTON_ITERATIONS, STATE_CHECKS, ITERATIONS = range(4)  # rows of Space.counters
DOUBT = 0.2  # [rad] around a doubtful configuration


class StateCheck:
    """A Python function ``valid(q) -> bool`` that compiled code calls by address, on the shared array `query`.

    An exception inside it cannot cross compiled code: it is kept, the state counts as invalid, and
    `reraise` throws it once the kernel has returned. The object must outlive its use.
    """

    def __init__(self, valid: Callable[[np.ndarray], bool] | None, query: np.ndarray) -> None:
        self.error: BaseException | None = None

        def call() -> bool:
            if valid is None or self.error is not None:
                return False
            try:
                return bool(valid(query))
            except BaseException as error:
                self.error = error
                return False

        self._callback = ctypes.CFUNCTYPE(ctypes.c_bool)(call)
        self.address: int = ctypes.cast(self._callback, ctypes.c_void_p).value or 0

    def reraise(self) -> None:
        """Throw what the function threw, if it did."""
        if self.error is not None:
            error, self.error = self.error, None
            raise error


class Space(NamedTuple):
    """Everything a planning kernel needs."""

    kinematics: Kinematics  # of the robot
    regions: Regions  # the constraint
    robot: RobotGeometry  # convex pieces
    scene: SceneGeometry  # obstacles
    tolerance: float  # of |F| after projection [m, rad]
    max_iterations: int  # newton steps per projection
    step: float  # longest motion between neighbouring states [rad]
    resolution: float  # spacing of the exact backend's final check of a motion [rad]
    margin: float  # kept from obstacles [m]
    exact: bool  # whether states are checked through the callback
    check: int
    """Address of the callback. (As an object, numba would take half a millisecond a call to find its type.)"""
    query: Annotated[np.ndarray, "n"]  # through which the callback is asked
    doubtful: Annotated[np.ndarray, "doubtful n"]
    """Configurations that the compiled checker blocks but the meshes allow: near them, a state that it
    calls colliding is asked for again through the callback.
    """
    swing: Annotated[np.ndarray, "n"]
    """No point of the robot moves further than swing[j] * |dq[j]| when joint j does [m/rad]."""
    counters: Annotated[np.ndarray, "int64 4"]
    """Rows PROJECTIONS, NEWTON_ITERATIONS, STATE_CHECKS, ITERATIONS."""
    state: Annotated[np.ndarray, "n"]  # work array
    scratch: ProjectionScratch  # work arrays of projections


@kernel(inline="source")
def project_state(space, q):
    """Project q (n,) in place and count it; True on success, with link poses ready in the scratch."""
    iterations = project(
        space.kinematics, space.regions, q, space.tolerance, space.max_iterations, space.scratch
    )
    if space.scratch.residual.shape[0] > 0:
        space.counters[PROJECTIONS] += 1
        space.counters[NEWTON_ITERATIONS] += iterations if iterations >= 0 else -1 - iterations
    return iterations >= 0


@kernel(inline="source")
def _near_doubtful(space, q):
    """Whether q (n,) lies within DOUBT of a doubtful configuration."""
    for i in range(space.doubtful.shape[0]):
        square = 0.0
        for j in range(q.shape[0]):
            square += (q[j] - space.doubtful[i, j]) * (q[j] - space.doubtful[i, j])
        if square < DOUBT * DOUBT:
            return True
    return False


@kernel(inline="source")
def posed_state_valid(space, q, clearance):
    """Whether q, whose link poses are in the scratch, keeps space.margin + clearance [m] (exact: the margin)."""
    space.counters[STATE_CHECKS] += 1
    if not space.exact:
        geometry, _ = first_contact(
            space.scratch.link_rotation,
            space.scratch.link_translation,
            space.robot,
            space.scene,
            space.margin + clearance,
        )
        if geometry == FREE or clearance > 0.0 or not _near_doubtful(space, q):
            return geometry == FREE
    for j in range(q.shape[0]):
        space.query[j] = q[j]
    return call_address(space.check)


@kernel(inline="source")
def state_valid(space, q):
    """Whether q (n,) is free of collision."""
    forward_kinematics(space.kinematics, q, space.scratch.link_rotation, space.scratch.link_translation)
    return posed_state_valid(space, q, 0.0)


@entry
def states_valid(
    space: Space, configurations: Annotated[np.ndarray, "count n"], out: Annotated[np.ndarray, "bool count"]
):
    """Write whether each configuration (b, n) is free of collision into out (b,) bool."""
    for i in range(configurations.shape[0]):
        out[i] = state_valid(space, configurations[i])


@entry
def project_one(space: Space, q: Annotated[np.ndarray, "n"]):
    """Project q (n,) in place; True on success."""
    return project_state(space, q)


@entry
def valid_one(space: Space, q: Annotated[np.ndarray, "n"]):
    """Whether q (n,) is free of collision."""
    return state_valid(space, q)


@entry
def constraint_one(
    space: Space,
    q: Annotated[np.ndarray, "n"],
    full: bool,
    out_residual: Annotated[np.ndarray, "m"],
    out_jacobian: Annotated[np.ndarray, "m n"],
):
    """Write F(q) into out_residual (m,) and dF/dq into out_jacobian (m, n)."""
    scratch = space.scratch
    rotation, translation = scratch.link_rotation, scratch.link_translation
    forward_kinematics(space.kinematics, q, rotation, translation)
    residual(space.regions, rotation, translation, out_residual, scratch.displacement)
    jacobian(
        space.kinematics,
        space.regions,
        rotation,
        translation,
        scratch.displacement,
        full,
        out_residual,
        out_jacobian,
    )
