"""Constraint `plane`."""

import numpy as np

from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TaskSpaceRegion,
    Tolerance,
    Vector,
    frame_along,
    symmetric_region,
)

EXAMPLE = {"normal": [0, 0, 1], "point": [0.4, 0.0, 0.5], "tolerance": 0.01}


def plane(normal: Vector, point: Vector, tolerance: Tolerance = 0.0) -> TaskSpaceRegion:
    """Return the region where the end effector's origin stays in a plane; it turns freely.

    Args:
        normal: normal of the plane, of any length.
        point: a point of the plane [m].
        tolerance: to both sides [m].
    """
    bounds = [FREE, FREE, tolerance] + [FREE] * 3
    return symmetric_region(frame_along(point, normal), np.eye(4), bounds)
