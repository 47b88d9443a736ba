"""Objects that the hand carries."""

from dataclasses import dataclass

from cvqmpt_lab.codec.forms import Name
from cvqmpt_lab.codec.plain import Checked
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.poses import Pose
from cvqmpt_lab.scene.shapes import OccupancyMap, Shape


@dataclass(frozen=True, eq=False)
class Attachment(Checked):
    """A shape fixed to the robot's end effector."""

    name: Name
    """Unique among what the hand carries."""
    shape: Shape
    """The geometry, in the object frame."""
    T_hand_object: Pose
    """(4, 4), pose of the shape in the end-effector frame [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.shape, OccupancyMap):
            raise InvalidInputError(
                f"attachment {self.name!r} is an occupancy map; what is carried is a solid or a point cloud"
            )
