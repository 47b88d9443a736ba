"""Constraint `distance`."""

import numpy as np

from cvqmpt_lab.base.poses import pose
from cvqmpt_lab.base.values import Name
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    Span,
    TaskSpaceRegion,
    TaskSpaceRegionChain,
    Vector,
    symmetric_region,
)

EXAMPLE = {"bounds": [0.3, 0.5], "point": [0.6, 0.0, 0.2]}


def distance(
    bounds: Span, point: Vector = (0.0, 0.0, 0.0), base: Name | None = None
) -> TaskSpaceRegion:
    """Return the region where the end effector's origin has a distance from a point.

    Args:
        bounds: smallest and largest distance [m]; None as the largest: any.
        point: the point, in the world or in the frame `base` [m].
        base: frame of the robot that the point moves with; None: the world.
    """
    free = symmetric_region(pose(point), np.eye(4), [FREE] * 6)
    if base is None:
        return TaskSpaceRegion(free.T0_w, free.Tw_e, free.Bw, distance=bounds)
    return TaskSpaceRegionChain(free.T0_w, free.Tw_e, free.Bw, base=base, distance=bounds)
