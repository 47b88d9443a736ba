"""Shapes as coal sees them, and the obstacles of a scene that a robot can come near to."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import coal
import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.hulls import convex_hull
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.attachment import Attachment
from cvqmpt_lab.scene.cloud_cells import MOST_BALLS, CloudCells, cloud_cells
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Box, ConvexMesh, Cylinder, PointCloud, Shape, Sphere, bounding_radius

LONGEST_REACH = 20.0
"""[m] of an arm with what it carries; more is a misplaced unit, and would take time and memory without end."""


class Solid(NamedTuple):
    """One piece of collision geometry."""

    name: str
    shape: coal.CollisionGeometry
    T_parent_shape: np.ndarray
    """(4, 4), pose in the world or in the hand [m]."""


def reach_with(robot: Robot, attachments: Sequence[Attachment]) -> float:
    """Radius [m] of a ball around the base that neither the robot nor what it carries can leave.

    InvalidInputError, naming what is too long or too far away, when that is more than LONGEST_REACH.
    """
    carried = {
        f"attachment {a.name!r}": float(np.linalg.norm(a.T_hand_object[:3, 3])) + bounding_radius(a.shape)
        for a in attachments
    }
    for name, length in {f"robot {robot.name}": robot.reach, **carried}.items():
        if not length <= LONGEST_REACH:
            raise InvalidInputError(
                f"{name} reaches {length:.3g} m, more than {LONGEST_REACH:g}: give positions, sizes and slider "
                f"limits in metres"
            )
    return robot.reach + max(carried.values(), default=0.0)


def obstacles_within(scene: Scene, reach: float) -> Iterator[Solid]:
    """The obstacles of a scene that something within reach [m] of the world's origin can touch."""
    for item in scene.objects:
        if not item.obstacle:
            continue
        position = float(np.linalg.norm(item.T_world_object[:3, 3]))
        if isinstance(item.shape, PointCloud) or position - bounding_radius(item.shape) <= reach:
            yield from solids(item.name, item.shape, item.T_world_object, reach)


def solids(
    name: str, shape: Shape, T: np.ndarray, reach: float = np.inf, most_balls: int = MOST_BALLS
) -> Iterator[Solid]:
    """The shape itself at pose T; of a small cloud its balls, of a large one an octree, if any of it is in reach."""
    if not isinstance(shape, PointCloud):
        yield Solid(name, coal_shape(shape), T)
    elif len(shape.points) <= most_balls:
        for k, point in enumerate(shape.points):
            T_ball = T.copy()
            T_ball[:3, 3] += T[:3, :3] @ point
            yield Solid(f"{name}/{k}", coal.Sphere(shape.radius), T_ball)
    elif (cells := cloud_cells(shape, T, reach)) is not None:
        yield Solid(name, octree(cells), cells.T_parent_cells)


def octree(cells: CloudCells) -> coal.OcTree:
    """The cells as coal's octree; InvalidInputError should it have lost any."""
    tree = coal.makeOctree(cells.centres, cells.edge)
    edges = np.array([box[3] for box in tree.toBoxes()])
    kept = int(np.round((edges / cells.edge) ** 3).sum())
    if kept != len(cells.centres):
        raise InvalidInputError(
            f"point cloud: {len(cells.centres) - kept} of {len(cells.centres)} cells of {cells.edge:.3g} m do not fit "
            f"into an octree; give points with a larger radius"
        )
    return tree


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
    """A pose (4, 4) as coal takes it."""
    return coal.Transform3s(np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]))


def shape_distance(
    first: coal.CollisionGeometry,
    T_world_first: np.ndarray,
    second: coal.CollisionGeometry,
    T_world_second: np.ndarray,
) -> float:
    """Signed distance [m] of two shapes of `coal_shape`; negative where they overlap."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    return float(
        coal.distance(first, transform(T_world_first), second, transform(T_world_second), request, result)
    )
