"""The collision arrays of robots, kept in the user's cache: cutting hulls into pieces takes a quarter of a second."""

from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.disk_cache import kept_arrays
from cvqmpt_lab.jit import SOURCES
from cvqmpt_lab.kernels.collision.geometry import RobotGeometry, robot_geometry
from cvqmpt_lab.kernels.collision.separation import ConvexShapes
from cvqmpt_lab.kernels.collision.shapes import ShapeSpec

PIECES = "pieces."
"""Before the names of the arrays of `RobotGeometry.pieces`."""


def stored_robot_geometry(
    specs: Sequence[ShapeSpec], link: Sequence[int], pairs: Sequence[tuple[int, int]]
) -> RobotGeometry:
    """What `robot_geometry` makes of its arguments, read from the cache where it is there."""

    def arrays() -> dict[str, np.ndarray]:
        made = robot_geometry(specs, link, pairs)
        pieces = {PIECES + name: array for name, array in made.pieces._asdict().items()}
        return pieces | {name: value for name, value in made._asdict().items() if name != "pieces"}

    found = kept_arrays("robot_geometry", _made_of(specs, link, pairs), arrays)
    pieces = ConvexShapes(*(found.pop(PIECES + name) for name in ConvexShapes._fields))
    return RobotGeometry(pieces=pieces, largest=float(found.pop("largest")), **found)


def _made_of(specs: Sequence[ShapeSpec], link: Sequence[int], pairs: Sequence[tuple[int, int]]) -> bytes:
    parts = [f"{SOURCES} {list(link)} {list(pairs)}".encode()]
    for spec in specs:
        parts.append(f"{spec.kind} {spec.size} {spec.vertices.shape}".encode())
        parts += (spec.vertices.tobytes(), spec.T_owner_shape.tobytes())
    return b"".join(parts)
