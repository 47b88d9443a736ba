"""What stands in a json file in the place of a shape that a file of its own holds."""

from dataclasses import dataclass

from cvqmpt_lab.codec.forms import Length, Name, Padding
from cvqmpt_lab.codec.plain import Checked


@dataclass(frozen=True, eq=False)
class CloudFile(Checked):
    """Points of a file, see `clouds.READERS`, as a PointCloud."""

    path: Name
    """Of the file, from the folder of the one that names it."""
    radius: Length
    """Of the ball around every point [m]."""
    scale: Length = 1.0
    """[m] of one unit of the file."""


@dataclass(frozen=True, eq=False)
class MapFile(Checked):
    """Points of a file, see `clouds.READERS`, as the OccupancyMap of the cells that hold some."""

    path: Name
    """Of the file, from the folder of the one that names it."""
    resolution: Length = 0.02
    """Edge of the cells [m]."""
    padding: Padding = 0.0
    """Distance by which cells are swelled [m]."""
    scale: Length = 1.0
    """[m] of one unit of the file."""


@dataclass(frozen=True, eq=False)
class MeshFile(Checked):
    """A mesh of a file, see `meshes.KINDS`, as one ConvexMesh or several."""

    path: Name
    """Of the file, from the folder of the one that names it."""
    scale: Length = 1.0
    """[m] of one unit of the file."""


SHAPES_BY_PATH = {"cloud_file": CloudFile, "map_file": MapFile, "mesh_file": MeshFile}
"""By the "type" that json calls them."""
