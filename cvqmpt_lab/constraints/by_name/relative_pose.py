"""Constraint `relative-pose`."""

import numpy as np

from cvqmpt_lab.base.poses import Pose
from cvqmpt_lab.base.values import Angle, Name, frozen
from cvqmpt_lab.constraints.task_space_region import (
    FREE,
    Axis,
    TaskSpaceRegionChain,
    Tolerance,
    axis_vector,
    frame_along,
)

EXAMPLE = {"base": "HAND", "at": {"xyz": [0.0, 0.4, 0.0]}}


def relative_pose(
    base: Name,
    at: Pose,
    position: Tolerance = 0.0,
    rotation: Angle = 0.0,
    about: Axis | None = None,
) -> TaskSpaceRegionChain:
    """Return the region of poses of the end effector in the frame of another one.

    Both then hold one body, as a closed chain.

    Args:
        base: the other end effector, or another frame of the robot.
        at: the pose in its frame (4, 4).
        position: tolerance of x, y and z [m].
        rotation: largest entry of the rotation vector, or angle of the axis `about` [rad].
        about: axis of the end effector about which it turns freely.
    """
    turned, bounds, tilt = np.eye(4), [position] * 3 + [rotation] * 3, None
    if about is not None:
        # w and e turned, so that z is the axis
        turned, bounds, tilt = (
            frame_along((0.0, 0.0, 0.0), axis_vector(about)),
            bounds[:3],
            rotation,
        )
        bounds += [FREE] * 3
    Bw = frozen(np.array([[-bound, bound] for bound in bounds]))
    return TaskSpaceRegionChain(at @ turned, turned.T, Bw, tilt=tilt, base=base)
