"""Meshes from files: STL, OBJ, DAE, as convex pieces that hold all of the surface."""

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

MOST_TRIANGLES = 200_000


def read_mesh(path: Path | str, scale: float = 1.0) -> tuple[FloatArray, ...]:
    """Read a mesh as convex pieces that hold all of its surface; see `convex_pieces`.

    Args:
        path: of the file. The unit that a DAE file states is applied before `scale`, and which axis
            it calls up is ignored, both as for meshes of robots.
        scale: length of one unit of the file [m].

    Returns: vertices (k, 3) [m] of each piece.

    Raises InvalidInputError for a file that cannot be read, has no triangle, too many, or none that
    span a volume, or is evidently not in metres.
    """
    path = Path(path)
    triangles = scale * read_triangles(path)
    check_lengths(triangles.reshape(-1, 3), f"mesh {path}", room=20.0)
    with parsing(path, "mesh"):
        return convex_pieces(triangles)


def read_triangles(path: Path) -> FloatArray:
    """The corners (f, 3, 3) of a file's triangles, in its own unit."""
    return read_by_suffix(READERS, path, "mesh")


def _triangles(kind: str, data: bytes) -> FloatArray:
    if kind == "obj":
        # may have another encoding; trimesh passes over lines with tabs or blanks in front
        lines = data.decode("utf-8", errors="replace").splitlines()
        data = "\n".join(" ".join(line.split()) for line in lines).encode()
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False)
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if len(faces) == 0:
        raise InvalidInputError("it has no triangle: cut short?")
    # of the text form, from which trimesh leaves out what follows the end of a solid
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
"""Of meshes, by the file's suffix."""
