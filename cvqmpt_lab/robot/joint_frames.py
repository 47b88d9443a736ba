"""Poses of a robot's joint frames at many configurations at once, by numpy.

The certificate uses them: they share no code with the planners' compiled kinematics.
"""

from functools import lru_cache

import numpy as np
import pinocchio as pin

from cvqmpt_lab.base.values import frozen
from cvqmpt_lab.robot.robot import Robot


class JointFrames:
    """Forward kinematics of a pinocchio model of hinges and sliders.

    Frames are pinocchio's: frame 0 is the world, frame j + 1 belongs to joint j.
    """

    def __init__(self, model: pin.Model) -> None:
        data = model.createData()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        hinges = np.zeros(model.nv, dtype=bool)
        axes = np.zeros((model.nv, 3))  # in the joints' own frames
        self._parents = [int(parent) for parent in model.parents]
        # Pose in the parent's frame at value v: a + sin(v) b + (1 - cos(v)) c of a hinge, with
        # Rodrigues' formula; a + v b of a slider
        terms = np.zeros((model.nv, 3, 4, 4))
        for j in range(model.nv):
            local = pin.getJointJacobian(model, data, j + 1, pin.ReferenceFrame.LOCAL)
            motion = local.reshape(6, -1)[:, j]  # (6,) of a single joint
            hinges[j] = np.linalg.norm(motion[3:]) > 0.5
            axes[j] = axis = motion[3:] if hinges[j] else motion[:3]
            placed = model.jointPlacements[j + 1]
            terms[j, 0] = placed.homogeneous
            if hinges[j]:
                terms[j, 1, :3, :3] = placed.rotation @ pin.skew(axis)
                terms[j, 2, :3, :3] = placed.rotation @ pin.skew(axis) @ pin.skew(axis)
            else:
                terms[j, 1, :3, 3] = placed.rotation @ axis
        self.hinges, self._axes = frozen(hinges), frozen(axes)
        self._sliders = np.flatnonzero(~hinges)
        self._terms = frozen(terms.reshape(-1, 3, 16))

    def poses(self, values: np.ndarray) -> np.ndarray:
        """Return T_world_frame (joints + 1, k, 4, 4) of all frames [m].

        values: (k, joints), of all joints, mimic joints included [rad or m].
        """
        weights = np.ones((*values.T.shape, 3))
        weights[..., 1] = np.sin(values).T
        weights[self._sliders, :, 1] = values.T[self._sliders]
        weights[..., 2] -= np.cos(values).T  # times 0 for sliders
        local = (weights @ self._terms).reshape(*weights.shape[:2], 4, 4)
        poses = np.empty((len(self._parents), len(values), 4, 4))
        poses[0] = np.eye(4)
        for up, step, pose in zip(self._parents[1:], local, poses[1:], strict=True):
            np.matmul(poses[up], step, out=pose)
        return poses

    def axes(self, poses: np.ndarray) -> np.ndarray:
        """Return the axes (joints, k, 3) of joints in the world, from `poses`."""
        return (poses[1:, :, :3, :3] @ self._axes[:, None, :, None])[..., 0]


@lru_cache(maxsize=8)
def joint_frames(robot: Robot) -> JointFrames:
    """Return the forward kinematics of a robot's joints."""
    return JointFrames(robot.model)


def poses_at_once(robot: Robot, q: np.ndarray, frame: str | None = None) -> np.ndarray:
    """Return `Robot.poses` by numpy, faster for many configurations; they differ by rounding."""
    placed = robot.model.frames[robot.frame_id(frame)]
    links = joint_frames(robot).poses(robot.kinematics.joint_values(q))
    return links[placed.parentJoint] @ placed.placement.homogeneous
