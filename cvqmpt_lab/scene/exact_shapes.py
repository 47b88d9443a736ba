"""Shapes as coal sees them, and the obstacles of a scene that a robot can come near to."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import coal
import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.hulls import convex_hull
from cvqmpt_lab.robot.robot import Robot
from cvqmpt_lab.scene.cells import MOST_BALLS, Cells, cells_of, merged
from cvqmpt_lab.scene.scene import Attachment, Scene
from cvqmpt_lab.scene.shapes import (
    Box,
    ConvexMesh,
    Cylinder,
    Measured,
    PointCloud,
    Shape,
    Sphere,
    bounding_radius,
)

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
    for item in scene.obstacles:
        position = float(np.linalg.norm(item.T_world_object[:3, 3]))
        if isinstance(item.shape, Measured) or position - bounding_radius(item.shape) <= reach:
            yield from solids(item.name, item.shape, item.T_world_object, reach)


def solids(
    name: str, shape: Shape, T: np.ndarray, reach: float = np.inf, most_balls: int = MOST_BALLS
) -> Iterator[Solid]:
    """The shape itself at pose T; of a small cloud its balls; of a large one and of a map, boxes in reach."""
    if not isinstance(shape, Measured):
        yield Solid(name, coal_shape(shape), T)
    elif isinstance(shape, PointCloud) and len(shape.points) <= most_balls:
        for k, point in enumerate(shape.points):
            T_ball = T.copy()
            T_ball[:3, 3] += T[:3, :3] @ point
            yield Solid(f"{name}/{k}", coal.Sphere(shape.radius), T_ball)
    elif (cells := cells_of(shape, T, reach)) is not None:
        yield from _cell_solids(name, cells)


def _cell_solids(name: str, cells: Cells) -> Iterator[Solid]:
    """Cells, joined to boxes: three times as fast to check as coal's octrees, which descend from 2^16 cells."""
    low, high = merged(cells.index)
    sizes, kind = np.unique(high - low, axis=0, return_inverse=True)
    shapes = [coal.Box(*edges) for edges in cells.edge * sizes]
    for shape in shapes:
        shape.setSweptSphereRadius(cells.padding)
    poses = np.tile(cells.T_parent_cells, (len(low), 1, 1))
    poses[:, :3, 3] += 0.5 * cells.edge * (low + high) @ cells.T_parent_cells[:3, :3].T
    for k, T in zip(kind.tolist(), poses, strict=True):
        yield Solid(name, shapes[k], T)


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
