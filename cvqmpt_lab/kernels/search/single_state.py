"""Kernels of one configuration, for planners that call back per state."""

from typing import Annotated

import numpy as np

from cvqmpt_lab.constraints.regions import jacobian, residual
from cvqmpt_lab.jit import entry
from cvqmpt_lab.kernels.search.space_arrays import Space, project_state, state_valid
from cvqmpt_lab.robot.kinematics import forward_kinematics


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
