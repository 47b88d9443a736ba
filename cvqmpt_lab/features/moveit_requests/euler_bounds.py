"""Bounds on the Euler angles of a link's rotation, MoveIt's default form of an orientation."""

from typing import NamedTuple

import numpy as np

from cvqmpt_lab.robot.joint_frames import poses_at_once
from cvqmpt_lab.robot.robot import Robot


class EulerBounds(NamedTuple):
    """Bounds on the Euler angles of a link's rotation from a desired one.

    R_desired^T R_link = R_x(a) R_y(b) R_z(c).
    """

    link: str
    R: np.ndarray  # (3, 3), the desired rotation of the link in the world
    most: np.ndarray  # (3,), largest |a|, |b|, |c| [rad]

    def excess(self, robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the excess (k,) of the angles over their bounds at q (k, n) [rad].

        And bounds (k - 1,) on it along the straight motions between these. Along a motion with
        turns D = sum_j |dq_j|, an Euler angle changes by at most D / |cos b|, and is at most
        D / 2 / |cos b| above the larger one of its ends.
        """
        turned = self.R.T @ poses_at_once(robot, q, self.link)[:, :3, :3]
        sine = turned[:, 0, 2].clip(-1.0, 1.0)
        a = np.arctan2(-turned[:, 1, 2], turned[:, 2, 2])
        c = np.arctan2(-turned[:, 0, 1], turned[:, 0, 0])
        angles = np.abs(np.stack([a, np.arcsin(sine), c], axis=1))
        over, cosine = (angles - self.most).max(axis=1), np.sqrt(1.0 - sine**2)
        D = np.abs(np.diff(robot.kinematics.joint_values(q), axis=0)).sum(axis=1)
        least = np.maximum(np.minimum(cosine[1:], cosine[:-1]) - D, 1e-9)
        return over, np.maximum(over[1:], over[:-1]) + 0.5 * D / least
