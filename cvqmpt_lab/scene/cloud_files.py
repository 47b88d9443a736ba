"""Point clouds from files and to files: PCD, PLY, NPY, lines of numbers.

Counts in a header are compared with the size of the file before anything of that size is made.
"""

import contextlib
import io
import math
import re
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lzf
import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, require_choice
from cvqmpt_lab.base.files import read_bytes, write_bytes
from cvqmpt_lab.base.values import FloatArray


@dataclass(frozen=True, eq=False)
class Cloud:
    """What one camera or file holds, in its own frame."""

    points: FloatArray  # (m, 3), all finite [m]
    dropped: int = 0  # points or pixels left out because they hold no finite point
    # (4, 4), pose of that frame; default: the robot's base frame
    T_world_camera: FloatArray = field(default_factory=lambda: np.eye(4))

    @property
    def in_world(self) -> FloatArray:
        """The points (m, 3) in the robot's base frame [m], `R p + t`."""
        return self.points @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def read_cloud(path: Path | str, scale: float = 1.0) -> Cloud:
    """Read the points of a file; its suffix says what it is (see `READERS`).

    Args:
        path: of the file.
        scale: length of one unit of the file [m].

    Returns: the finite points, and how many were not finite.

    Raises InvalidInputError for a file that cannot be read, contradicts itself, has no finite
    point, or is evidently not in metres.
    """
    with np.errstate(over="ignore"):
        points = scale * read_by_suffix(READERS, path, "cloud").astype(np.float64)
    # one axis after the other: 5 times as fast as by rows
    finite = np.logical_and.reduce([np.isfinite(axis) for axis in points.T])
    if not finite.any():
        raise InvalidInputError(
            f"cloud {path}: none of its {len(points)} points is finite; give one that has some"
        )
    check_lengths(points[finite], f"cloud {path}")
    return Cloud(points[finite], int(len(points) - finite.sum()))


def write_cloud(path: Path | str, points: FloatArray) -> None:
    """Write points (m, 3) [m] in single precision, whole or not at all;
    the suffix says how (see `HEADERS`).
    """
    points = np.ascontiguousarray(points, dtype="<f4")
    header = HEADERS[kind_of(path, HEADERS, "cloud")].format(count=len(points)).encode()
    stream = io.BytesIO()
    if header:
        stream.write(header + points.tobytes())
    else:
        np.save(stream, points)
    write_bytes(Path(path), stream.getvalue())


def read_by_suffix(
    readers: Mapping[str, Callable[..., Any]],
    path: Path | str,
    what: str,
    *more: Any,
    most: int = 2**31,
) -> Any:
    """What the reader of a file's suffix makes of its bytes.

    Args:
        readers: by suffix, in small letters.
        path: of a regular file.
        what: the file is, for errors.
        more: arguments of the reader after the bytes.
        most: size of the file [bytes].

    Raises InvalidInputError or UnknownChoiceError, in one line that names the file.
    """
    path, reader = Path(path), readers[kind_of(path, readers, what)]
    if path.is_file() and path.stat().st_size > most:
        raise InvalidInputError(
            f"cannot read {what} {path}: more than {most} bytes; make it smaller"
        )
    data = read_bytes(path, what)
    with parsing(path, what), np.errstate(over="ignore", invalid="ignore"):
        return reader(data, *more)


def kind_of(path: Path | str, kinds: Collection[str], what: str) -> str:
    """The suffix of a file, in small letters; UnknownChoiceError unless it is one of `kinds`."""
    path = Path(path)
    return require_choice(f"kind of {what} {path.name}: suffix", path.suffix.lower(), kinds)


@contextlib.contextmanager
def parsing(path: Path, what: str) -> Iterator[None]:
    """Whatever a parser raises on a damaged file becomes an InvalidInputError in one line that
    names the file.
    """
    try:
        yield
    except Exception as error:  # parsers of other people's formats raise anything
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise InvalidInputError(f"{what} {path} is not understood: {said}") from error


def check_lengths(
    points: FloatArray,
    what: str,
    room: float = 50.0,
    farthest: float = 1000.0,
    speck: float = 1e-3,
) -> None:
    """Refuse points (m, 3) [m], m >= 1, that cannot be metres; errors name the likely unit.

    Args:
        points: (m, 3) [m].
        what: they are, for errors.
        room: distance from the origin within which at least half of them must lie [m].
        farthest: that one may be from the origin [m].
        speck: length that all together must exceed along some axis [m].
    """
    off = np.maximum.reduce([np.abs(axis) for axis in points.T])
    largest, middling = float(off.max()), float(np.median(off))
    if largest > farthest:
        raise InvalidInputError(
            f"{what}: point {int(np.argmax(off))} is {largest:.3g} m off the origin, more than "
            f"{farthest:g}; scale or remove it (millimetres: scale 0.001)"
        )
    if middling > room:
        raise InvalidInputError(
            f"{what}: half of it is more than {middling:.3g} m off the origin: no metres? give a "
            "scale (millimetres: 0.001), or move it to the robot"
        )
    extent = max(float(np.ptp(axis)) for axis in points.T)
    if len(points) > 1 and extent < speck:
        raise InvalidInputError(
            f"{what}: all of it lies within {1e3 * extent:.3g} mm: no metres? give a scale "
            "(kilometres: 1000)"
        )


