"""The collision arrays of robots, kept in the user's cache: cutting hulls into pieces takes a quarter of a second.

A file is named after all that its arrays are made of, sources of the kernels included.
"""

import hashlib
import zipfile
from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.files import cache_folder, make_folder, replacing
from cvqmpt_lab.kernels.collision.geometry import RobotGeometry, robot_geometry
from cvqmpt_lab.kernels.collision.separation import ConvexShapes
from cvqmpt_lab.kernels.collision.shapes import ShapeSpec
from cvqmpt_lab.kernels.objects import SOURCES

PIECES = "pieces."
"""Before the names of the arrays of `RobotGeometry.pieces`."""


def stored_robot_geometry(
    specs: Sequence[ShapeSpec], link: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> RobotGeometry:
    """What `robot_geometry` makes of its arguments, read from the cache where it is there."""
    path = cache_folder() / "robot_geometry" / f"{_digest(specs, link, pairs)}.npz"
    try:
        with np.load(path) as arrays:
            return _bundle(dict(arrays))
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):  # not there yet, or not whole
        made = robot_geometry(specs, link, pairs)
    pieces = {PIECES + name: array for name, array in made.pieces._asdict().items()}
    try:
        make_folder(path.parent)
        with replacing(path) as temporary, temporary.open("wb") as handle:
            np.savez(handle, **pieces, **{k: v for k, v in made._asdict().items() if k != "pieces"})
    except InvalidInputError:  # made again the next time
        pass
    return made


def _bundle(arrays: dict[str, np.ndarray]) -> RobotGeometry:
    pieces = ConvexShapes(*(arrays.pop(PIECES + name) for name in ConvexShapes._fields))
    return RobotGeometry(pieces=pieces, largest=float(arrays.pop("largest")), **arrays)


def _digest(specs: Sequence[ShapeSpec], link: Sequence[int], pairs: Sequence[tuple[int, int]]) -> str:
    digest = hashlib.sha256(f"{SOURCES} {list(link)} {list(pairs)}".encode())
    for spec in specs:
        digest.update(f"{spec.kind} {spec.size} {spec.vertices.shape}".encode())
        digest.update(spec.vertices.tobytes() + spec.T_owner_shape.tobytes())
    return digest.hexdigest()[:32]
