"""Shapes as plain data: boxes, cylinders, spheres, convex meshes, inflated point clouds and occupancy maps.

A shape lives in its own frame; `SceneObject` places it in the world. Lengths are in [m].
"""

import itertools
import math
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np

from cvqmpt_lab.codec.forms import Array, FloatArray, Length, Padding, Tagged
from cvqmpt_lab.codec.plain import Checked
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.extent import check_volume
from cvqmpt_lab.scene.files.named import SHAPES_BY_PATH

Points = Annotated[FloatArray, Array((None, 3), "points x, y, z [m]")]
FINEST = 1e-3  # [m] edge of a map's cells, below which indices would be measuring noise
FARTHEST_CELL = 1_000_000  # along an axis


class WholeNumbers(Array):
    """Indices of cells."""

    def read(self, value: Any, where: str) -> FloatArray:
        """Refuse fractions, and what is farther than any sensor sees."""
        array = super().read(value, where)
        wrong = (array != np.rint(array)) | (np.abs(array) > FARTHEST_CELL)
        if wrong.any():
            raise InvalidInputError(
                f"{where} holds {array[wrong][0]:g}; give whole numbers from {-FARTHEST_CELL} to {FARTHEST_CELL}"
            )
        return array

    def write(self, value: FloatArray) -> list:
        """Integers."""
        return value.astype(np.int64).tolist()


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


@dataclass(frozen=True, eq=False)
class OccupancyMap(Checked):
    """Occupied cubes of a regular grid, as an occupancy grid (OctoMap) holds them; what is not listed is free."""

    cells: Annotated[FloatArray, WholeNumbers((None, 3), "whole numbers i, j, k of cells")]
    """(k, 3); cell (i, j, k) reaches from resolution * (i, j, k) to resolution * (i + 1, j + 1, k + 1)."""
    resolution: Length = 0.02
    """Edge of every cube [m]."""
    padding: Padding = 0.0
    """Distance by which every cube is swelled, to all sides [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.cells) == 0:
            raise InvalidInputError("OccupancyMap.cells is empty: leave the object out of the scene")
        if self.resolution < FINEST:
            raise InvalidInputError(
                f"OccupancyMap.resolution is {self.resolution:g} m; give {FINEST:g} m or more"
            )

    @property
    def centres(self) -> FloatArray:
        """(k, 3), of the cells [m]."""
        return (self.cells + 0.5) * self.resolution


Measured = PointCloud | OccupancyMap
"""What sensors make of a world, of which cameras have seen all that can be seen."""

SHAPES = {
    "box": Box,
    "cylinder": Cylinder,
    "sphere": Sphere,
    "convex_mesh": ConvexMesh,
    "point_cloud": PointCloud,
    "occupancy_map": OccupancyMap,
}
"""Shapes by the "type" that json calls them."""

Shape: TypeAlias = Annotated[
    Box | Cylinder | Sphere | ConvexMesh | PointCloud | OccupancyMap, Tagged("type", SHAPES, SHAPES_BY_PATH)
]


def shape_vertices(shape: Box | ConvexMesh) -> FloatArray:
    """Return the (n, 3) corner points [m] whose convex hull the shape is, in the shape's frame.

    Raises
    ------
    InvalidInputError
        If the shape is round, a point cloud or a map, and therefore has no corners.
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
        case OccupancyMap(_, resolution, padding):
            farthest = np.linalg.norm(np.abs(shape.centres) + 0.5 * resolution, axis=1).max()
            return float(farthest) + padding
