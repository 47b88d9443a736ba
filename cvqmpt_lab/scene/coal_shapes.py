"""Shapes as coal geometries, and their distance."""

from collections.abc import Iterable

import coal
import numpy as np

from cvqmpt_lab.robot.dynamics import Load
from cvqmpt_lab.robot.hulls import coal_distance, convex_hull
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Shape, Sphere


def coal_shape(shape: Shape) -> coal.CollisionGeometry:
    """The coal geometry of a solid shape."""
    return COAL_SHAPES[type(shape)](shape)


COAL_SHAPES = {
    Box: lambda box: coal.Box(*box.size),
    Cylinder: lambda cylinder: coal.Cylinder(cylinder.radius, cylinder.height),
    Sphere: lambda sphere: coal.Sphere(sphere.radius),
    ConvexMesh: lambda mesh: convex_hull(mesh.vertices),
}


def loads_of(attachments: Iterable[Attachment]) -> list[Load]:
    """Masses of what the hand carries, as solids of uniform density; a cloud's is a point."""
    loads = []
    for item in attachments:
        if item.mass is None:
            continue
        if isinstance(item.shape, PointCloud):
            centre, tensor = item.shape.points.mean(axis=0), np.zeros((3, 3))
        else:
            solid = coal_shape(item.shape)
            density = item.mass / solid.computeVolume()
            centre, tensor = (
                solid.computeCOM(),
                density * solid.computeMomentofInertiaRelatedToCOM(),
            )
        loads.append(Load(item.T_hand_object, item.mass, centre, tensor, item.end_effector))
    return loads


def transform(T: np.ndarray) -> coal.Transform3s:
    """A pose (4, 4) as a coal transform."""
    return coal.Transform3s(np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]))


def shape_distance(
    first: coal.CollisionGeometry,
    T_world_first: np.ndarray,
    second: coal.CollisionGeometry,
    T_world_second: np.ndarray,
) -> float:
    """Signed distance [m] of two shapes of `coal_shape`; negative where they overlap."""
    return coal_distance(first, transform(T_world_first), second, transform(T_world_second))
