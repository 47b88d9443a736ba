"""A robot with what it carries among obstacles: its arrays for compiled code, its exact checker.

A planning run makes one and hands it to goals, planning space and certificate.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from cvqmpt_lab.collision import arrays
from cvqmpt_lab.collision.carried import reach_with
from cvqmpt_lab.collision.exact import CheckedParts, CollisionChecker, shared_checker
from cvqmpt_lab.collision.geometry import RobotGeometry, SceneGeometry
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene


@dataclass(frozen=True, eq=False)
class World:
    """A robot, what it carries, and obstacles; arrays are made when they are first used."""

    robot: Robot
    scene: Scene
    attachments: tuple[Attachment, ...] = ()  # what the hands carry
    clearance: float = 0.0  # kept from obstacles [m]

    @classmethod
    def of(cls, problem: CheckedParts) -> Self:
        """Return the world of a planning problem."""
        return cls(problem.robot, problem.scene, problem.carried, problem.clearance)

    @cached_property
    def robot_arrays(self) -> RobotGeometry:
        """Convex pieces of the robot and of what it carries."""
        return arrays.robot_arrays(self.robot, self.attachments)

    @cached_property
    def robot_swing(self) -> np.ndarray:
        """Bounds (n,) on |dx/dq_j| of any point x of the robot [m/rad of hinges, 1 of sliders]."""
        return arrays.robot_swing(self.robot, self.attachments)

    @cached_property
    def scene_arrays(self) -> SceneGeometry:
        """Obstacles within reach, inflated by the clearance, with their distance grid."""
        reach = reach_with(self.robot, self.attachments)
        return arrays.scene_arrays(self.scene, reach, self.clearance)

    def checker(self, margin: float = 0.0) -> CollisionChecker:
        """Return this thread's exact checker; distances below margin [m] are collisions."""
        return shared_checker(self.robot, self.scene, self.attachments, margin, self.clearance)
