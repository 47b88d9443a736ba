"""Speeds of frames of a robot, such as its tool, and their limits.

A frame on a link moves, and turns, with the joints j below it, which turn about z_j through o_j or
slide along z_j:

    v = sum_j z_j x (p - o_j) dq_j + sum_slides z_j dq_j,    w = sum_j z_j dq_j.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cvqmpt_lab.base.codec import to_plain
from cvqmpt_lab.robot.joint_frames import joint_frames
from cvqmpt_lab.robot.robot import FrameLimit, Robot


def with_frame_limits(robot: Robot, limits: Mapping[str, FrameLimit]) -> Robot:
    """Return a robot with limits of its frames by name, in its source as well."""
    stated = {name: to_plain(limit) for name, limit in limits.items()}
    return replace(robot, frame_limits=limits, source={**robot.source, "frame_limits": stated})


class FrameSpeeds:
    """Speeds of the limited frames of a robot, in the order of `limits`."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        # name, whether the limit is that of turning, and the limit [m/s or rad/s]
        self.limits = [
            (name, turning, value)
            for name, limit in robot.frame_limits.items()
            for turning, value in ((False, limit.speed), (True, limit.turning_speed))
            if value is not None
        ]

    def speeds(self, q: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the speeds (k, f) [m/s or rad/s] at q (k, n) with rates dq (k, n)."""
        robot, frames = self._robot, joint_frames(self._robot)
        poses = frames.poses(robot.kinematics.joint_values(q))
        axes = frames.axes(poses)
        turned = robot.kinematics.joint_changes(rates).T[..., None] * axes  # (joints, k, 3)
        hinge = frames.hinges[:, None, None]
        found = np.empty((len(q), len(self.limits)))
        for k, (name, turning, _) in enumerate(self.limits):
            placed = robot.model.frames[robot.frame_id(name)]
            below = np.array(robot.model.supports[placed.parentJoint])[1:] - 1
            parts = np.where(hinge, turned, 0.0)[below]
            if not turning:
                p = (poses[placed.parentJoint] @ placed.placement.homogeneous)[:, :3, 3]
                parts = np.cross(parts, p - poses[1:, :, :3, 3][below])
                parts += np.where(hinge, 0.0, turned)[below]
            found[:, k] = np.linalg.norm(parts.sum(axis=0), axis=1)
        return found

    def shares(self, q: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the largest share (k,) of a limit that is used, as `speeds`; 0 without limits."""
        if not self.limits:
            return np.zeros(len(q))
        return (self.speeds(q, rates) / [limit for _, _, limit in self.limits]).max(axis=1)

    def bend(self, rates: np.ndarray) -> np.ndarray:
        """Bound the second derivatives (k, f) of velocities v and w over time.

        With D1, D2, D3 the sums over joints of bounds on |dq|, |d2q| and |d3q|, and L the largest
        distance of a frame from the axis of a joint below it (1 at least, for sliders):

            |d2v/dt2| <= L (D3 + 3 D1 D2 + D1^3),    |d2w/dt2| <= D3 + 3 D1 D2 + D1^3.

        rates: bounds (3, k, n) on the first three derivatives of q.
        """
        robot = self._robot
        D1, D2, D3 = np.abs(robot.kinematics.joint_changes(rates)).sum(axis=2)
        most = D3 + 3.0 * D1 * D2 + D1**3
        levers = []
        for name, turning, _ in self.limits:
            row, T = robot.link_of(name)
            extent = np.full(len(robot.kinematics.parent) + 1, -np.inf)
            extent[row] = np.linalg.norm(T[:3, 3])
            multiplier = np.abs(robot.kinematics.multiplier)
            lever = robot.joint_speeds_from(extent) / np.where(multiplier > 0.0, multiplier, 1.0)
            levers.append(1.0 if turning else max(1.0, float(lever.max())))
        return most[:, None] * levers
