"""Household objects of the tasks: the chips can that is carried, and two obstacles on the counter.

Each object has a link frame, in which its model file is written, and a centre of mass (COM), which
the published experiment code reports as the object's position. The shape's own frame is a third one,
in the middle of the cylinder or box. Objects stand upright, so a yaw is all the rotation they have.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class ObjectModel:
    """The collision shape of an object, and where shape and centre of mass lie in the link frame."""

    shape: Box | Cylinder
    """Centred on its own frame, parallel to the link frame."""
    shape_centre: Vector
    """Middle of the shape in the link frame [m]."""
    com: Vector
    """Centre of mass in the link frame [m]."""

    def at_com(self, name: str, position_com: Sequence[float], yaw: float = 0.0) -> SceneObject:
        """Return the object with its centre of mass at `position_com` (3,) [m], turned by `yaw` [rad]."""
        T_world_link = pose(position_com, yaw) @ pose(-np.array(self.com))
        return SceneObject(name, self.shape, T_world_link @ pose(self.shape_centre))


CAN = ObjectModel(
    shape=Cylinder(radius=0.0373, height=0.242),
    shape_centre=(-0.005, 0.012, 0.1265),
    com=(-0.005, 0.010, 0.100),
)
"""YcbChipsCan as scaled in the published experiment code."""

CRACKER_BOX = ObjectModel(
    shape=Box((0.0616, 0.1575, 0.2068)),
    shape_centre=(0.028, -0.011, -0.005),
    com=(0.030, -0.010, -0.020),
)
"""YcbCrackerBox."""

MUSTARD_BOTTLE = ObjectModel(
    shape=Box((0.0589, 0.0986, 0.1905)),
    shape_centre=(0.005, 0.005, 0.0125),
    com=(0.005, 0.005, -0.015),
)
"""YcbMustardBottle; the horizontal middle of its box is taken to be the centre of mass's."""
