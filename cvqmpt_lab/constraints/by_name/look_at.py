"""Constraint `look-at`."""

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.base.values import Angle
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    Axis,
    Span,
    TaskSpaceRegion,
    Vector,
    axis_vector,
    frame_along,
    symmetric_region,
)

EXAMPLE = {"point": [0.6, 0.0, 0.2], "angle": 0.1}


def look_at(
    point: Vector, angle: Angle = 0.1, axis: Axis = "z", distance: Span | None = None
) -> TaskSpaceRegion:
    """Return the region where an axis of the end effector, or of a camera, passes a point.

    Args:
        point: the point in the world [m].
        angle: largest angle between the axis and the line to the point [rad].
        axis: axis along which the end effector looks.
        distance: smallest and largest distance of the point from its origin [m]; None: any.
    """
    ahead = frame_along((0.0, 0.0, 0.0), axis_vector(axis))  # turned, so that z is the axis
    free = symmetric_region(pose(point), ahead.T, [FREE] * 6)
    return TaskSpaceRegion(free.T0_w, free.Tw_e, free.Bw, bearing=angle, distance=distance)
