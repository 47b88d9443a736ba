"""Meshes from files: STL, OBJ, DAE, as convex pieces that hold all of the surface."""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.forms import FloatArray
from cvqmpt_lab.scene.files.convex_pieces import convex_pieces
from cvqmpt_lab.scene.files.reading import file_bytes, kind_of, parsing

KINDS: Mapping[str, str] = {".stl": "stl", ".obj": "obj", ".dae": "dae"}
"""What the parser calls a file, by its suffix."""
MOST_TRIANGLES = 200_000


def read_mesh(path: Path | str, scale: float = 1.0) -> tuple[FloatArray, ...]:
    """Read a mesh as vertices (k, 3) [m] of convex pieces; see `convex_pieces`.

    Parameters
    ----------
    scale: [m] of one unit of the file.

    Raises
    ------
    UnknownChoiceError: another suffix than those of `KINDS`.
    InvalidInputError: a file that cannot be read, has no triangle, too many, or none that span a volume, or is
        evidently not in metres; names the file.
    """
    path = Path(path)
    triangles = scale * read_triangles(path)
    with parsing(path, "mesh"):
        return convex_pieces(triangles)


def read_triangles(path: Path) -> FloatArray:
    """The corners (f, 3, 3) of a file's triangles, in its own unit."""
    kind = KINDS[kind_of(path, KINDS, "mesh")]
    data = file_bytes(path, "mesh")
    with parsing(path, "mesh"):
        mesh = trimesh.load(io.BytesIO(data), file_type=kind, force="mesh", process=False)
        vertices = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
        if len(faces) == 0:
            raise InvalidInputError("it has no triangle")
        if len(faces) > MOST_TRIANGLES:
            raise InvalidInputError(f"it has {len(faces)} triangles; {MOST_TRIANGLES} at most: simplify it")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InvalidInputError(f"a triangle has a corner that is none of its {len(vertices)} vertices")
        corners = vertices[faces]
        if not np.isfinite(corners).all():
            raise InvalidInputError("a corner of a triangle is not finite")
    return corners
