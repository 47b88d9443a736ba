"""Shapes as coal geometries, and their distance."""

from collections.abc import Iterable

import coal
import numpy as np

from cvqmpt_lab.robot.dynamics import Load
from cvqmpt_lab.robot.hulls import coal_distance, coal_hull
from cvqmpt_lab.scene.scene import Attachment
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Shape, Sphere


def coal_shape(shape: Shape) -> coal.CollisionGeometry:
    """Return the coal geometry of a solid shape."""
    match shape:
        case Box(size):
            return coal.Box(*size)
        case Cylinder(radius, height):
            return coal.Cylinder(radius, height)
        case Sphere(radius):
            return coal.Sphere(radius)
        case ConvexMesh(vertices):
            return coal_hull(vertices)
    raise TypeError(f"{type(shape).__name__} is no solid")


def loads_of(attachments: Iterable[Attachment]) -> list[Load]:
    """Return the loads of attachments with a mass: solids of uniform density; clouds as points."""
    loads = []
    for item in attachments:
        if item.mass is None:
            continue
        if isinstance(item.shape, PointCloud):
            centre = item.shape.points.mean(axis=0)
            tensor = np.zeros((3, 3))
        else:
            solid = coal_shape(item.shape)
            density = item.mass / solid.computeVolume()
            centre = solid.computeCOM()
            tensor = density * solid.computeMomentofInertiaRelatedToCOM()
        loads.append(Load(item.T_hand_object, item.mass, centre, tensor, item.end_effector))
    return loads


def transform(T: np.ndarray) -> coal.Transform3s:
    """Return a pose (4, 4) as a coal transform."""
    return coal.Transform3s(np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]))


def shape_distance(
    first: coal.CollisionGeometry,
    T_world_first: np.ndarray,
    second: coal.CollisionGeometry,
    T_world_second: np.ndarray,
) -> float:
    """Return the signed distance [m] of two shapes; negative if they overlap.

    Args:
        first: result of `coal_shape`.
        T_world_first: (4, 4) pose of the first shape.
        second: result of `coal_shape`.
        T_world_second: (4, 4) pose of the second shape.
    """
    return coal_distance(first, transform(T_world_first), second, transform(T_world_second))
