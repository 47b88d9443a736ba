"""Constraint `on-sphere`."""

from cvqmpt_lab.base.values import Length
from cvqmpt_lab.constraints.by_name.distance import distance
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion, Tolerance, Vector

EXAMPLE = {"centre": [0.6, 0.0, 0.2], "radius": 0.3}


def on_sphere(centre: Vector, radius: Length, tolerance: Tolerance = 0.0) -> TaskSpaceRegion:
    """Return the region where the end effector's origin stays on a sphere; it turns freely.

    Args:
        centre: centre of the sphere [m].
        radius: radius of the sphere [m].
        tolerance: to both sides [m].
    """
    return distance((max(radius - tolerance, 0.0), radius + tolerance), centre)
