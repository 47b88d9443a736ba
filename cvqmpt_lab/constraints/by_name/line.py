"""Constraint `line`."""

import numpy as np

from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TaskSpaceRegion,
    Tolerance,
    Vector,
    frame_along,
    symmetric_region,
)

EXAMPLE = {"direction": [0, 1, 0], "point": [0.4, 0.0, 0.5], "tolerance": 0.01}


def line(direction: Vector, point: Vector, tolerance: Tolerance = 0.0) -> TaskSpaceRegion:
    """Return the region where the end effector's origin stays on a line; it turns freely.

    Args:
        direction: direction of the line, of any length.
        point: a point of the line [m].
        tolerance: across the line, in each of two directions [m].
    """
    bounds = [tolerance, tolerance, FREE] + [FREE] * 3
    return symmetric_region(frame_along(point, direction), np.eye(4), bounds)
