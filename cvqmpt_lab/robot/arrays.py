"""From pinocchio's model to the plain arrays of the kernels, in joint frames whose z is the joint axis."""

import numpy as np
import pinocchio as pin

from cvqmpt_lab.kernels.manifold.kinematics import Kinematics


def axis_frames(model: pin.Model) -> list[np.ndarray]:
    """Per pose row, the rotation (3, 3) that turns pinocchio's joint frame so that its z is the joint axis."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    frames = [np.eye(3)]
    for j in range(1, model.njoints):
        jacobian = pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL)
        motion = jacobian.reshape(6, -1)[:, j - 1]  # of one joint, pinocchio gives a vector
        axis = motion[3:] if np.linalg.norm(motion[3:]) > 0.5 else motion[:3]
        z = np.array([0.0, 0.0, 1.0])
        frames.append(pin.Quaternion.FromTwoVectors(z, axis).toRotationMatrix())
    return frames


def kinematics_arrays(model: pin.Model, frames: list[np.ndarray]) -> Kinematics:
    """Plain arrays of a model, in joint frames whose z is the joint axis."""
    n = model.nq
    parent = np.array([model.parents[j + 1] for j in range(n)], dtype=np.int64)
    placements = [model.jointPlacements[j + 1] for j in range(n)]
    moves = np.zeros((n, n + 1), dtype=bool)
    for k in range(1, n + 1):
        for j in model.supports[k]:
            if j > 0:
                moves[j - 1, k] = True
    return Kinematics(
        parent=parent,
        rotation=np.array([frames[parent[j]].T @ placements[j].rotation @ frames[j + 1] for j in range(n)]),
        translation=np.array([frames[parent[j]].T @ placements[j].translation for j in range(n)]),
        prismatic=np.array([j.shortname().startswith("JointModelP") for j in list(model.joints)[1:]]),
        lower=np.array(model.lowerPositionLimit),
        upper=np.array(model.upperPositionLimit),
        moves=moves,
    )


def in_link(frames: list[np.ndarray], joint: int, placement: pin.SE3) -> tuple[int, np.ndarray]:
    """Pose row and (4, 4) placement of something that pinocchio attaches to a joint."""
    T = placement.homogeneous
    T[:3] = frames[joint].T @ T[:3]
    return int(joint), T
