"""Constraint `pose`."""

from cvqmpt_lab.base import poses
from cvqmpt_lab.base.poses import Pose
from cvqmpt_lab.base.values import Angle
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    TaskSpaceRegion,
    Tolerance,
    symmetric_region,
)

EXAMPLE = {"at": {"xyz": [0.4, 0.0, 0.5], "rpy": [3.14, 0.0, 0.0]}}


def pose(
    at: Pose, position: Tolerance = 0.0, tilt: Angle = 0.0, yaw: Angle = 0.0
) -> TaskSpaceRegion:
    """Return the region of poses of the end effector at a pose, or close to it.

    Args:
        at: its pose in the world (4, 4).
        position: tolerance of x, y and z [m].
        tilt: largest angle by which a line of the hand that is vertical there may lean [rad].
        yaw: tolerance about the world's vertical [rad]; 3.15 leaves it free.
    """
    turned = at.copy()
    turned[:3, 3] = 0.0
    bounds = [position] * 3 + [FREE] * 2 + [yaw]
    return symmetric_region(poses.pose(at[:3, 3]), turned, bounds, tilt)
