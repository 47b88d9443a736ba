"""Task-space regions that hang on something the robot moves (TSR chains; Berenson et al. 2011)."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class TaskSpaceRegionChain(TaskSpaceRegion):
    """Poses of the end effector e seen from a frame w that a link of the robot carries, within bounds.

    The chain goes from the world through the joints that move `base`, e.g. the hinge of a door, and
    through one region to the end effector. Those joints are joints of the robot (see
    `with_articulated_object`) and free within their limits.

    Attributes
    ----------
    T0_w: (4, 4), pose of w in the base frame, so that `sample_pose` gives poses in the base frame too.
    Tw_e, Bw: as in `TaskSpaceRegion`.
    base: name of a body frame of the robot, e.g. "dagger_door_left/handle_bar".
    """

    base: str

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.base, str) or not self.base:
            raise InvalidInputError(
                f"task-space region field 'base' must name a frame of the robot, not {self.base!r}"
            )

    def reference_link(self, robot: Robot) -> tuple[int, np.ndarray]:
        """Pose row that carries frame w, and T_link_w (4, 4); UnknownChoiceError when there is no such base."""
        row, T_link_base = robot.link_of(self.base)
        return row, T_link_base @ self.T0_w

    def reference_pose(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """T_world_w (4, 4) at configuration q (n,), by pinocchio."""
        return robot.pose(q, self.base) @ self.T0_w

    def at(self, T_world_base: np.ndarray) -> TaskSpaceRegion:
        """The region in the world while the base stands at a pose (4, 4)."""
        return TaskSpaceRegion(T_world_base @ self.T0_w, self.Tw_e, self.Bw)

    def to_dict(self) -> dict:
        """Plain json form; infinite bounds become null."""
        return {**super().to_dict(), "base": self.base}

    @staticmethod
    def from_dict(data: dict) -> "TaskSpaceRegionChain":
        """Inverse of to_dict; names the missing or malformed field."""
        region = TaskSpaceRegion.from_dict(data)
        if "base" not in data:
            raise InvalidInputError("task-space region field 'base' is missing")
        return TaskSpaceRegionChain(region.T0_w, region.Tw_e, region.Bw, data["base"])


def region_from_dict(data: dict) -> TaskSpaceRegion:
    """A region, or a chain when a base is named."""
    return TaskSpaceRegionChain.from_dict(data) if "base" in data else TaskSpaceRegion.from_dict(data)
