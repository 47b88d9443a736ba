"""Configurations as the models take them: normalised joints u in [0, 1], then link positions, if any."""

import numpy as np

from cvqmpt_lab.codec.plain import from_plain
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.manifold.kinematics import link_poses
from cvqmpt_lab.models.robot_signature import RobotSignature
from cvqmpt_lab.models.serial_chain import SerialChain
from cvqmpt_lab.models.stored import StoredModel
from cvqmpt_lab.robot.robot import Robot

CHAIN_TOLERANCE = 1e-4
"""Link frames that differ by less are those that the model was trained with [m, entries of rotations]."""


def robot_signature(robot: Robot) -> RobotSignature:
    """What weights are compared with."""
    limits = tuple(robot.lower.tolist()), tuple(robot.upper.tolist())
    return RobotSignature(robot.name, *limits, tuple(robot.joint_names), robot.kinematics_digest)


class ModelConfigurations:
    """Joints of a robot to what a model takes, and back.

    Which points of which links are features is read from the model's metadata, where training put
    them; where they are comes from the robot's own kinematics.
    """

    def __init__(self, model: StoredModel, robot: Robot) -> None:
        """Prepare.

        Raises
        ------
        InvalidInputError
            When the model belongs to another robot, or its features were made with other kinematics
            or are not described.
        """
        model.robot.require_same(robot_signature(robot))
        self._robot = robot
        self.lower, self.range = robot.lower, robot.upper - robot.lower
        self._links = np.empty(0, dtype=np.int64)
        self._offsets = np.empty((0, 3))
        if model.config.feature_dim:
            chain = _chain(model, robot)
            self._links = np.array(chain.points) + 1  # pose row 0 is the world
            self._offsets = chain.offsets

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


def _chain(model: StoredModel, robot: Robot) -> SerialChain:
    """The chain whose points are features, which must be the robot's."""
    data = model.metadata.get("kinematics")
    if data is None:
        raise InvalidInputError(
            f"the model takes {model.config.feature_dim} link features, but its metadata has no kinematics; "
            "train it again"
        )
    chain = from_plain(SerialChain, data, "model metadata, kinematics")
    if (len(chain.rotation), chain.feature_dim) != (robot.dof, model.config.feature_dim):
        raise InvalidInputError(
            f"model metadata, kinematics: {len(chain.rotation)} joints and {chain.feature_dim} features; the model "
            f"has {robot.dof} and {model.config.feature_dim}"
        )
    kinematics = robot.kinematics
    if not np.array_equal(kinematics.parent, np.arange(robot.dof)):
        raise InvalidInputError(f"link features are those of a chain, which robot {robot.name!r} is not")
    if chain.sliders != tuple(np.flatnonzero(kinematics.prismatic).tolist()):
        raise InvalidInputError(
            f"the model's link features were made with sliders {list(chain.sliders)}, not those of {robot.name!r}"
        )
    for name in ("rotation", "translation"):
        difference = np.abs(getattr(chain, name) - getattr(kinematics, name))
        difference = difference.reshape(robot.dof, -1).max(axis=1)
        if difference.max() > CHAIN_TOLERANCE:
            joint = int(difference.argmax())
            raise InvalidInputError(
                f"the model's link features were made with another {name} of joint {robot.joint_names[joint]!r} "
                f"(difference {difference[joint]:g}); use the robot description it was trained with"
            )
    return chain
