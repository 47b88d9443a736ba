"""Configurations as the models take them: normalised joints u in [0, 1], then link positions, if any."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.models.checkpoint import Checkpoint
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.robot.robot import Robot

CHAIN_TOLERANCE = 1e-4
"""Link frames that differ by less are those that the model was trained with [m, entries of rotations]."""


def robot_signature(robot: Robot) -> RobotSignature:
    """What weights are compared with."""
    limits = tuple(robot.lower.tolist()), tuple(robot.upper.tolist())
    return RobotSignature(robot.name, *limits, tuple(robot.joint_names), robot.kinematics_digest)


class ModelConfigurations:
    """Joints of a robot to what a checkpoint takes, and back.

    Which points of which links are features is read from the checkpoint's metadata, where training put
    them; where they are comes from the robot's own kinematics.
    """

    def __init__(self, checkpoint: Checkpoint, robot: Robot) -> None:
        """Prepare.

        Raises
        ------
        InvalidInputError
            When the checkpoint belongs to another robot, or its features were made with other kinematics
            or are not described.
        """
        checkpoint.robot.require_same(robot_signature(robot))
        self._robot = robot
        self.lower, self.range = robot.lower, robot.upper - robot.lower
        self._links = np.empty(0, dtype=np.int64)
        self._offsets = np.empty((0, 3))
        if checkpoint.config.feature_dim:
            self._links, self._offsets = _points(checkpoint, robot)

    def normalised(self, q: np.ndarray) -> np.ndarray:
        """Joints u (..., n) in [0, 1] of q (..., n) [rad or m]."""
        return (q - self.lower) / self.range

    def radians(self, u: np.ndarray) -> np.ndarray:
        """Joints q (..., n) [rad or m] of u (..., n)."""
        return self.lower + u * self.range

    def of(self, q: np.ndarray) -> np.ndarray:
        """Configurations (b, n + 3 k) float32 of joints q (b, n): u, then positions of k points [m]."""
        parts = [self.normalised(q)]
        if len(self._links):
            rotation, translation = link_poses(self._robot.kinematics, np.ascontiguousarray(q, dtype=float))
            points = np.einsum("bkij,kj->bki", rotation[:, self._links], self._offsets)
            parts.append((points + translation[:, self._links]).reshape(len(q), -1))
        return np.concatenate(parts, axis=1).astype(np.float32)


def _points(checkpoint: Checkpoint, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Pose rows (k,) and offsets (k, 3) [m] of the points whose positions are features."""
    chain = checkpoint.metadata.get("kinematics")
    expected = checkpoint.config.feature_dim
    if not isinstance(chain, Mapping):
        raise InvalidInputError(
            f"the model takes {expected} link features, but its metadata has no kinematics; train it again"
        )
    joints = robot.dof
    rotation = _array(chain, "rotation", (joints, 3, 3))
    translation = _array(chain, "translation", (joints, 3))
    points = _array(chain, "points", (expected // 3,)).astype(np.int64)
    offsets = _array(chain, "offsets", (expected // 3, 3))
    kinematics = robot.kinematics
    if kinematics.prismatic.any() or not np.array_equal(kinematics.parent, np.arange(joints)):
        raise InvalidInputError(
            f"link features are those of a chain of hinges, which robot {robot.name!r} is not"
        )
    for name, trained, own in (
        ("rotation", rotation, kinematics.rotation),
        ("translation", translation, kinematics.translation),
    ):
        difference = np.abs(trained - own).reshape(joints, -1).max(axis=1)
        if difference.max() > CHAIN_TOLERANCE:
            joint = int(difference.argmax())
            raise InvalidInputError(
                f"the model's link features were made with another {name} of joint {robot.joint_names[joint]!r} "
                f"(difference {difference[joint]:g}); use the robot description it was trained with"
            )
    return points + 1, offsets  # pose row 0 is the world


def _array(chain: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.asarray(chain[name], dtype=float)
    except (KeyError, TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape:
        raise InvalidInputError(f"model metadata, kinematics.{name}: must be numbers of shape {shape}")
    return array
