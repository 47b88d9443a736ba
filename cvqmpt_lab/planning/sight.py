"""What a robot sees of its surroundings: a cloud as a distance field, and a network that reads clearances."""

from collections import OrderedDict

import numpy as np

from cvqmpt_lab.collision.arrays import robot_arrays
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.kernels.search.sight import Sight, fill_distances, judge_motions
from cvqmpt_lab.planning.small_network import SmallNetwork
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.scene import Attachment

CELL = 0.03  # [m] of the distance field
LOWER, UPPER = (
    np.array([-1.2, -1.2, -0.9]),
    np.array([1.2, 1.2, 1.53]),
)  # [m] around the training clouds' crop
SPACING = 0.3  # [rad] between the states of a motion that are looked at
CLOUDS = 4  # remembered


class Eyes:
    """A network at work for one robot and what its hand carries; remembers the clouds it saw last."""

    def __init__(self, network: SmallNetwork, robot: Robot, attachments: tuple[Attachment, ...] = ()) -> None:
        """Take the balls of the robot's collision geometry.

        Raises
        ------
        InvalidInputError
            When the network is for another number of joints.
        """
        if network.inputs != robot.dof + 1:
            raise InvalidInputError(
                f"this network looks at {network.inputs - 1} joints; {robot.name} has {robot.dof}"
            )
        geometry = robot_arrays(robot, attachments)
        rows = np.repeat(geometry.body_link, geometry.body_end - geometry.body_start)
        used = (geometry.leaf >= 0) & (rows > 0)
        self.robot, self.network = robot, network
        shape = tuple(np.ceil((UPPER - LOWER) / CELL).astype(int))
        ball, row = np.ascontiguousarray(geometry.sphere[used]), np.ascontiguousarray(rows[used])
        self.blank = _sight(network, robot.dof, np.zeros(shape, dtype=np.uint8), ball, row)
        self._seen: OrderedDict[bytes, Sight] = OrderedDict()

    @property
    def balls(self) -> int:
        """How many balls stand for the robot."""
        return len(self.blank.ball)

    def look(self, cloud: np.ndarray, anew: bool = False) -> Sight:
        """What a cloud (m, 3) [m, robot base frame] shows, for `RoadmapQuery`; anew: although it was seen lately."""
        key = cloud.tobytes()
        if anew or key not in self._seen:
            distance = np.empty_like(self.blank.distance)
            points = np.array(cloud, dtype=float, order="C")  # read-only arrays would be compiled for anew
            fill_distances(
                points,
                LOWER,
                CELL,
                np.empty((2, 3), np.int64),
                np.empty(distance.shape, np.float32),
                distance,
            )
            self._seen[key] = self.blank._replace(distance=distance)
            if len(self._seen) > CLOUDS:
                self._seen.popitem(last=False)
        self._seen.move_to_end(key)
        return self._seen[key]

    def judge(self, cloud: np.ndarray, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inputs (b, n + 1) and log odds (b,) of straight motions (b, 2, n); a configuration is one of no length."""
        features, odds = np.empty((len(motions), self.robot.dof + 1)), np.empty(len(motions))
        judge_motions(self.robot.kinematics, self.look(cloud), np.ascontiguousarray(motions), features, odds)
        return features, odds


def blind(n: int) -> Sight:
    """What a robot of n joints sees that has no eyes; nobody looks at it."""
    nothing = np.zeros((1, 1, 1), dtype=np.uint8)
    return _sight(SmallNetwork.untrained(n + 1), n, nothing, np.zeros((0, 4)), np.zeros(0, dtype=np.int64))


def _sight(network: SmallNetwork, n: int, distance: np.ndarray, ball: np.ndarray, row: np.ndarray) -> Sight:
    """Bundle with work arrays of its own."""
    return Sight(
        origin=LOWER,
        cell=CELL,
        distance=distance,
        ball=ball,
        row=row,
        spacing=SPACING,
        network=network.arrays(),
        state=np.empty(n),
        rotation=np.empty((n + 1, 3, 3)),
        translation=np.empty((n + 1, 3)),
    )
