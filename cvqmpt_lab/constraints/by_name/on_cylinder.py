"""Constraint `on-cylinder`."""

import numpy as np

from cvqmpt_lab.base.values import Length
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TaskSpaceRegion,
    Tolerance,
    Vector,
    frame_along,
    symmetric_region,
)

EXAMPLE = {"direction": [0, 0, 1], "point": [0.6, 0.0, 0.2], "radius": 0.3}


def on_cylinder(
    direction: Vector, point: Vector, radius: Length, tolerance: Tolerance = 0.0
) -> TaskSpaceRegion:
    """Return the region where the end effector's origin stays on a cylinder; it turns freely.

    Args:
        direction: direction of the cylinder's axis, of any length.
        point: a point of the axis [m].
        radius: radius of the cylinder [m].
        tolerance: to both sides [m].
    """
    free = symmetric_region(frame_along(point, direction), np.eye(4), [FREE] * 6)
    bounds = (max(radius - tolerance, 0.0), radius + tolerance)
    return TaskSpaceRegion(free.T0_w, free.Tw_e, free.Bw, radius=bounds)