def read_array(data: bytes) -> np.ndarray:
    """The array of a NPY file of version 1 or 2, read-only.

    Raises InvalidInputError or ValueError where it is damaged or holds Python objects.
    """
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise InvalidInputError(f"NPY version {version} is not known; write version 1 or 2")
    read_header = getattr(np.lib.format, f"read_array_header_{version[0]}_0")
    shape, by_column, kind = read_header(stream)
    if kind.hasobject:
        raise InvalidInputError("it holds Python objects, which may run code; write plain numbers")
    if min(shape, default=0) < 0 or math.prod(shape) * kind.itemsize != len(data) - stream.tell():
        raise InvalidInputError(
            f"its header says shape {shape} of {kind}, the file holds another size"
        )
    array = np.frombuffer(data, kind, offset=stream.tell())
    return array.reshape(shape, order="F" if by_column else "C")


def _read_npy(data: bytes) -> np.ndarray:
    """An array (m, 3), (height, width, 3), or with fields x, y, z."""
    array = read_array(data)
    if array.dtype.names is not None:
        names = array.dtype.names
        columns = [array[names[k]].reshape(-1) for k in _axes_among(names)]
        return np.stack(columns, axis=1).astype(np.float64)
    if array.dtype.kind not in "fiu" or array.ndim < 2 or array.shape[-1] != 3:
        cause = ": transposed?" if array.ndim == 2 and len(array) == 3 else ""
        raise InvalidInputError(
            f"it has shape {array.shape} of {array.dtype}; give numbers of shape (m, 3){cause}"
        )
    return array.reshape(-1, 3)


def _read_lines(data: bytes) -> np.ndarray:
    """Lines of numbers between blanks, commas or semicolons, as in the first; three count."""
    text = data.decode("utf-8")
    first = re.search(r"^\s*[^#/\s][^#/\n]*", text, re.MULTILINE)
    between = next((mark for mark in ";," if first is not None and mark in first[0]), None)
    try:
        return _numbers(text, range(3), between)
    except ValueError as error:
        raise InvalidInputError(f"{error} write decimal points, x, y, z in each line") from error


def _read_pcd(data: bytes) -> np.ndarray:
    """Points (m, 3) as the Point Cloud Library writes them: ascii, binary, or compressed by LZF."""
    top = re.match(rb"(?s).{0,99999}?^DATA[^\n]*\n", data, re.MULTILINE)
    if top is None:
        raise InvalidInputError("its header has no line DATA: no PCD, or cut short")
    words = [line.split() for line in top[0].decode("utf-8").splitlines()]
    header = {line[0]: line[1:] for line in words if line}
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA") if not header.get(key)]
    if missing:
        raise InvalidInputError(f"its header has no {missing[0]}")
    names, count, body = header["FIELDS"], int(header["POINTS"][0]), data[top.end() :]
    width, height = (int(header.get(key, [n])[0]) for key, n in (("WIDTH", count), ("HEIGHT", 1)))
    if count < 0 or width * height != count:
        raise InvalidInputError(f"its header says {count} points, but {width} x {height}")
    repeats = [int(word) for word in header.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(header["TYPE"]) == len(header["SIZE"]) == len(repeats):
        raise InvalidInputError("FIELDS, SIZE, TYPE and COUNT of its header differ in length")
    fields = zip(header["TYPE"], header["SIZE"], repeats, strict=True)
    try:
        row = np.dtype([(str(k), f"<{t.lower()}{s}", (n,)) for k, (t, s, n) in enumerate(fields)])
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"TYPE, SIZE or COUNT of its header has no meaning: {error}"
        ) from error
    form = header["DATA"][0].lower()
    axes = _axes_among([name if n == 1 else "" for name, n in zip(names, repeats, strict=True)])
    if form == "ascii":
        if any(n != 1 for n in repeats):
            raise InvalidInputError("it is ascii with a COUNT other than 1; write it as binary")
        points = _rows(body.decode("ascii"), len(names))[:, axes]
    elif form == "binary":
        points = _from_rows(body, row, axes, count)
    elif form == "binary_compressed":
        points = _unpacked(body, row, axes, count)
    else:
        raise InvalidInputError(f"its DATA is {form!r}; known: ascii, binary, binary_compressed")
    if len(points) != count:
        raise InvalidInputError(f"its header says {count} points, the file holds {len(points)}")
    return points


def _from_rows(body: bytes, row: np.dtype, axes: Sequence[int], count: int) -> np.ndarray:
    """Points (m, 3) of binary rows, of which x, y and z are the fields `axes`."""
    if not 0 <= count * row.itemsize <= len(body):
        raise InvalidInputError(
            f"its header says {count} points, the file holds {len(body) // max(1, row.itemsize)}: "
            "cut short?"
        )
    _refuse_more(body[count * row.itemsize :], count)
    rows = np.frombuffer(body, row, count)
    return np.concatenate([rows[str(k)].astype(np.float64) for k in axes], axis=1)


