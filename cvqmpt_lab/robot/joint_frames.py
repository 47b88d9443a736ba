"""Poses of a robot's joint frames at many configurations at once, by numpy.

The certificate uses them: they share no code with the planners' compiled kinematics.
"""

import numpy as np
import pinocchio as pin


class JointFrames:
    """Forward kinematics of a pinocchio model of hinges and sliders.

    Frames are pinocchio's: frame 0 is the world's, frame j + 1 that of joint j.
    """

    def __init__(self, model: pin.Model) -> None:
        data = model.createData()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        self.hinges = np.zeros(model.nv, dtype=bool)
        self._axes = np.zeros((model.nv, 3))  # in the joints' own frames
        self._parents = [int(parent) for parent in model.parents]
        # Pose in the parent's frame at value v: a + sin(v) b + (1 - cos(v)) c of a hinge, with
        # Rodrigues' formula; a + v b of a slider
        self._terms = np.zeros((3, model.nv, 1, 4, 4))
        for j in range(model.nv):
            local = pin.getJointJacobian(model, data, j + 1, pin.ReferenceFrame.LOCAL)
            motion = local.reshape(6, -1)[:, j]  # (6,) of a single joint
            self.hinges[j] = np.linalg.norm(motion[3:]) > 0.5
            self._axes[j] = axis = motion[3:] if self.hinges[j] else motion[:3]
            placed = model.jointPlacements[j + 1]
            self._terms[0, j] = placed.homogeneous
            if self.hinges[j]:
                self._terms[1, j, :, :3, :3] = placed.rotation @ pin.skew(axis)
                self._terms[2, j, :, :3, :3] = placed.rotation @ pin.skew(axis) @ pin.skew(axis)
            else:
                self._terms[1, j, :, :3, 3] = placed.rotation @ axis

    def poses(self, values: np.ndarray) -> np.ndarray:
        """Return T_world_frame (joints + 1, k, 4, 4) of all frames [m].

        values: (k, joints), of all joints, those that mimic others included [rad or m].
        """
        values = values.T[:, :, None, None]
        first = np.where(self.hinges[:, None, None, None], np.sin(values), values)
        second = 1.0 - np.cos(values)  # times 0 for sliders
        local = self._terms[0] + first * self._terms[1] + second * self._terms[2]
        poses = np.empty((len(self._parents), *local.shape[1:]))
        poses[0] = np.eye(4)
        for j, up in enumerate(self._parents[1:]):
            np.matmul(poses[up], local[j], out=poses[j + 1])
        return poses

    def axes(self, poses: np.ndarray) -> np.ndarray:
        """Return the axes (joints, k, 3) of joints in the world, from `poses`."""
        return (poses[1:, :, :3, :3] @ self._axes[:, None, :, None])[..., 0]
