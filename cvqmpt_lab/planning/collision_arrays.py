"""From a problem's robot, attachments and scene to the arrays of the compiled collision checker."""

from functools import lru_cache

import numpy as np

from cvqmpt_lab.kernels.geometry import RobotGeometry, SceneGeometry, robot_geometry, scene_geometry
from cvqmpt_lab.kernels.separation import BOX, CYLINDER, HULL, SPHERE
from cvqmpt_lab.kernels.shapes import ShapeSpec
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.attachment import Attachment
from cvqmpt_lab.scene.collision import carried_pairs
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Shape, Sphere

VOXEL = 0.02  # [m] points of a cloud within one voxel become one ball around them
NO_VERTICES = np.empty((0, 3))


@lru_cache(maxsize=8)
def robot_arrays(robot: Robot, attachments: tuple[Attachment, ...] = ()) -> RobotGeometry:
    """Convex pieces of the robot and of what it carries."""
    specs = [ShapeSpec(HULL, (), piece.vertices, piece.T_link_geometry) for piece in robot.links]
    links = [piece.link for piece in robot.links]
    hand, T_link_hand = robot.end_effector_link
    for item in attachments:
        specs.extend(_specs(item.shape, T_link_hand @ item.T_hand_object))
        links.append(hand)
    n = len(robot.links)
    carried = [(i, n + k) for i, k in carried_pairs(robot, attachments)]
    return robot_geometry(specs, links, [*robot.self_collision_pairs, *carried])


@lru_cache(maxsize=8)
def scene_arrays(scene: Scene, reach: float) -> SceneGeometry:
    """Obstacles of a scene with their distance grid over the cube of half edge reach [m] about the base."""
    return scene_geometry(scene_specs(scene), np.full(3, -reach), np.full(3, reach))


def scene_specs(scene: Scene) -> list[ShapeSpec]:
    """The obstacles of a scene in plain numbers."""
    return [spec for item in scene.obstacles for spec in _specs(item.shape, item.T_world_object)]


def _specs(shape: Shape, T: np.ndarray) -> list[ShapeSpec]:
    """The shape in plain numbers; a cloud becomes many balls."""
    return SPECS[type(shape)](shape, T)


def cloud_specs(cloud: PointCloud, T: np.ndarray) -> list[ShapeSpec]:
    """One ball per occupied voxel, large enough for the balls of all points in it."""
    points = cloud.points @ T[:3, :3].T + T[:3, 3]
    _, owner = np.unique(np.floor(points / VOXEL).astype(np.int64), axis=0, return_inverse=True)
    owner = owner.ravel()
    count = np.bincount(owner)
    centres = np.stack([np.bincount(owner, points[:, a]) / count for a in range(3)], axis=1)
    spread = np.zeros(len(count))
    np.maximum.at(spread, owner, np.linalg.norm(points - centres[owner], axis=1))
    specs = []
    for centre, radius in zip(centres, spread + cloud.radius, strict=True):
        pose = np.eye(4)
        pose[:3, 3] = centre
        specs.append(ShapeSpec(SPHERE, (float(radius),), NO_VERTICES, pose))
    return specs


SPECS = {
    Box: lambda box, T: [ShapeSpec(BOX, box.size, NO_VERTICES, T)],
    Cylinder: lambda c, T: [ShapeSpec(CYLINDER, (c.radius, c.radius, c.height), NO_VERTICES, T)],
    Sphere: lambda sphere, T: [ShapeSpec(SPHERE, (sphere.radius,), NO_VERTICES, T)],
    ConvexMesh: lambda mesh, T: [ShapeSpec(HULL, (), mesh.vertices, T)],
    PointCloud: cloud_specs,
}
