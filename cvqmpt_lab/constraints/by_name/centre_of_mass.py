"""Constraint `centre-of-mass`."""

from typing import Annotated, Any

from cvqmpt_lab.base.values import Array, FloatArray
from cvqmpt_lab.constraints.task_space_region import Tolerance

EXAMPLE = {"corners": [[0.1, 0.1], [-0.1, 0.1], [0.0, -0.1]]}


def centre_of_mass(
    corners: Annotated[FloatArray, Array((None, 2), "corners [x, y] of a polygon [m]")],
    margin: Tolerance = 0.0,
) -> Any:
    """Return the constraint that the robot's centre of mass, with its load, is above a polygon.

    Args:
        corners: corners (k, 2) of a convex polygon in order, x and y in the world [m].
        margin: distance that it keeps from the edges [m].
    """
    from cvqmpt_lab.constraints.centre_of_mass import CentreOfMass  # few problems have one

    return CentreOfMass(corners, margin)
