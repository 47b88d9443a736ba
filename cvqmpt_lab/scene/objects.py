"""Household objects of the tasks: the chips can that is carried, and two obstacles on the counter.

Each object has a link frame, in which its model file is written, and a centre of mass (COM), which
the published experiment code reports as the object's position. The shape's own frame is a third one,
in the middle of the cylinder or box. Objects stand upright, so a yaw is all the rotation they have.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.scene import SceneObject, pose
from cvqmpt_lab.scene.shapes import Box, Cylinder, FloatArray

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class ObjectModel:
    """The collision shape of an object, and where shape and centre of mass lie in the link frame.

    Attributes
    ----------
    shape : Box or Cylinder
        Collision shape, centred on its own frame, parallel to the link frame.
    shape_centre : (3,) tuple of float
        Middle of the shape in the link frame [m].
    com : (3,) tuple of float
        Centre of mass in the link frame [m].
    """

    shape: Box | Cylinder
    shape_centre: Vector
    com: Vector

    def at_link(
        self, name: str, position_link: Sequence[float], yaw: float = 0.0, obstacle: bool = True
    ) -> SceneObject:
        """Return the object with its link frame at `position_link` (3,) [m], turned by `yaw` [rad]."""
        T_world_link = pose(_position(position_link, name), yaw)
        return SceneObject(name, self.shape, T_world_link @ pose(self.shape_centre), obstacle)

    def at_com(
        self, name: str, position_com: Sequence[float], yaw: float = 0.0, obstacle: bool = True
    ) -> SceneObject:
        """Return the object with its centre of mass at `position_com` (3,) [m], turned by `yaw` [rad]."""
        T_world_link = pose(_position(position_com, name), yaw) @ pose(-np.array(self.com))
        return SceneObject(name, self.shape, T_world_link @ pose(self.shape_centre), obstacle)

    def com_of(self, item: SceneObject) -> FloatArray:
        """Return the world position (3,) [m] of the centre of mass of an object made from this model."""
        return (item.T_world_object @ pose(np.subtract(self.com, self.shape_centre)))[:3, 3]


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


def can(name: str, position_com: Sequence[float], yaw: float = 0.0, obstacle: bool = True) -> SceneObject:
    """Return the chips can, a cylinder, with its centre of mass at `position_com` (3,) [m].

    The published place task makes it visible only (`obstacle=False`).
    """
    return CAN.at_com(name, position_com, yaw, obstacle)


def cracker_box(
    name: str, position_com: Sequence[float], yaw: float = 0.0, obstacle: bool = True
) -> SceneObject:
    """Return the cracker box with its centre of mass at `position_com` (3,) [m], turned by `yaw` [rad]."""
    return CRACKER_BOX.at_com(name, position_com, yaw, obstacle)


def mustard_bottle(
    name: str, position_com: Sequence[float], yaw: float = 0.0, obstacle: bool = True
) -> SceneObject:
    """Return the mustard bottle, a box, with its centre of mass at `position_com` (3,) [m]."""
    return MUSTARD_BOTTLE.at_com(name, position_com, yaw, obstacle)


def _position(values: Sequence[float], name: str) -> FloatArray:
    """Return `values` as a (3,) array; raise `InvalidInputError` if they are no finite position."""
    position = np.asarray(values, dtype=np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise InvalidInputError(f"position of {name!r} must be three finite numbers [m], got {values!r}")
    return position
