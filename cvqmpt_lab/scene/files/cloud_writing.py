"""Point clouds to files that `clouds.read_cloud` reads again: PCD and PLY (binary), NPY."""

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.files import write_bytes
from cvqmpt_lab.scene.files.reading import kind_of


def write_cloud(path: Path | str, points: FloatArray) -> None:
    """Write points (m, 3) [m] in single precision, whole or not at all; the suffix says how (see `WRITERS`)."""
    path = Path(path)
    write = WRITERS[kind_of(path, WRITERS, "cloud")]
    write_bytes(path, write(np.ascontiguousarray(points, dtype="<f4")))


def _pcd(points: np.ndarray) -> bytes:
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        *("FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "COUNT 1 1 1"),
        *(f"WIDTH {len(points)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(points)}"),
        "DATA binary\n",
    )
    return "\n".join(lines).encode() + points.tobytes()


def _ply(points: np.ndarray) -> bytes:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
    return header.encode() + points.tobytes()


def _npy(points: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, points)
    return stream.getvalue()


WRITERS: Mapping[str, Callable[[np.ndarray], bytes]] = {".pcd": _pcd, ".ply": _ply, ".npy": _npy}
"""Writers of points (m, 3) by the suffix of the file."""
