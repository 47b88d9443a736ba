"""The edge validity model: from a point cloud to P(straight motion is free), for one robot and what it carries.

The cloud becomes a distance field. Along a motion, the smallest clearance of every joint's spheres is read from it; a
network of two hidden layers turns these n numbers and the motion's length into log odds. Nothing is checked exactly.
"""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.vqmpt import clearances as kernels
from cvqmpt_lab.vqmpt.clearances import EdgeArrays, fill_distances, motion_log_odds

CELL = 0.03  # [m] of the distance field
LOWER = np.array([-1.2, -1.2, -0.9])  # [m] corners of the field, around the training clouds' crop
UPPER = np.array([1.2, 1.2, 1.53])
SPACING = 0.3  # [rad] between the states of a motion whose clearances are read
CLOUDS = 4  # remembered


@dataclass(frozen=True, eq=False)
class SmallNetwork:
    """Two hidden layers and one answer, as `training.small_network` trains them."""

    first: np.ndarray  # (h, i)
    first_bias: np.ndarray  # (h,)
    second: np.ndarray  # (k, h)
    second_bias: np.ndarray  # (k,)
    last: np.ndarray  # (k,)
    last_bias: np.ndarray  # (1,)

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "SmallNetwork":
        """From weights by name; InvalidInputError where one is missing or does not fit the others."""
        missing = cls.__annotations__.keys() - arrays.keys()
        if missing:
            raise InvalidInputError(f"weights of a small network without {', '.join(sorted(missing))}")
        network = cls(
            **{name: np.ascontiguousarray(arrays[name], dtype=float) for name in cls.__annotations__}
        )
        h, k = len(network.first_bias), len(network.second_bias)
        shapes = [value.shape for value in vars(network).values()]
        if shapes != [(h, network.first.shape[-1]), (h,), (k, h), (k,), (k,), (1,)]:
            raise InvalidInputError(
                f"weights of a small network have shapes {shapes}, which do not fit each other"
            )
        return network

    @classmethod
    def untrained(cls, inputs: int) -> "SmallNetwork":
        """One that answers 0 to everything."""
        return cls(*(np.zeros(shape) for shape in ((1, inputs), 1, (1, 1), 1, 1, 1)))

    @property
    def inputs(self) -> int:
        """How many numbers it reads."""
        return self.first.shape[1]

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Answers (b,) to many questions (b, i) at once."""
        hidden = np.maximum(features @ self.first.T + self.first_bias, 0.0)
        hidden = np.maximum(hidden @ self.second.T + self.second_bias, 0.0)
        return hidden @ self.last + self.last_bias

    def arrays(self) -> kernels.SmallNetwork:
        """For kernels, with work arrays of its own."""
        own = {**vars(self), "last_bias": float(self.last_bias[0])}
        return kernels.SmallNetwork(
            **own, features=np.empty(self.inputs), hidden=np.empty(len(self.first_bias))
        )


class EdgeModel:
    """A trained network for one robot and what its hand carries; remembers the latest clouds' distance fields."""

    def __init__(self, network: SmallNetwork, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> None:
        """Take the spheres of the robot's collision geometry; refuse a network for another number of joints."""
        if network.inputs != robot.dof + 1:
            raise InvalidInputError(
                f"this network is for {network.inputs - 1} joints; {robot.name} has {robot.dof}"
            )
        geometry = robot_arrays(robot, attachments)
        rows = np.repeat(geometry.body_link, geometry.body_end - geometry.body_start)
        used = (geometry.leaf >= 0) & (rows > 0)
        self.robot, self.network = robot, network
        shape = tuple(np.ceil((UPPER - LOWER) / CELL).astype(int))
        self.empty = _edge_arrays(
            network, robot.dof, np.zeros(shape, dtype=np.uint8), geometry.sphere[used], rows[used]
        )
        self._fields: OrderedDict[bytes, EdgeArrays] = OrderedDict()

    def arrays(self, cloud: np.ndarray, use_cache: bool = True) -> EdgeArrays:
        """The model with the distance field of a cloud (m, 3) [m, robot base frame], for kernels."""
        key = cloud.tobytes()
        if not use_cache or key not in self._fields:
            distance = np.empty_like(self.empty.distance)
            points = np.array(cloud, dtype=float, order="C")  # kernels take no read-only arrays
            span, square = np.empty((2, 3), np.int64), np.empty(distance.shape, np.float32)
            fill_distances(points, LOWER, CELL, span, square, distance)
            self._fields[key] = self.empty._replace(distance=distance)
            if len(self._fields) > CLOUDS:
                self._fields.popitem(last=False)
        self._fields.move_to_end(key)
        return self._fields[key]

    def log_odds(self, cloud: np.ndarray, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inputs (b, n + 1) and log odds (b,) of straight motions (b, 2, n); a configuration is one of no length."""
        features, odds = np.empty((len(motions), self.robot.dof + 1)), np.empty(len(motions))
        motion_log_odds(
            self.robot.kinematics, self.arrays(cloud), np.ascontiguousarray(motions), features, odds
        )
        return features, odds


def without_cloud(n: int) -> EdgeArrays:
    """An unused model for kernels that search without one, of a robot of n joints."""
    nothing = np.zeros((1, 1, 1), dtype=np.uint8)
    return _edge_arrays(
        SmallNetwork.untrained(n + 1), n, nothing, np.zeros((0, 4)), np.zeros(0, dtype=np.int64)
    )


def _edge_arrays(
    network: SmallNetwork, n: int, distance: np.ndarray, sphere: np.ndarray, row: np.ndarray
) -> EdgeArrays:
    return EdgeArrays(
        origin=LOWER,
        cell=CELL,
        distance=distance,
        sphere=np.ascontiguousarray(sphere),
        row=np.ascontiguousarray(row),
        spacing=SPACING,
        network=network.arrays(),
        state=np.empty(n),
        rotation=np.empty((n + 1, 3, 3)),
        translation=np.empty((n + 1, 3)),
    )
