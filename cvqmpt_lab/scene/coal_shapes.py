"""Shapes as coal geometries, and their distance."""

import coal
import numpy as np

from cvqmpt_lab.robot.hulls import coal_distance, convex_hull
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, Shape, Sphere


def coal_shape(shape: Shape) -> coal.CollisionGeometry:
    """The coal geometry of a solid shape."""
    return COAL_SHAPES[type(shape)](shape)


COAL_SHAPES = {
    Box: lambda box: coal.Box(*box.size),
    Cylinder: lambda cylinder: coal.Cylinder(cylinder.radius, cylinder.height),
    Sphere: lambda sphere: coal.Sphere(sphere.radius),
    ConvexMesh: lambda mesh: convex_hull(mesh.vertices),
}


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
