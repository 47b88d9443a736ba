"""Exact collision checking with coal: convex hulls of the links against the shapes of a scene.

This file is the door to coal. The certificate and the `exact` backend use it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from cvqmpt_lab.robot.hulls import convex_hull
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.attachment import Attachment
from cvqmpt_lab.scene.scene import Scene, SceneObject
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Shape, Sphere, bounding_radius

MOST_BALLS = 1000  # clouds of more points are checked as octrees, whose cells are only roughly the balls


@dataclass(frozen=True)
class CollidingPair:
    """Names of two pieces that overlap, or are closest."""

    first: str
    second: str

    def __str__(self) -> str:
        return f"{self.first} and {self.second}"


class CollisionChecker:
    """Answers whether a robot, carrying attachments, touches itself or the obstacles of a scene.

    Pieces that do not move against each other (a base link and the walls, a hand and what it
    carries) are never paired.

    margin: pieces closer than this [m] count as touching. Contact itself is only defined to about
    1e-5 m, so whoever needs two checkers to agree keeps a margin.
    """

    def __init__(
        self, robot: Robot, scene: Scene, attachments: Sequence[Attachment] = (), margin: float = 0.0
    ) -> None:
        self.robot = robot
        self._model = robot.model
        self._geometry = _paired_geometry(robot, scene, attachments)
        self._data = self._model.createData()
        self._geometry_data = pin.GeometryData(self._geometry)
        for request in self._geometry_data.collisionRequests:
            request.security_margin = margin
            request.enable_contact = (
                True  # without, coal calls some pairs free that overlap by half a millimetre
            )
        self._manager = pin.TreeBroadPhaseManager_DynamicAABBTreeCollisionManager(
            self._model, self._geometry, self._geometry_data
        )

    def in_collision(self, q: np.ndarray) -> bool:
        """Whether configuration q (n,) touches anything. About 20 us."""
        return bool(pin.computeCollisions(self._model, self._data, self._manager, q, True))

    def in_collision_batch(self, configurations: np.ndarray) -> np.ndarray:
        """Whether each row of configurations (b, n) touches anything, (b,) bool."""
        return np.array([self.in_collision(q) for q in configurations], dtype=bool)

    def colliding_pair(self, q: np.ndarray) -> CollidingPair | None:
        """The first overlapping pair by name, or None."""
        pin.computeCollisions(self._model, self._data, self._geometry, self._geometry_data, q, False)
        for k, result in enumerate(self._geometry_data.collisionResults):
            if result.isCollision():
                return self._names(k)
        return None

    def clearance(self, q: np.ndarray) -> float:
        """Smallest distance of all pairs [m]; zero or negative (penetration) in collision, inf without pairs."""
        return self.nearest_pair(q)[1]

    def nearest_pair(self, q: np.ndarray) -> tuple[CollidingPair | None, float]:
        """The closest pair and its signed distance [m]."""
        if len(self._geometry.collisionPairs) == 0:
            return None, np.inf
        k = pin.computeDistances(self._model, self._data, self._geometry, self._geometry_data, q)
        return self._names(k), float(self._geometry_data.distanceResults[k].min_distance)

    def _names(self, pair_index: int) -> CollidingPair:
        pair = self._geometry.collisionPairs[pair_index]
        objects = self._geometry.geometryObjects
        return CollidingPair(objects[pair.first].name, objects[pair.second].name)


def _paired_geometry(robot: Robot, scene: Scene, attachments: Sequence[Attachment]) -> pin.GeometryModel:
    """The robot's geometry with obstacles and attachments added, and the pairs to check."""
    geometry = robot.collision_model.copy()
    n_links = geometry.ngeoms
    hand = robot.model.frames[robot.model.getFrameId(robot.end_effector)]
    carried = []
    for item in attachments:
        placement = hand.placement * pin.SE3(item.T_hand_object)
        shape = coal_shape(item.shape)
        carried.append(
            geometry.addGeometryObject(pin.GeometryObject(item.name, hand.parentJoint, placement, shape))
        )
    obstacles: list[int] = []
    for obstacle in scene.objects:
        if obstacle.obstacle and _within_reach(obstacle, robot, attachments):
            for shape, T_world_shape in _pieces(obstacle):
                name = obstacle.name if shape is obstacle.shape else f"{obstacle.name}/{len(obstacles)}"
                piece = pin.GeometryObject(name, 0, pin.SE3(T_world_shape), coal_shape(shape))
                obstacles.append(geometry.addGeometryObject(piece))
    moving = [i for i in range(n_links) if geometry.geometryObjects[i].parentJoint != 0]
    for k in obstacles:
        for i in (*moving, *carried):
            geometry.addCollisionPair(pin.CollisionPair(i, k))
    for i in range(n_links):
        for k in carried:
            if not _near_in_tree(robot, geometry.geometryObjects[i].parentJoint, hand.parentJoint):
                geometry.addCollisionPair(pin.CollisionPair(i, k))
    return geometry


