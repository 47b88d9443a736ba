"""Household objects of the tasks: collision shape and centre of mass."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.poses import pose
from cvqmpt_lab.scene.scene import SceneObject
from cvqmpt_lab.scene.shapes import Box, Cylinder


@dataclass(frozen=True)
class ObjectModel:
    """The collision shape of an object, and poses of shape and centre of mass in the link frame."""

    shape: Box | Cylinder  # centred on its own frame, parallel to the link frame
    shape_centre: tuple[float, float, float]  # middle of the shape in the link frame [m]
    com: tuple[float, float, float]  # centre of mass in the link frame [m]
    mass: float  # [kg]

    def at_com(self, name: str, position_com: Sequence[float], yaw: float = 0.0) -> SceneObject:
        """Return the object with centre of mass at `position_com` (3,) [m] and a `yaw` [rad]."""
        T_world_link = pose(position_com, yaw) @ pose(-np.array(self.com))
        T_world_object = T_world_link @ pose(self.shape_centre)
        return SceneObject(name, self.shape, T_world_object, mass=self.mass)


# Masses of box and bottle: YCB Object and Model Set, Calli et al. 2015, table III.
# YcbChipsCan as scaled in the published experiment code; the mass of a full drinks can.
CAN = ObjectModel(
    Cylinder(0.0373, 0.242),
    shape_centre=(-0.005, 0.012, 0.1265),
    com=(-0.005, 0.010, 0.100),
    mass=0.35,
)
# YcbCrackerBox.
CRACKER_BOX = ObjectModel(
    Box((0.0616, 0.1575, 0.2068)), (0.028, -0.011, -0.005), com=(0.030, -0.010, -0.020), mass=0.411
)
# YcbMustardBottle; the horizontal middle of its box is taken to be the centre of mass's.
MUSTARD_BOTTLE = ObjectModel(
    Box((0.0589, 0.0986, 0.1905)), (0.005, 0.005, 0.0125), (0.005, 0.005, -0.015), mass=0.603
)
