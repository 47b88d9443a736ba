"""Forward kinematics of the certificate against pinocchio's."""

import numpy as np
import pinocchio as pin
import pytest

from cvqmpt_lab.robot.joint_frames import JointFrames, poses_at_once


def tree() -> pin.Model:
    """Two arms on a slider, with axes that are not those of a frame."""
    model = pin.Model()
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    base = model.addJoint(0, pin.JointModelPrismaticUnaligned(axis), pin.SE3.Random(), "rail")
    for name in ("left", "right"):
        turn = pin.JointModelRevoluteUnaligned(axis[::-1].copy())
        up = model.addJoint(base, turn, pin.SE3.Random(), f"{name}_1")
        up = model.addJoint(up, pin.JointModelPY(), pin.SE3.Random(), f"{name}_2")
        model.addJoint(up, pin.JointModelRX(), pin.SE3.Random(), f"{name}_3")
    return model


@pytest.mark.parametrize("joints", [1, 7])
def test_poses_and_axes_are_those_of_pinocchio(joints):
    model = tree()
    if joints == 1:
        model = pin.Model()
        model.addJoint(0, pin.JointModelRZ(), pin.SE3.Random(), "hinge")
    frames, data = JointFrames(model), model.createData()
    values = np.random.default_rng(0).uniform(-4.0, 4.0, (20, joints))
    poses = frames.poses(values)
    axes = frames.axes(poses)
    for k, row in enumerate(values):
        columns = pin.computeJointJacobians(model, data, row).reshape(6, -1)
        expected = np.array([T.homogeneous for T in data.oMi])
        np.testing.assert_allclose(poses[:, k], expected, atol=1e-12)
        turning = np.where(frames.hinges, columns[3:], columns[:3])
        np.testing.assert_allclose(axes[:, k].T, turning, atol=1e-12)
    assert frames.poses(values[:0]).shape == (joints + 1, 0, 4, 4)


def test_poses_of_a_frame_are_those_of_pinocchio(problem):
    robot = problem.robot
    q = robot.random_configurations(np.random.default_rng(1), 20)
    np.testing.assert_allclose(poses_at_once(robot, q), robot.poses(q), atol=1e-12)
    first = robot.frame_names[1]
    np.testing.assert_allclose(poses_at_once(robot, q, first), robot.poses(q, first), atol=1e-12)
