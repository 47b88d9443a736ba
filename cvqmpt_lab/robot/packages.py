"""Where the files of a robot lie: its meshes, and the descriptions that example-robot-data installs."""

import os
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path

from cvqmpt_lab.errors import InvalidInputError

EXAMPLES = "example-robot-data"
ROS_VARIABLE = "ROS_PACKAGE_PATH"
SCHEME = "package://"


def example_robots() -> Path:
    """The folder of robot descriptions that the wheel of example-robot-data installed."""
    robots = _installed_share() / EXAMPLES / "robots"
    if not robots.is_dir():
        raise InvalidInputError(f"robots by name need their descriptions: pip install {EXAMPLES}")
    return robots


def _installed_share() -> Path:
    """The share folder that holds example-robot-data, whether or not it does."""
    shares = [Path(entry) / "cmeel.prefix" / "share" for entry in sys.path]
    return next((share for share in shares if (share / EXAMPLES).is_dir()), Path(sys.prefix) / "share")


def find_collision_meshes(root: ElementTree.Element, urdf: Path, package_dirs: Sequence[Path]) -> None:
    """Replace the names of collision meshes in a URDF by absolute paths.

    Raises
    ------
    InvalidInputError
        Naming a mesh that is in none of the places where its package may lie, and these places.
    """
    for mesh in root.findall("link/collision/geometry/mesh"):
        name = mesh.get("filename", "")
        if not name.startswith(SCHEME):
            path = urdf.parent / name.removeprefix("file://")
            if not path.is_file():
                raise InvalidInputError(f"{urdf.name}: mesh {name!r} is not there: {path} is no file")
        else:
            package, _, rest = name.removeprefix(SCHEME).partition("/")
            path = _in_package(package, rest, urdf, package_dirs)
        mesh.set("filename", str(path.resolve()))


def _in_package(package: str, rest: str, urdf: Path, package_dirs: Sequence[Path]) -> Path:
    for folder in (*package_dirs, *_ros_folders(), *urdf.resolve().parents, _installed_share()):
        for path in _inside(Path(folder), package, rest):
            if path.is_file():
                return path
    given = ", ".join(str(folder) for folder in package_dirs) or "not given"
    raise InvalidInputError(
        f"{urdf.name}: mesh {SCHEME}{package}/{rest} is in none of these places: --package-dir ({given}), "
        f"{ROS_VARIABLE} ({os.environ.get(ROS_VARIABLE) or 'not set'}), the folders above {urdf.resolve().parent}; "
        f"give --package-dir DIR, the folder that holds {package}"
    )


def _inside(folder: Path, package: str, rest: str) -> Iterator[Path]:
    """Where a file of a package may lie, when `folder` holds the package or is it."""
    yield folder / package / rest
    if folder.name == package:
        yield folder / rest


def _ros_folders() -> list[Path]:
    return [Path(folder) for folder in os.environ.get(ROS_VARIABLE, "").split(os.pathsep) if folder]
