"""Point clouds from files: NPY, PCD, PLY, XYZ.

A header is believed only as far as the file's size bears it out: counts are compared with what the file can hold
before anything is read, and with what was read afterwards. Memory stays within a small multiple of the file's size.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.files.columns import Column, numbers_in, three
from cvqmpt_lab.scene.files.npy import read_array
from cvqmpt_lab.scene.files.pcd import read_pcd
from cvqmpt_lab.scene.files.ply import read_ply
from cvqmpt_lab.scene.files.reading import check_lengths, file_bytes, kind_of, parsing


@dataclass(frozen=True, eq=False)
class CloudRead:
    """A cloud as a file holds it."""

    points: FloatArray
    """(m, 3), m >= 1, all finite [m]."""
    dropped: int
    """Points left out because a coordinate was not finite."""


def read_cloud(path: Path | str, scale: float = 1.0) -> CloudRead:
    """Read the points of a file, whose suffix says what it is (see `READERS`).

    Parameters
    ----------
    scale: [m] of one unit of the file.

    Raises
    ------
    UnknownChoiceError: another suffix.
    InvalidInputError: a file that cannot be read, contradicts itself, has no finite point, or is evidently not in
        metres; names the file.
    """
    path = Path(path)
    reader = READERS[kind_of(path, READERS, "cloud")]
    data = file_bytes(path, "cloud")
    with parsing(path, "cloud"), np.errstate(over="ignore", invalid="ignore"):
        points = scale * reader(data).astype(np.float64)
    finite = np.logical_and.reduce([np.isfinite(axis) for axis in points.T])  # 5 times as fast as by rows
    if not finite.any():
        raise InvalidInputError(
            f"cloud {path}: none of its {len(points)} points is finite; give one that has some"
        )
    check_lengths(points[finite], f"cloud {path}")
    return CloudRead(points[finite], int(len(points) - finite.sum()))


def _read_npy(data: bytes) -> np.ndarray:
    """An array (m, 3 or more), (height, width, 3 or more), or with fields x, y, z."""
    array = read_array(data)
    if array.dtype.names is not None:
        columns = [Column(name, array.dtype[name].str) for name in array.dtype.names]
        return three(columns, lambda k: array[columns[k].name].reshape(-1))
    if array.dtype.kind not in "fiu" or array.ndim < 2 or array.shape[-1] < 3:
        raise InvalidInputError(f"it has shape {array.shape} of {array.dtype}; give numbers of shape (m, 3)")
    return array.reshape(-1, array.shape[-1])[:, :3]


def _read_xyz(data: bytes) -> np.ndarray:
    """Lines of numbers, the first three of which count, separated by blanks, commas or semicolons."""
    text = data.decode("utf-8").replace(",", " ").replace(";", " ")
    return numbers_in(text, range(3))


READERS: Mapping[str, Callable[[bytes], np.ndarray]] = {
    ".npy": _read_npy,
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".xyz": _read_xyz,
    ".txt": _read_xyz,
    ".csv": _read_xyz,
}
"""Readers of points (m, 3) by the suffix of the file."""
