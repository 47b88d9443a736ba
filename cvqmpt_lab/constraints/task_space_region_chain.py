"""Task-space regions that hang on something the robot moves (TSR chains; Berenson et al. 2011)."""

from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.codec.forms import Name
from cvqmpt_lab.constraints.task_space_region import TaskSpaceRegion
from cvqmpt_lab.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class TaskSpaceRegionChain(TaskSpaceRegion):
    """Poses of the end effector e seen from a frame w that a link of the robot carries, within bounds.

    The chain goes from the world through the joints that move `base`, e.g. the hinge of a door, and
    through one region to the end effector. Those joints are joints of the robot (see
    `with_articulated_object`) and free within their limits.
    `T0_w` is the pose of w in the base frame, so that `sample_pose` gives poses in the base frame too.
    """

    base: Name
    """Name of a body frame of the robot, e.g. "dagger_door_left/handle_bar"."""

    def reference_link(self, robot: Robot) -> tuple[int, np.ndarray]:
        """Pose row that carries frame w, and T_link_w (4, 4); UnknownChoiceError when there is no such base."""
        row, T_link_base = robot.link_of(self.base)
        return row, T_link_base @ self.T0_w

    def reference_poses(self, robot: Robot, q: np.ndarray) -> np.ndarray:
        """T_world_w (k, 4, 4) at configurations q (k, n), by pinocchio."""
        return robot.poses(q, self.base) @ self.T0_w

    def at(self, T_world_base: np.ndarray) -> TaskSpaceRegion:
        """The region in the world while the base stands at a pose (4, 4)."""
        return TaskSpaceRegion(T_world_base @ self.T0_w, self.Tw_e, self.Bw)
