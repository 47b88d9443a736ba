"""Shapes as plain data: boxes, cylinders, spheres, convex meshes and inflated point clouds.

A shape lives in its own frame; `SceneObject` places it in the world. Lengths are in [m].
"""

import itertools
import math
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from cvqmpt_lab.codec.forms import Array, FloatArray, Length, Tagged
from cvqmpt_lab.codec.plain import Checked
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.extent import check_volume
from cvqmpt_lab.scene.files.named import SHAPES_BY_PATH

Points = Annotated[FloatArray, Array((None, 3), "points x, y, z [m]")]


@dataclass(frozen=True, eq=False)
class Box(Checked):
    """A box centred on its frame, edges along the axes."""

    size: tuple[Length, Length, Length]
    """Full edge lengths along x, y, z [m]."""


@dataclass(frozen=True, eq=False)
class Cylinder(Checked):
    """A cylinder centred on its frame, axis along z."""

    radius: Length
    """[m]."""
    height: Length
    """Full height [m]."""


@dataclass(frozen=True, eq=False)
class Sphere(Checked):
    """A sphere centred on its frame."""

    radius: Length
    """[m]."""


@dataclass(frozen=True, eq=False)
class ConvexMesh(Checked):
    """The convex hull of some points."""

    vertices: Points
    """(n, 3), four or more, not all in one plane [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_volume(self.vertices, "vertices")


@dataclass(frozen=True, eq=False)
class PointCloud(Checked):
    """An obstacle made of points, each inflated to a ball."""

    points: Points
    """(n, 3), ball centres [m]."""
    radius: Length
    """Of every ball [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.points) == 0:
            raise InvalidInputError("PointCloud.points is empty: give one or more")


SHAPES = {
    "box": Box,
    "cylinder": Cylinder,
    "sphere": Sphere,
    "convex_mesh": ConvexMesh,
    "point_cloud": PointCloud,
}
"""Shapes by the "type" that json calls them."""

Shape: TypeAlias = Annotated[
    Box | Cylinder | Sphere | ConvexMesh | PointCloud, Tagged("type", SHAPES, SHAPES_BY_PATH)
]


def shape_vertices(shape: Box | ConvexMesh) -> FloatArray:
    """Return the (n, 3) corner points [m] whose convex hull the shape is, in the shape's frame.

    Raises
    ------
    InvalidInputError
        If the shape is round or a point cloud and therefore has no corners.
    """
    if isinstance(shape, Box):
        return 0.5 * np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * np.array(shape.size)
    if isinstance(shape, ConvexMesh):
        return shape.vertices
    raise InvalidInputError(f"{type(shape).__name__} has no corner points; valid shapes: Box, ConvexMesh")


def bounding_radius(shape: Shape) -> float:
    """Return the radius [m] of the smallest ball around the shape's frame origin that holds the shape."""
    match shape:
        case Box() | ConvexMesh():
            return float(np.linalg.norm(shape_vertices(shape), axis=1).max())
        case Cylinder(radius, height):
            return math.hypot(radius, 0.5 * height)
        case Sphere(radius):
            return radius
        case PointCloud(points, radius):
            return float(np.linalg.norm(points, axis=1).max()) + radius
