"""Constraint `fixed-orientation`."""

import numpy as np

from cvqmpt_lab.base.poses import Placement
from cvqmpt_lab.base.values import Angle
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    Quaternion,
    TaskSpaceRegion,
    Vector,
    symmetric_region,
)

EXAMPLE = 0.1


def fixed_orientation(
    tolerance: Angle, rpy: Vector | None = None, quaternion: Quaternion | None = None
) -> TaskSpaceRegion:
    """Return the region of a fixed orientation of the end effector; its position is free.

    Args:
        tolerance: bound on each entry of the rotation vector from that orientation [rad].
        rpy: roll, pitch, yaw about the world's x, y, z [rad].
        quaternion: the same as x, y, z, w.
    """
    there = Placement(rpy=rpy, quaternion=quaternion).matrix
    return symmetric_region(there, np.eye(4), [FREE] * 3 + [tolerance] * 3)
