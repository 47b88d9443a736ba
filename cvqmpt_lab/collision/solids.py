"""Shapes as pieces for coal: obstacles within a robot's reach, and its attachments."""

from collections.abc import Iterator
from typing import NamedTuple

import coal
import numpy as np

from cvqmpt_lab.scene.cells import blocks_of
from cvqmpt_lab.scene.coal_shapes import coal_shape
from cvqmpt_lab.scene.scene import Scene
from cvqmpt_lab.scene.shapes import Measured, PointCloud, Shape


class Solid(NamedTuple):
    """One piece of collision geometry."""

    name: str
    shape: coal.CollisionGeometry
    T_parent_shape: np.ndarray  # (4, 4), pose in the world or in the hand [m]


def obstacles_within(scene: Scene, reach: float) -> Iterator[Solid]:
    """Obstacles of a scene within `reach` [m] of the world's origin."""
    for item in scene.obstacles:
        position = float(np.linalg.norm(item.T_world_object[:3, 3]))
        if isinstance(item.shape, Measured) or position - item.shape.bounding_radius <= reach:
            yield from solids(item.name, item.shape, item.T_world_object, reach)


def solids(name: str, shape: Shape, T: np.ndarray, reach: float = np.inf) -> Iterator[Solid]:
    """Pieces of a shape: a solid is one, a small cloud balls, a large cloud or a map boxes.

    Boxes are three times as fast to check as coal's octrees, which descend from 2^16 cells.

    Args:
        name: name of the shape.
        shape: a solid, cloud or map.
        T: its pose (4, 4) in the world or in the hand [m].
        reach: boxes further than this from the origin of that frame may be left out [m].
    """
    if not isinstance(shape, Measured):
        yield Solid(name, coal_shape(shape), T)
        return
    blocks = blocks_of(shape, T, reach)
    ball, edges = coal.Sphere(blocks.padding), blocks.high - blocks.low
    numbered = isinstance(shape, PointCloud) and len(edges) == len(shape.points)
    for k, T_block in enumerate(blocks.poses(T)):
        core = ball
        if edges[k].any():
            core = coal.Box(edges[k])
            core.setSweptSphereRadius(blocks.padding)
        yield Solid(f"{name}/{k}" if numbered else name, core, T_block)
