"""Shapes as plain data: boxes, cylinders, spheres, convex meshes, point clouds, occupancy maps.

A shape lives in its own frame; `SceneObject` places it in the world. Lengths are in [m].
"""

from __future__ import annotations  # so `help` shows forms by their names

import itertools
import math
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np

from cvqmpt_lab.base.codec import Checked, Tagged
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.values import MAX_LENGTH_M, Array, FloatArray, Length, Name, Padding

Points = Annotated[FloatArray, Array((None, 3), "points x, y, z [m]", MAX_LENGTH_M)]
MIN_THICKNESS = 1e-4  # [m] below which hulls are not built: their faces would be noise


def thickness(points: FloatArray) -> float:
    """Extent [m] of points (n, 3) in the direction in which they extend least."""
    centred = points - points.mean(axis=0)
    thinnest = np.linalg.eigh(centred.T @ centred)[1][:, 0]  # the normal of flat ones
    return float(np.ptp(points @ thinnest))


def check_volume(points: FloatArray, what: str, most: float = 1e4) -> None:
    """Refuse finite points (n, 3) [m] of no volume, or too thin or too far for collision checks.

    most: distance of a corner from its frame [m].
    """
    farthest = float(np.abs(points).max(initial=0.0))
    if farthest > most:
        raise InvalidInputError(
            f"{what} must lie within {most:g} m of their frame, one is {farthest:.3g} m off: "
            "give metres"
        )
    if len(points) < 4 or thickness(points) < MIN_THICKNESS:
        raise InvalidInputError(
            f"{what} must span a volume: give 4 or more points that are not in one plane, and at "
            f"least {1e3 * MIN_THICKNESS:g} mm thick, got {len(points)} points"
        )


@dataclass(frozen=True, eq=False)
class CloudFile(Checked):
    """In json in place of a PointCloud: the path of its points, see `cloud_files.READERS`."""

    path: Name  # of the file, from the folder of the one that names it
    radius: Length  # of the ball around every point [m]
    scale: Length = 1.0  # [m] of one unit of the file


@dataclass(frozen=True, eq=False)
class MapFile(Checked):
    """In place of an OccupancyMap: the path of its points; their cells are the occupied ones."""

    path: Name  # of the file, from the folder of the one that names it
    resolution: Length = 0.02  # edge of the cells [m]
    padding: Padding = 0.0  # inflation radius of the cells [m]
    scale: Length = 1.0  # [m] of one unit of the file


@dataclass(frozen=True, eq=False)
class MeshFile(Checked):
    """A mesh of a file, see `mesh_files.READERS`, as one ConvexMesh or several."""

    path: Name  # of the file, from the folder of the one that names it
    scale: Length = 1.0  # [m] of one unit of the file


# by "type" in json
SHAPES_BY_PATH = {"cloud_file": CloudFile, "map_file": MapFile, "mesh_file": MeshFile}


@dataclass(frozen=True)
class WholeNumbers(Array):
    """Integer indices of cells."""

    farthest: int = 1_000_000  # cell along an axis

    def read(self, value: Any, where: str) -> FloatArray:
        """Refuse fractions, and cells farther than any sensor sees."""
        array = super().read(value, where)
        wrong = (array != np.rint(array)) | (np.abs(array) > self.farthest)
        if wrong.any():
            raise InvalidInputError(
                f"{where} holds {array[wrong][0]:g}; give whole numbers from {-self.farthest} to "
                f"{self.farthest}"
            )
        return array

    def write(self, value: FloatArray) -> list:
        """A list of integers."""
        return value.astype(np.int64).tolist()


@dataclass(frozen=True, eq=False)
class Box(Checked):
    """A box centred on its frame, edges along the axes."""

    size: tuple[Length, Length, Length]  # full edge lengths along x, y, z [m]


@dataclass(frozen=True, eq=False)
class Cylinder(Checked):
    """A cylinder centred on its frame, axis along z."""

    radius: Length  # [m]
    height: Length  # full height [m]


@dataclass(frozen=True, eq=False)
class Sphere(Checked):
    """A sphere centred on its frame."""

    radius: Length  # [m]


@dataclass(frozen=True, eq=False)
class ConvexMesh(Checked):
    """The convex hull of some points."""

    vertices: Points  # (n, 3), four or more, not all in one plane [m]

    def _check(self) -> None:
        check_volume(self.vertices, "vertices")


@dataclass(frozen=True, eq=False)
class PointCloud(Checked):
    """An obstacle made of points, each inflated to a ball."""

    points: Points  # (n, 3), ball centres [m]
    radius: Length  # of every ball [m]

    def _check(self) -> None:
        if len(self.points) == 0:
            raise InvalidInputError("PointCloud.points is empty: give one or more")


@dataclass(frozen=True, eq=False)
class OccupancyMap(Checked):
    """Occupied cubes of a regular grid (as in OctoMap); what is not listed is free."""

    cells: Annotated[FloatArray, WholeNumbers((None, 3), "whole numbers i, j, k of cells")]
    """(k, 3); cell (i, j, k) spans resolution * (i, j, k) to resolution * (i + 1, j + 1, k + 1)."""
    resolution: Length = 0.02  # edge of every cube [m]
    padding: Padding = 0.0  # inflation radius of every cube, to all sides [m]

    def _check(self) -> None:
        if len(self.cells) == 0:
            raise InvalidInputError(
                "OccupancyMap.cells is empty: leave the object out of the scene"
            )
        require_resolution(self.resolution)

    @property
    def centres(self) -> FloatArray:
        """Centres (k, 3) of the cells [m]."""
        return (self.cells + 0.5) * self.resolution


def require_resolution(resolution: float, finest: float = 1e-3) -> None:
    """Refuse cells [m] so fine that indices would measure noise, before any are counted."""
    if not resolution >= finest:
        raise InvalidInputError(
            f"OccupancyMap.resolution is {resolution:g} m; give {finest:g} m or more"
        )


Measured = PointCloud | OccupancyMap  # what sensors make of a world
# by "type" in json
SHAPES = {"box": Box, "cylinder": Cylinder, "sphere": Sphere, "convex_mesh": ConvexMesh}
SHAPES |= {"point_cloud": PointCloud, "occupancy_map": OccupancyMap}
Shape: TypeAlias = Annotated[
    Box | Cylinder | Sphere | ConvexMesh | PointCloud | OccupancyMap,
    Tagged("type", SHAPES, SHAPES_BY_PATH),
]


def shape_vertices(shape: Box | ConvexMesh) -> FloatArray:
    """Return the (n, 3) corner points [m] whose convex hull the shape is, in the shape's frame."""
    if isinstance(shape, Box):
        return 0.5 * np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * np.array(shape.size)
    if isinstance(shape, ConvexMesh):
        return shape.vertices
    raise InvalidInputError(
        f"{type(shape).__name__} has no corner points; valid shapes: Box, ConvexMesh"
    )


def bounding_radius(shape: Shape) -> float:
    """Radius [m] of the smallest ball around the shape's frame origin that holds the shape."""
    match shape:
        case Box(size):
            return 0.5 * math.hypot(*size)
        case ConvexMesh():
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
