"""The edge validity model: from a point cloud to P(straight motion is free), for any robot and what
it carries.

The cloud becomes a distance field. Along a motion, the smallest clearance of the robot's spheres is
read from it; a curve fitted to several arms (`edge_curve`) turns it into log odds. Nothing is
checked exactly.
"""

import numpy as np

from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.latest import Latest
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.vqmpt.clearances import EdgeArrays, fill_distances, motion_log_odds
from cvqmpt_lab.vqmpt.edge_curve import CLOUD, shipped_curve

CELL = 0.03  # [m] of the distance field
LOWER = np.array([-1.2, -1.2, -0.9])  # [m] corners of the field, around the training clouds' crop
UPPER = np.array([1.2, 1.2, 1.53])
SPACING = 0.3  # [rad] between the states of a motion whose clearances are read
CLOUDS = 4  # remembered


class EdgeModel:
    """The shipped curve for a robot and what its hand carries;
    remembers the latest clouds' distance fields.
    """

    def __init__(self, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> None:
        """Take the spheres of the robot's collision geometry."""
        geometry = robot_arrays(robot, attachments)
        rows = np.repeat(geometry.body_link, geometry.body_end - geometry.body_start)
        used = (geometry.leaf >= 0) & (rows > 0)
        self.robot = robot
        shape = tuple(np.ceil((UPPER - LOWER) / CELL).astype(int))
        nothing = np.zeros(shape, dtype=np.uint8)
        self.empty = _edge_arrays(robot.dof, nothing, geometry.sphere[used], rows[used])
        self._fields = Latest[EdgeArrays](CLOUDS)

    def arrays(self, cloud: np.ndarray, use_cache: bool = True) -> EdgeArrays:
        """The model with the distance field of a cloud (m, 3) [m, robot base frame], for kernels."""
        return self._fields.get(cloud.tobytes(), lambda: self._with_distances(cloud), use_cache)

    def _with_distances(self, cloud: np.ndarray) -> EdgeArrays:
        distance = np.empty_like(self.empty.distance)
        points = np.array(cloud, dtype=float, order="C")  # kernels take no read-only arrays
        span, square = np.empty((2, 3), np.int64), np.empty(distance.shape, np.float32)
        fill_distances(points, LOWER, CELL, span, square, distance)
        return self.empty._replace(distance=distance)

    def log_odds(self, cloud: np.ndarray, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Every joint's smallest clearance (b, n) [m] and log odds (b,) of straight motions (b, 2,
        n).
        """
        clearance, odds = np.empty((len(motions), self.robot.dof)), np.empty(len(motions))
        motion_log_odds(
            self.robot.kinematics,
            self.arrays(cloud),
            np.ascontiguousarray(motions),
            clearance,
            odds,
        )
        return clearance, odds


def _edge_arrays(n: int, distance: np.ndarray, sphere: np.ndarray, row: np.ndarray) -> EdgeArrays:
    return EdgeArrays(
        origin=LOWER,
        cell=CELL,
        distance=distance,
        sphere=np.ascontiguousarray(sphere),
        row=np.ascontiguousarray(row),
        spacing=SPACING,
        curve=shipped_curve(CLOUD),
        clearance=np.empty(n),
        state=np.empty(n),
        rotation=np.empty((n + 1, 3, 3)),
        translation=np.empty((n + 1, 3)),
    )
