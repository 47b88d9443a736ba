"""One-configuration kernels that are cheap to call from Python, for planners that call back per state.

Handing a Space of some sixty arrays to compiled code costs 10 us a call; a `BoundSpace` is one
pointer to it and costs 1 us.
"""

import numpy as np
from numba import types
from numba.experimental import structref

from cvqmpt_lab.kernels.compiling import driver
from cvqmpt_lab.kernels.kinematics import forward_kinematics
from cvqmpt_lab.kernels.space import Space, project_state, state_valid
from cvqmpt_lab.kernels.task_space_region import residual_and_jacobian


@structref.register
class _BoundSpaceType(types.StructRef):
    """Numba's type of a BoundSpace."""


class BoundSpace(structref.StructRefProxy):
    """A Space held by compiled code; make it with `bind`."""

    def __new__(cls, space: Space) -> "BoundSpace":
        """Hold a space."""
        return structref.StructRefProxy.__new__(cls, space)


structref.define_proxy(BoundSpace, _BoundSpaceType, ["space"])


@driver
def bind(space):
    """Hold a Space for repeated calls (compiled, so that the constructor is cached on disk)."""
    return BoundSpace(space)


@driver
def project_one(bound, q):
    """Project q (n,) in place; True on success."""
    return project_state(bound.space, q)


@driver
def valid_one(bound, q):
    """Whether q (n,) is free of collision."""
    return state_valid(bound.space, q)


@driver
def constraint_one(bound, q, full, residual, jacobian):
    """Write F(q) into residual (m,) and dF/dq into jacobian (m, n)."""
    space = bound.space
    forward_kinematics(space.kinematics, q, space.scratch.link_rotation, space.scratch.link_translation)
    residual_and_jacobian(
        space.kinematics,
        space.regions,
        space.scratch.link_rotation,
        space.scratch.link_translation,
        full,
        residual,
        jacobian,
    )


@driver
def within_limits(q, lower, upper):
    """Whether every entry of q (n,) lies in [lower, upper]."""
    return bool(np.all(q >= lower) and np.all(q <= upper))
