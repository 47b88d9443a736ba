"""Meshes from files: STL, OBJ, DAE, as convex pieces that hold all of the surface."""

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import trimesh

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.robot.urdf import collada_unit
from cvqmpt_lab.scene.cloud_files import check_lengths, file_bytes, kind_of, parsing
from cvqmpt_lab.scene.convex import convex_pieces
from cvqmpt_lab.values import FloatArray

MOST_TRIANGLES = 200_000
ROOM = 20.0  # [m] within which at least half of a mesh must lie


def read_mesh(path: Path | str, scale: float = 1.0) -> tuple[FloatArray, ...]:
    """Read a mesh as vertices (k, 3) [m] of convex pieces; see `convex_pieces`.

    scale: [m] of one unit of the file. The unit that a DAE file states is applied before, and which
        axis it calls up is
        ignored, both as for meshes of robots.

    InvalidInputError for a file that cannot be read, has no triangle, too many, or none that span a
    volume, or is evidently not in metres.
    """
    path = Path(path)
    triangles = scale * read_triangles(path)
    check_lengths(triangles.reshape(-1, 3), f"mesh {path}", ROOM)
    with parsing(path, "mesh"):
        return convex_pieces(triangles)


def read_triangles(path: Path) -> FloatArray:
    """The corners (f, 3, 3) of a file's triangles, in its own unit."""
    suffix = kind_of(path, KINDS, "mesh")
    data = file_bytes(path, "mesh")
    with parsing(path, "mesh"):
        mesh = trimesh.load_mesh(
            io.BytesIO(KINDS[suffix](data)), file_type=suffix[1:], process=False
        )
        vertices = np.asarray(mesh.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
        if len(faces) == 0:
            raise InvalidInputError("it has no triangle")
        if len(faces) > MOST_TRIANGLES:
            raise InvalidInputError(
                f"it has {len(faces)} triangles; {MOST_TRIANGLES} at most: simplify it"
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InvalidInputError(
                f"a triangle has a corner that is none of its {len(vertices)} vertices"
            )
        corners = vertices[faces]
        if not np.isfinite(corners).all():
            raise InvalidInputError("a corner of a triangle is not finite")
        return collada_unit(data) * corners if suffix == ".dae" else corners


def _as_utf8(data: bytes) -> bytes:
    """Text whose comments and names may be in another encoding."""
    return data.decode("utf-8", errors="replace").encode()


def _as_stl(data: bytes) -> bytes:
    """Binary triangles, as many as the header says, or text."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + 50 * count:
        return data
    if data.lstrip()[:5].lower() == b"solid":
        return _as_utf8(data)
    raise InvalidInputError(
        f"as a binary STL it has {count} triangles in {84 + 50 * count} bytes, the file has "
        f"{len(data)}: cut short?"
    )


KINDS: Mapping[str, Callable[[bytes], bytes]] = {".stl": _as_stl, ".obj": _as_utf8, ".dae": bytes}
"""What is checked or repaired before the parser sees a file, by suffix."""
