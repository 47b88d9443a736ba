"""The centre of mass of a robot and what it carries, by numpy from pinocchio's model."""

from collections.abc import Iterable

import numpy as np

from cvqmpt_lab.robot.dynamics import Load, loaded_model
from cvqmpt_lab.robot.joint_frames import joint_frames
from cvqmpt_lab.robot.robot import Robot


class BodyMasses:
    """Masses of a robot with its load; c = sum of m_b p_b is their centre.

    Attributes:
        shares: m (p,), share of the mass of all bodies that each pose row carries.
        centres: its centre (p, 3) in pinocchio's frame of the row [m].
    """

    def __init__(self, robot: Robot, loads: Iterable[Load] = ()) -> None:
        bodies = list(loaded_model(robot, loads).inertias)
        masses = np.array([body.mass for body in bodies])
        self.robot, self.shares = robot, masses / masses.sum()
        self.centres = np.array([body.lever for body in bodies])

    def centre(self, q: np.ndarray) -> np.ndarray:
        """Return c (b, 3) in the world at q (b, n) [m]."""
        return self._bodies(q)[1].sum(axis=0)

    def centre_rates(self, q: np.ndarray) -> np.ndarray:
        """Return dc/dq (b, 3, n) at q (b, n)."""
        poses, weighted = self._bodies(q)
        k = self.robot.kinematics
        axes, frames = joint_frames(self.robot).axes(poses), poses[1:, :, :3, 3]
        above = np.einsum("jp,pbi->jbi", k.moves, weighted)
        share = (k.moves @ self.shares)[:, None, None]
        turning = np.cross(axes, above - share * frames)
        rates = np.where(k.prismatic[:, None, None], share * axes, turning)
        return k.summed(rates.transpose(1, 2, 0) * k.multiplier)

    def centre_bend(self, states: np.ndarray) -> np.ndarray:
        """Return bounds (k - 1,) of |c''|, 0 <= s <= 1, on motions between states (k, n) [m].

        The bodies above joint j, of masses m_b, are at most l_jb away from it. With a hinge i below
        it, |d2c / dq_i dq_j| <= w_j = sum of m_b l_jb, of a slider j the sum of m_b. So |c''| is at
        most the sum over j of w_j |dq_j| times |dq_j| for a hinge, and 2 |dq_i| for each i.
        """
        k, far = self.robot.kinematics, self.robot.farthest
        away = far - far[1:, None] + np.linalg.norm(self.centres, axis=1)
        weights = (k.moves * np.where(k.prismatic[:, None], 1.0, away) * self.shares).sum(axis=1)
        change = np.abs(np.diff(k.joint_values(states), axis=0))
        turns = np.where(k.prismatic, 0.0, change)
        below = turns @ k.moves[:, 1:]  # of joint j itself and those below it
        return (weights * change * (2.0 * below - turns)).sum(axis=1)

    def _bodies(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return poses (p, b, 4, 4) of pinocchio's frames, and m_b p_b (p, b, 3), at q (b, n)."""
        poses = joint_frames(self.robot).poses(self.robot.kinematics.joint_values(q))
        m, local = self.shares, np.column_stack([self.centres, np.ones(len(self.shares))])
        return poses, m[:, None, None] * np.einsum("pbij,pj->pbi", poses, local)[..., :3]