def _unpacked(body: bytes, row: np.dtype, axes: Sequence[int], count: int) -> np.ndarray:
    """Points (m, 3) of a compressed body, which holds one field after the other."""
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    # LZF makes at most 300 bytes of one
    if unpacked != count * row.itemsize or packed > len(body) - 8 or unpacked > 300 * packed:
        raise InvalidInputError(
            f"its header says {count} points of {row.itemsize} bytes, its compressed part "
            f"{unpacked} bytes in {packed} of {len(body) - 8}"
        )
    _refuse_more(body[8 + packed :], count)
    raw = lzf.decompress(body[8 : 8 + packed], unpacked) if unpacked else b""
    if raw is None or len(raw) != unpacked:
        raise InvalidInputError("its compressed points cannot be unpacked")
    assert row.fields is not None
    columns = [row.fields[str(k)] for k in axes]
    found = [np.frombuffer(raw, kind.base, count, count * at) for kind, at, *_ in columns]
    return np.stack(found, axis=1).astype(np.float64)


def _refuse_more(rest: bytes, count: int, page: int = 4096) -> None:
    """Refuse what follows the last point, but zeros, with which PCL fills a page of memory."""
    if len(rest) >= page or rest.strip(b"\0"):
        raise InvalidInputError(
            f"its header says {count} points, but the file holds more: {len(rest)} bytes"
        )


def _read_ply(data: bytes) -> np.ndarray:
    """Points (m, 3) of the element "vertex" of a PLY file, which must hold nothing but numbers."""
    top = re.match(
        rb"ply\s+format (ascii|binary_little_endian|binary_big_endian) "
        rb"(?s:.{0,999999}?)^end_header\r?\n",
        data,
        re.MULTILINE,
    )
    elements: list[tuple[str, int, list[str]]] = []  # name, count, properties, "" for a list
    for line in top[0].decode("utf-8").splitlines() if top else ():
        words = line.split()
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[-1] if len(words) == 3 else "")
    counts = [count for name, count, _ in elements if name == "vertex"]
    if top is None or len(counts) != 1:
        raise InvalidInputError("it does not begin with a PLY header of ascii or binary vertices")
    if top[1] == b"ascii":
        return _ascii_vertices(data[top.end() :].decode("ascii"), elements)
    # it takes a second to import, which other clouds need not pay
    import trimesh

    try:
        loaded = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
        points = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InvalidInputError(
            f"its vertices x, y, z cannot be read ({error}): cut short, or no plain numbers?"
        ) from error
    if len(points) != counts[0]:
        raise InvalidInputError(f"its header says {counts[0]} points, the file holds {len(points)}")
    return points


def _ascii_vertices(text: str, elements: Sequence[tuple[str, int, list[str]]]) -> np.ndarray:
    """Points (m, 3) of the element "vertex": names, counts, properties, a line for each."""
    lines = [line for line in text.splitlines() if line.strip()]
    if sum(count for _, count, _ in elements) != len(lines):
        said = ", ".join(f"{count} {name}" for name, count, _ in elements)
        raise InvalidInputError(f"its header says {said}, the file holds {len(lines)} lines")
    k = [name for name, _, _ in elements].index("vertex")
    before = sum(count for _, count, _ in elements[:k])
    _, count, properties = elements[k]
    rows = _rows("\n".join(lines[before : before + count]), len(properties))
    return rows[:, _axes_among(properties)]


def _axes_among(names: Sequence[str]) -> list[int]:
    """Which columns are x, y and z; each must occur once."""
    for axis in "xyz":
        if list(names).count(axis) != 1:
            raise InvalidInputError(
                f"it has no single column {axis!r}; columns: {', '.join(names) or 'none'}"
            )
    return [list(names).index(axis) for axis in "xyz"]


def _rows(text: str, width: int) -> np.ndarray:
    """Lines of so many numbers each (m, width)."""
    found = _numbers(text)
    if found.size and found.shape[1] != width:
        raise InvalidInputError(f"it has {found.shape[1]} numbers a line, its header says {width}")
    return found.reshape(-1, width)


def _numbers(
    text: str, chosen: Sequence[int] | None = None, between: str | None = None
) -> np.ndarray:
    """All or some columns of lines of numbers (m, k) between blanks or a mark."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no data, which callers say themselves
        return np.loadtxt(
            io.StringIO(text), usecols=chosen, ndmin=2, comments=("#", "//"), delimiter=between
        )


READERS: Mapping[str, Callable[[bytes], np.ndarray]] = {  # of points (m, 3), by the file's suffix
    ".npy": _read_npy,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".xyz": _read_lines,
    ".txt": _read_lines,
    ".csv": _read_lines,
}
HEADERS = {
    ".pcd": "# .PCD v0.7 - Point Cloud Data file format\n"
    "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    "WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n",
    ".ply": "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n",
    ".npy": "",  # numpy writes its own
}
"""Headers of written clouds, by the file's suffix; the points follow."""
