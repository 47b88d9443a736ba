"""Meshes of STL, OBJ and DAE files as convex pieces that contain surface and closed inside."""

import io
import re
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from cvqmpt_lab.base.convex_pieces import convex_pieces
from cvqmpt_lab.base.errors import InvalidInputError, shown
from cvqmpt_lab.base.readers import parsing, read_by_suffix
from cvqmpt_lab.base.values import FloatArray
from cvqmpt_lab.robot.urdf_bodies import collada_unit
from cvqmpt_lab.scene.cloud_files import check_lengths

MAX_TRIANGLES = 200_000  # largest number of triangles of a file


def read_mesh(path: Path | str, scale: float = 1.0) -> tuple[FloatArray, ...]:
    """Read a mesh as convex pieces that together contain its surface, see `convex_pieces`.

    Args:
        path: path of the file.
        scale: length of one unit of the file [m]. The lengths of a DAE file are converted to metres
            first, by the unit that it states, and then multiplied by `scale`; its up axis is
            ignored. Meshes of robots are read in the same way.

    Returns:
        Vertices (k, 3) [m] of each piece.

    Raises:
        InvalidInputError: the file cannot be read, has no triangle or more than `MAX_TRIANGLES`,
            has no volume, or is evidently not in metres.
    """
    triangles = scale * read_triangles(path)
    check_lengths(triangles.reshape(-1, 3), f"mesh {path}", usual=20.0)
    with parsing(Path(path), "mesh"):
        return convex_pieces(triangles)


def read_triangles(path: Path | str) -> FloatArray:
    """Return the triangles (f, 3, 3) of a file, in its unit; of a DAE file in metres."""
    readers = {f".{kind}": partial(_triangles, kind) for kind in ("stl", "obj", "dae")}
    return read_by_suffix(readers, path, "mesh")


def _triangles(kind: str, data: bytes) -> FloatArray:
    """Return the triangles (f, 3, 3) in the content of a file of a kind, e.g. "stl"."""
    unit = collada_unit(data) if kind == "dae" else 1.0
    if kind == "obj":
        # the text may be in another encoding; trimesh skips lines that begin with blanks
        lines = data.decode("utf-8", errors="replace").splitlines()
        data = "\n".join(" ".join(line.split()) for line in lines).encode()
        _refuse_skipped_lines(data)
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False)
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    if len(faces) == 0:
        raise InvalidInputError("it has no triangle: cut short?")
    # trimesh skips triangles after the end of a solid in a text STL
    stated = data.lower().count(b"endfacet") if kind == "stl" else 0
    if stated not in (0, len(faces)):
        raise InvalidInputError(f"{len(faces)} of its {stated} triangles belong to a solid")
    if len(faces) > MAX_TRIANGLES:
        raise InvalidInputError(
            f"it has {len(faces)} triangles, more than {MAX_TRIANGLES}: simplify it"
        )
    corners = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3)[faces]
    if not np.isfinite(corners).all():
        raise InvalidInputError("a corner of a triangle is not finite")
    return unit * corners


def _refuse_skipped_lines(data: bytes) -> None:
    """Refuse lines of an OBJ file, without blanks at their begin, that trimesh would skip."""
    skipped = re.search(rb"^(fo|curv|curv2|surf) .*", data, re.MULTILINE)
    # the fourth number of a vertex is a divisor; three more numbers are a colour
    weighted = re.search(rb"^v( [^ \n]+){3} (?!1(\.0*)?$)[^ \n]+$", data, re.MULTILINE)
    for found, what in ((skipped, "faces and surfaces"), (weighted, "a weight of a vertex")):
        if found is not None:
            line = shown(found[0].decode(errors="replace"))
            raise InvalidInputError(
                f"its line {line} has {what} that are not read; export plain triangles (v x y z, f)"
            )
