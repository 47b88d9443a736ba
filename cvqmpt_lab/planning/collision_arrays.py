"""From a problem's robot, attachments and scene to the arrays of the compiled collision checker."""

from functools import lru_cache

import numpy as np

from cvqmpt_lab.kernels.collision.geometry import (
    CELL,
    RobotGeometry,
    SceneGeometry,
    robot_geometry,
    scene_geometry,
)
from cvqmpt_lab.kernels.collision.point_clusters import Cloud
from cvqmpt_lab.kernels.collision.separation import BOX, CYLINDER, HULL, SPHERE
from cvqmpt_lab.kernels.collision.shapes import ShapeSpec
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.attachment import Attachment
from cvqmpt_lab.scene.cloud_cells import MOST_BALLS, cloud_cells
from cvqmpt_lab.scene.exact_checker import carried_pairs
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Shape, Sphere

NO_VERTICES = np.empty((0, 3))
MOST_CELLS = 256
"""Of the distance grid, along an edge: a long reach has coarser cells instead of more memory."""


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
    solids = [item for item in scene.obstacles if not isinstance(item.shape, PointCloud)]
    clouds = [
        _cloud(item.shape, item.T_world_object, reach)
        for item in scene.obstacles
        if isinstance(item.shape, PointCloud)
    ]
    specs = [spec for item in solids for spec in _specs(item.shape, item.T_world_object)]
    cell = max(CELL, 2.0 * reach / MOST_CELLS)
    return scene_geometry(specs, np.full(3, -reach), np.full(3, reach), cell, clouds)


def _cloud(cloud: PointCloud, T: np.ndarray, reach: float) -> Cloud:
    """The balls of a cloud in the world; of a large one, balls around the cells that the exact checker sees."""
    points, radius = cloud.points, cloud.radius
    if len(points) > MOST_BALLS:
        cells = cloud_cells(cloud, T, reach)
        if cells is None:
            return Cloud(NO_VERTICES, radius)
        points, radius, T = cells.centres, 0.5 * np.sqrt(3.0) * cells.edge, cells.T_parent_cells
    return Cloud(points @ T[:3, :3].T + T[:3, 3], radius)


def _specs(shape: Shape, T: np.ndarray) -> list[ShapeSpec]:
    """A solid in plain numbers, or the balls of a carried cloud."""
    return SPECS[type(shape)](shape, T)


def _balls(cloud: PointCloud, T: np.ndarray) -> list[ShapeSpec]:
    """A carried cloud, as balls around the cells that the exact checker sees."""
    cells = cloud_cells(cloud, T)
    assert cells is not None  # nothing is out of reach
    poses = np.tile(np.eye(4), (len(cells.centres), 1, 1))
    poses[:, :3, 3] = cells.centres @ cells.T_parent_cells[:3, :3].T + cells.T_parent_cells[:3, 3]
    return [ShapeSpec(SPHERE, (0.5 * np.sqrt(3.0) * cells.edge,), NO_VERTICES, pose) for pose in poses]


SPECS = {
    Box: lambda box, T: [ShapeSpec(BOX, box.size, NO_VERTICES, T)],
    Cylinder: lambda c, T: [ShapeSpec(CYLINDER, (c.radius, c.radius, c.height), NO_VERTICES, T)],
    Sphere: lambda sphere, T: [ShapeSpec(SPHERE, (sphere.radius,), NO_VERTICES, T)],
    ConvexMesh: lambda mesh, T: [ShapeSpec(HULL, (), mesh.vertices, T)],
    PointCloud: _balls,
}
