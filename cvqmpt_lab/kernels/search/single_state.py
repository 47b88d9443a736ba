"""One-configuration kernels that are cheap to call from Python, for planners that call back per state.

Handing a Space of some sixty arrays to compiled code costs 10 us a call; a `BoundSpace` is one
pointer to it and costs 1 us.
"""

from numba import types
from numba.experimental import structref

from cvqmpt_lab.kernels.compiling import kernel
from cvqmpt_lab.kernels.manifold.kinematics import forward_kinematics
from cvqmpt_lab.kernels.manifold.regions import jacobian, residual
from cvqmpt_lab.kernels.search.space_arrays import Space, project_state, state_valid


@structref.register
class _BoundSpaceType(types.StructRef):
    """Numba's type of a BoundSpace."""


class BoundSpace(structref.StructRefProxy):
    """A Space held by compiled code; make it with `bind`."""

    def __new__(cls, space: Space) -> "BoundSpace":
        """Hold a space."""
        return structref.StructRefProxy.__new__(cls, space)


structref.define_proxy(BoundSpace, _BoundSpaceType, ["space"])


@kernel(allocates=True)
def bind(space):
    """Hold a Space for repeated calls (compiled, so that the constructor is cached on disk)."""
    return BoundSpace(space)


@kernel(allocates=True)
def project_one(bound, q):
    """Project q (n,) in place; True on success."""
    return project_state(bound.space, q)


@kernel(allocates=True)
def valid_one(bound, q):
    """Whether q (n,) is free of collision."""
    return state_valid(bound.space, q)


@kernel(allocates=True)
def constraint_one(bound, q, full, out_residual, out_jacobian):
    """Write F(q) into out_residual (m,) and dF/dq into out_jacobian (m, n)."""
    space, scratch = bound.space, bound.space.scratch
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
