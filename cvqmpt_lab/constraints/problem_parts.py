"""The parts of a planning problem that goals and planning spaces depend on.

`PlanningProblem` has them all. Code that depends on this file alone reads no problem files.
"""

from typing import Protocol

import numpy as np

from cvqmpt_lab.collision.geometry import RobotGeometry, SceneGeometry
from cvqmpt_lab.constraints.constraint import Constraint
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment, Scene


class StateChecker(Protocol):
    """An exact collision checker, such as `collision.exact.CollisionChecker`."""

    def in_collision(self, q: np.ndarray) -> bool:
        """Return whether configuration q (n,) touches anything."""


class WorldParts(Protocol):
    """What a planning space takes of `collision.world.World`."""

    @property
    def robot(self) -> Robot:
        """The robot."""

    @property
    def scene(self) -> Scene:
        """Obstacles."""

    @property
    def attachments(self) -> tuple[Attachment, ...]:
        """Bodies that the robot carries."""

    @property
    def robot_arrays(self) -> RobotGeometry:
        """Convex pieces of the robot and of what it carries."""

    @property
    def robot_swing(self) -> np.ndarray:
        """Bounds (n,) on |dx/dq_j| of any point x of the robot [m/rad of hinges, 1 of sliders]."""

    @property
    def scene_arrays(self) -> SceneGeometry:
        """Obstacles within reach, with their distance grid."""

    def checker(self, margin: float = 0.0) -> StateChecker:
        """Return the exact checker; distances below margin [m] are collisions."""


class ProblemParts(Protocol):
    """The parts of a planning problem that a planning space is made of."""

    @property
    def robot(self) -> Robot:
        """The robot."""

    @property
    def scene(self) -> Scene:
        """Obstacles."""

    @property
    def manifold(self) -> Constraint:
        """The constraint F(q) = 0."""

    @property
    def carried(self) -> tuple[Attachment, ...]:
        """Bodies that the robot carries, with the hands that really hold them."""

    @property
    def clearance(self) -> float:
        """Distance kept from obstacles [m]."""

    @property
    def start(self) -> np.ndarray:
        """Start configuration (n,) [rad or m]."""

    @property
    def goals(self) -> np.ndarray:
        """Goal configurations (k, n) [rad or m]."""
