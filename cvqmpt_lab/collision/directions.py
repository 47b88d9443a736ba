"""Directions along which pieces of a robot, its loads and obstacles are apart, by coal."""

from collections.abc import Sequence
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from cvqmpt_lab.collision.exact import robot_geometry
from cvqmpt_lab.collision.solids import Solid, solids
from cvqmpt_lab.robot.hulls import hull_vertices
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.coal_shapes import transform
from cvqmpt_lab.scene.scene import Attachment, Scene


class Convex(NamedTuple):
    """The hull of points, with a ball or a disc around each of them."""

    points: np.ndarray  # (k, 3) [m]
    radius: float = 0.0  # of the balls [m]
    disc: float = 0.0  # radius of the discs, across the line through both points [m]


def convex_of(shape: coal.CollisionGeometry) -> Convex:
    """Return a shape in its own frame; a capsule as a polytope that contains it."""
    padding = float(shape.getSweptSphereRadius())
    match shape:
        case coal.Sphere():
            return Convex(np.zeros((1, 3)), shape.radius + padding)
        case coal.Cylinder():
            ends = np.outer((-shape.halfLength, shape.halfLength), (0.0, 0.0, 1.0))
            return Convex(ends, padding, shape.radius)
    return Convex(hull_vertices(shape), padding)


def by_place(pieces: list[Solid]) -> list[Solid]:
    """Return pieces in an order in which the first half is on one side of the other, and so on."""
    if len(pieces) < 2:
        return pieces
    centres = np.array([piece.T_parent_shape[:3, 3] for piece in pieces])
    along = centres[:, np.ptp(centres, axis=0).argmax()].argsort(kind="stable").tolist()
    middle = len(pieces) // 2
    halves = along[:middle], along[middle:]
    return [piece for half in halves for piece in by_place([pieces[k] for k in half])]


class Directions:
    """Pieces of a robot and of its loads, and obstacles; `place` moves the robot.

    Args:
        robot: the robot.
        scene: obstacles.
        attachments: loads in the hands.
    """

    def __init__(self, robot: Robot, scene: Scene, attachments: Sequence[Attachment]) -> None:
        self._robot, self._model, self._data = robot, robot.model, robot.model.createData()
        self._geometry = robot_geometry(robot, attachments)
        self._placed = pin.GeometryData(self._geometry)
        self._request = coal.DistanceRequest()
        objects = list(self._geometry.geometryObjects)
        self.names = tuple(item.name for item in objects)
        self.shapes = tuple(item.geometry for item in objects)
        pairs = [(p.first, p.second) for p in self._geometry.collisionPairs]
        self.pairs: tuple[tuple[int, int], ...] = tuple(pairs)  # that are compared
        self.loads: list[list[Solid]] = [
            list(solids(item.name, item.shape, item.T_hand_object)) for item in attachments
        ]
        self.obstacles = by_place(
            [
                solid
                for item in scene.obstacles
                for solid in solids(item.name, item.shape, item.T_world_object)
            ]
        )
        self._poses = [transform(solid.T_parent_shape) for solid in self.obstacles]

    def place(self, q: np.ndarray) -> None:
        """Move the robot to a configuration (n,)."""
        values = self._robot.kinematics.joint_values(q)
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._placed, values)

    def own(self, first: int, second: int) -> tuple[float, np.ndarray]:
        """Return the distance [m] of two pieces, and the unit vector (3,) from first to second."""
        return self._found(first, self.shapes[second], self._pose(second))

    def obstacle(self, piece: int, obstacle: int) -> tuple[float, np.ndarray]:
        """Return the distance [m] of a piece from an obstacle, and the unit vector (3,) to it."""
        return self._found(piece, self.obstacles[obstacle].shape, self._poses[obstacle])

    def box(self, piece: int, low: np.ndarray, high: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the same for a box along the axes of the world, from `low` (3,) to `high`."""
        pose = coal.Transform3s(np.eye(3), 0.5 * (low + high))
        return self._found(piece, coal.Box(high - low), pose)

    def _pose(self, piece: int) -> coal.Transform3s:
        placed = self._placed.oMg[piece]
        return coal.Transform3s(placed.rotation, placed.translation)

    def _found(
        self, piece: int, shape: coal.CollisionGeometry, pose: coal.Transform3s
    ) -> tuple[float, np.ndarray]:
        """Return distance and direction from a piece to a shape at a pose."""
        result = coal.DistanceResult()
        own = self.shapes[piece], self._pose(piece)
        distance = coal.distance(*own, shape, pose, self._request, result)
        return float(distance), np.array(result.normal, dtype=float)
