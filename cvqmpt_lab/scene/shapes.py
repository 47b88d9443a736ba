"""Shapes as plain data: boxes, cylinders, spheres, convex meshes, point clouds, occupancy maps.

A shape has its own frame; `SceneObject` gives its pose in the world. Lengths are in [m].
"""

from __future__ import annotations  # `help` then shows types by their names

import math
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np

from cvqmpt_lab.base.codec import Checked, Tagged
from cvqmpt_lab.base.convex import MIN_THICKNESS_M, box_corners, require_volume
from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.base.values import MAX_LENGTH_M, Array, FloatArray, Length, Name, Padding

Points = Annotated[FloatArray, Array((None, 3), "points x, y, z [m]", MAX_LENGTH_M)]


@dataclass(frozen=True, eq=False)
class CloudFile(Checked):
    """Stands for a PointCloud in JSON: a file of points, see `cloud_files.CLOUD_READERS`."""

    path: Name  # relative to the folder of the JSON file
    radius: Length  # radius of the ball around every point [m]
    scale: Length = 1.0  # length of one unit of the file [m]


@dataclass(frozen=True, eq=False)
class MapFile(Checked):
    """Stands for an OccupancyMap in JSON: a file of points, whose cells are occupied."""

    path: Name  # relative to the folder of the JSON file
    resolution: Length = 0.02  # edge of the cells [m]
    padding: Padding = 0.0  # inflation radius of the cells [m]
    scale: Length = 1.0  # length of one unit of the file [m]


@dataclass(frozen=True, eq=False)
class MeshFile(Checked):
    """Stands for one or more ConvexMesh in JSON: a mesh file, see `mesh_files.read_mesh`."""

    path: Name  # relative to the folder of the JSON file
    scale: Length = 1.0  # length of one unit of the file [m]


# classes by "type" in JSON, for shapes that are stored in another file
SHAPES_BY_PATH = {"cloud_file": CloudFile, "map_file": MapFile, "mesh_file": MeshFile}


@dataclass(frozen=True)
class WholeNumbers(Array):
    """Array format of the integer indices of cells."""

    farthest: int = 1_000_000  # largest absolute index

    def read(self, value: Any, where: str) -> FloatArray:
        """Return the array; refuse fractions and cells beyond the range of sensors."""
        array = super().read(value, where)
        wrong = (array != np.rint(array)) | (np.abs(array) > self.farthest)
        if wrong.any():
            raise InvalidInputError(
                f"{where} holds {array[wrong][0]:g}; give whole numbers from {-self.farthest} to "
                f"{self.farthest}"
            )
        return array

    def write(self, value: FloatArray) -> list:
        """Return a list of integers."""
        return value.astype(np.int64).tolist()


@dataclass(frozen=True, eq=False)
class Box(Checked):
    """A box centred at the origin of its frame, with edges along the axes."""

    size: tuple[Length, Length, Length]  # full edge lengths along x, y, z [m]

    @property
    def half(self) -> FloatArray:
        """Half edge lengths (3,) [m]."""
        return 0.5 * np.array(self.size)

    @property
    def vertices(self) -> FloatArray:
        """Corners (8, 3) [m]."""
        return box_corners(-self.half, self.half)

    @property
    def bounding_radius(self) -> float:
        """Largest distance of a point from the origin [m]."""
        return 0.5 * math.hypot(*self.size)


@dataclass(frozen=True, eq=False)
class Cylinder(Checked):
    """A cylinder along z, centred at the origin of its frame."""

    radius: Length  # [m]
    height: Length  # full height [m]

    @property
    def half(self) -> FloatArray:
        """Half extents (3,) along the axes [m]."""
        return np.array([self.radius, self.radius, 0.5 * self.height])

    @property
    def bounding_radius(self) -> float:
        """Largest distance of a point from the origin [m]."""
        return math.hypot(self.radius, 0.5 * self.height)


@dataclass(frozen=True, eq=False)
class Sphere(Checked):
    """A sphere centred at the origin of its frame."""

    radius: Length  # [m]

    @property
    def bounding_radius(self) -> float:
        """Largest distance of a point from the origin [m]."""
        return self.radius


@dataclass(frozen=True, eq=False)
class ConvexMesh(Checked):
    """The convex hull of points."""

    vertices: Points  # (n, 3), n >= 4, not in one plane [m]

    def _check(self) -> None:
        require_volume(self.vertices, "a convex mesh", MIN_THICKNESS_M)

    @property
    def bounding_radius(self) -> float:
        """Largest distance of a point from the origin [m]."""
        return float(np.linalg.norm(self.vertices, axis=1).max())


@dataclass(frozen=True, eq=False)
class PointCloud(Checked):
    """Points that are inflated to balls."""

    points: Points  # (n, 3) centres of the balls [m]
    radius: Length  # radius of every ball [m]

    def _check(self) -> None:
        if len(self.points) == 0:
            raise InvalidInputError("PointCloud.points is empty: give one or more")

    @property
    def bounding_radius(self) -> float:
        """Largest distance of a point from the origin [m]."""
        return float(np.linalg.norm(self.points, axis=1).max()) + self.radius


@dataclass(frozen=True, eq=False)
class OccupancyMap(Checked):
    """Occupied cells of a regular grid (as in OctoMap); all other cells are free."""

    cells: Annotated[FloatArray, WholeNumbers((None, 3), "whole numbers i, j, k of cells")]
    """(k, 3); cell (i, j, k) is from resolution (i, j, k) to resolution (i + 1, j + 1, k + 1)."""
    resolution: Length = 0.02  # edge of the cells [m]
    padding: Padding = 0.0  # inflation radius of the cells [m]

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

    @property
    def bounding_radius(self) -> float:
        """Largest distance of a point from the origin [m]."""
        farthest_corners = np.abs(self.centres) + 0.5 * self.resolution
        return float(np.linalg.norm(farthest_corners, axis=1).max()) + self.padding


def require_resolution(resolution: float, finest: float = 1e-3) -> None:
    """Refuse cells smaller than `finest` [m], which is already below the noise of sensors."""
    if not resolution >= finest:
        raise InvalidInputError(
            f"OccupancyMap.resolution is {resolution:g} m; give {finest:g} m or more"
        )


Measured = PointCloud | OccupancyMap  # shapes made from data of sensors
# classes by "type" in JSON
SHAPE_CLASSES = {"box": Box, "cylinder": Cylinder, "sphere": Sphere, "convex_mesh": ConvexMesh}
SHAPE_CLASSES |= {"point_cloud": PointCloud, "occupancy_map": OccupancyMap}
Shape: TypeAlias = Annotated[
    Box | Cylinder | Sphere | ConvexMesh | PointCloud | OccupancyMap,
    Tagged("type", SHAPE_CLASSES, SHAPES_BY_PATH),
]