def _pieces(item: SceneObject) -> list[tuple[Shape, np.ndarray]]:
    """The object itself, or the balls of a small point cloud; a large cloud stays one octree."""
    if not isinstance(item.shape, PointCloud) or len(item.shape.points) > MOST_BALLS:
        return [(item.shape, item.T_world_object)]
    balls: list[tuple[Shape, np.ndarray]] = []
    for point in item.shape.points:
        T_object_ball = np.eye(4)
        T_object_ball[:3, 3] = point
        balls.append((Sphere(item.shape.radius), item.T_world_object @ T_object_ball))
    return balls


def _within_reach(item: SceneObject, robot: Robot, attachments: Sequence[Attachment]) -> bool:
    """Whether an obstacle's bounding ball meets the ball around the base that the robot cannot leave."""
    if isinstance(item.shape, PointCloud):
        return True
    carried = max(
        (np.linalg.norm(a.T_hand_object[:3, 3]) + bounding_radius(a.shape) for a in attachments), default=0.0
    )
    distance = np.linalg.norm(item.T_world_object[:3, 3]) - bounding_radius(item.shape)
    return bool(distance <= robot.reach + carried)


def _near_in_tree(robot: Robot, a: int, b: int) -> bool:
    """Whether two joints are the same, or parent and child: their links always stay close."""
    parents = robot.model.parents
    return a == b or parents[a] == b or parents[b] == a


def carried_pairs(robot: Robot, attachments: Sequence[Attachment]) -> list[tuple[int, int]]:
    """(link piece, attachment) index pairs that can touch; neighbours of the hand are left out."""
    frame = robot.model.frames[robot.model.getFrameId(robot.end_effector)]
    joints = [item.parentJoint for item in robot.collision_model.geometryObjects]
    return [
        (i, k)
        for k in range(len(attachments))
        for i, joint in enumerate(joints)
        if not _near_in_tree(robot, joint, frame.parentJoint)
    ]


def shape_distance(
    first: coal.CollisionGeometry,
    T_world_first: np.ndarray,
    second: coal.CollisionGeometry,
    T_world_second: np.ndarray,
) -> float:
    """Signed distance [m] of two shapes of `coal_shape`; negative where they overlap."""
    poses = [coal.Transform3s(T[:3, :3], T[:3, 3]) for T in (T_world_first, T_world_second)]
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    return float(coal.distance(first, poses[0], second, poses[1], request, result))


def coal_shape(shape: Shape) -> coal.CollisionGeometry:
    """The coal geometry of a shape; a point cloud becomes an octree with cells of its ball diameter."""
    return COAL_SHAPES[type(shape)](shape)


COAL_SHAPES = {
    Box: lambda box: coal.Box(*box.size),
    Cylinder: lambda cylinder: coal.Cylinder(cylinder.radius, cylinder.height),
    Sphere: lambda sphere: coal.Sphere(sphere.radius),
    ConvexMesh: lambda mesh: convex_hull(mesh.vertices),
    PointCloud: lambda cloud: coal.makeOctree(cloud.points, 2.0 * cloud.radius),
}
