"""Read STL, OBJ and DAE meshes, as convex pieces that together contain the whole surface."""

import io
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.urdf import collada_unit
from cvqmpt_lab.scene.cloud_files import check_lengths, parsing, read_by_suffix
from cvqmpt_lab.scene.convex import convex_pieces
from cvqmpt_lab.values import FloatArray

MOST_TRIANGLES = 200_000  # of a file


def read_mesh(path: Path | str, scale: float = 1.0) -> tuple[FloatArray, ...]:
    """Read a mesh as convex pieces that together contain its whole surface; see `convex_pieces`.

    Args:
        path: of the file.
        scale: length of one unit of the file [m]. A DAE file states its own unit: its lengths are
            converted to metres first, and then multiplied by `scale`. Its up axis is ignored.
            Meshes of robots are read in the same way.

    Returns:
        Vertices (k, 3) [m] of each piece.

    Raises InvalidInputError if the file cannot be read, has no triangle or more than
    `MOST_TRIANGLES`, spans no volume, or has lengths that are evidently not metres.
    """
    triangles = scale * read_triangles(path)
    check_lengths(triangles.reshape(-1, 3), f"mesh {path}", room=20.0)
    with parsing(Path(path), "mesh"):
        return convex_pieces(triangles)


def read_triangles(path: Path | str) -> FloatArray:
    """Corners (f, 3, 3) of the triangles of a file, in its unit; those of a DAE file in metres."""
    return read_by_suffix(READERS, path, "mesh")


def _triangles(kind: str, data: bytes) -> FloatArray:
    """Corners (f, 3, 3) of the triangles in the content of a file of a kind, e.g. "stl"."""
    if kind == "obj":
        # the encoding may not be UTF-8, and trimesh skips lines that begin with tabs or blanks
        lines = data.decode("utf-8", errors="replace").splitlines()
        data = "\n".join(" ".join(line.split()) for line in lines).encode()
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False)
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if len(faces) == 0:
        raise InvalidInputError("it has no triangle: cut short?")
    # trimesh leaves out triangles that follow the end of a solid in a text STL
    stated = data.lower().count(b"endfacet") if kind == "stl" else 0
    if stated not in (0, len(faces)):
        raise InvalidInputError(f"{len(faces)} of its {stated} triangles belong to a solid")
    if len(faces) > MOST_TRIANGLES:
        raise InvalidInputError(
            f"it has {len(faces)} triangles; {MOST_TRIANGLES} at most: simplify it"
        )
    corners = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3)[faces]
    if not np.isfinite(corners).all():
        raise InvalidInputError("a corner of a triangle is not finite")
    return collada_unit(data) * corners if kind == "dae" else corners


READERS = {f".{kind}": partial(_triangles, kind) for kind in ("stl", "obj", "dae")}
"""Readers of meshes by the file's suffix."""
