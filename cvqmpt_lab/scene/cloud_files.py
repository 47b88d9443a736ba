"""Point clouds from files and to files: PCD, PLY, NPY, lines of numbers.

A header is believed only as far as the file's size bears it out: counts are compared with what the
file can hold before anything is read, and with what was read afterwards. Memory stays within a
small multiple of the file's size.
"""

import contextlib
import io
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import lzf
import numpy as np

from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import read_bytes, write_bytes
from cvqmpt_lab.values import FloatArray

MOST_BYTES = 2**31  # of a file
MOST_COLUMNS = 1000  # of a row
LONGEST_HEADER = 1_000_000  # [bytes]
EXPANSION = 300  # bytes at most that LZF makes of one
FARTHEST = 1000.0  # [m] that a coordinate may be from the origin
ROOM = 50.0  # [m] within which at least half of all points must lie
SPECK = 1e-3  # [m] that the whole must exceed in some direction
WHOLE = {(kind, size): f"{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)}
PCD_TYPES = {("F", 4): "f4", ("F", 8): "f8"} | WHOLE
PLY_TYPES = {
    **{"char": "i1", "short": "i2", "int": "i4", "uchar": "u1", "ushort": "u2", "uint": "u4"},
    **{"int8": "i1", "int16": "i2", "int32": "i4", "uint8": "u1", "uint16": "u2", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
NPY_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class CloudRead(NamedTuple):
    """A cloud as a file holds it."""

    points: FloatArray  # (m, 3), m >= 1, all finite [m]
    dropped: int  # points left out because a coordinate was not finite


class Column(NamedTuple):
    """A number of each row."""

    name: str
    kind: str  # as numpy writes it, without byte order: "f4"


def read_cloud(path: Path | str, scale: float = 1.0) -> CloudRead:
    """Read the points of a file, whose suffix says what it is (see `READERS`); scale: [m] of one
    unit of the file.

    InvalidInputError for a file that cannot be read, contradicts itself, has no finite point, or is
    evidently not in metres.
    """
    path = Path(path)
    reader = READERS[kind_of(path, READERS, "cloud")]
    data = file_bytes(path, "cloud")
    with parsing(path, "cloud"), np.errstate(over="ignore", invalid="ignore"):
        points = scale * reader(data).astype(np.float64)
    # 5 times as fast as by rows
    finite = np.logical_and.reduce([np.isfinite(axis) for axis in points.T])
    if not finite.any():
        raise InvalidInputError(
            f"cloud {path}: none of its {len(points)} points is finite; give one that has some"
        )
    check_lengths(points[finite], f"cloud {path}")
    return CloudRead(points[finite], int(len(points) - finite.sum()))


def write_cloud(path: Path | str, points: FloatArray) -> None:
    """Write points (m, 3) [m] in single precision, whole or not at all;
    the suffix says how (see `WRITERS`).
    """
    path = Path(path)
    write = WRITERS[kind_of(path, WRITERS, "cloud")]
    write_bytes(path, write(np.ascontiguousarray(points, dtype="<f4")))


def file_bytes(path: Path, what: str) -> bytes:
    """The content of a regular file; a pipe, a folder or one beyond `MOST_BYTES` is refused."""
    if path.exists() and not path.is_file():
        raise InvalidInputError(f"cannot read {what} {path}: it is no regular file")
    if path.exists() and path.stat().st_size > MOST_BYTES:
        raise InvalidInputError(
            f"cannot read {what} {path}: more than {MOST_BYTES} bytes; make it smaller"
        )
    return read_bytes(path, what)


def kind_of(path: Path, kinds: Mapping[str, object], what: str) -> str:
    """The suffix of a file, in small letters; UnknownChoiceError unless it is one of `kinds`."""
    suffix = path.suffix.lower()
    if suffix not in kinds:
        raise UnknownChoiceError(f"kind of {what} {path.name}: suffix", path.suffix, kinds)
    return suffix


@contextlib.contextmanager
def parsing(path: Path, what: str) -> Iterator[None]:
    """Whatever a parser raises on a damaged file becomes an InvalidInputError in one line that
    names the file.
    """
    try:
        yield
    except Exception as error:  # parsers of other people's formats raise anything
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise InvalidInputError(f"{what} {path}: {said}") from error


def check_lengths(points: FloatArray, what: str, room: float = ROOM) -> None:
    """Refuse points (m, 3) [m], m >= 1, that cannot be metres: the message says which unit they may
    be in.

    room: [m] within which at least half of them must lie.
    """
    off = np.maximum.reduce([np.abs(axis) for axis in points.T])
    largest, middling = float(off.max()), float(np.median(off))
    if largest > FARTHEST:
        raise InvalidInputError(
            f"{what}: point {int(np.argmax(off))} is {largest:.3g} m off the origin, more than "
            f"{FARTHEST:g}; "
            "scale or remove it (millimetres: scale 0.001)"
        )
    if middling > room:
        raise InvalidInputError(
            f"{what}: half of it is more than {middling:.3g} m off the origin: no metres? give a "
            f"scale "
            "(millimetres: 0.001), or move it to the robot"
        )
    extent = max(float(np.ptp(axis)) for axis in points.T)
    if len(points) > 1 and extent < SPECK:
        raise InvalidInputError(
            f"{what}: all of it lies within {1e3 * extent:.3g} mm: no metres? give a scale "
            f"(kilometres: 1000)"
        )


def read_array(data: bytes) -> np.ndarray:
    """The array of a NPY file, read-only, without the memory that a wrong header asks for.

    InvalidInputError or numpy's ValueError for a file that is damaged, of an unknown version, or of
    Python objects.
    """
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in NPY_HEADERS:
        raise InvalidInputError(f"NPY version {version} is not known; write version 1 or 2")
    shape, by_column, kind = NPY_HEADERS[version](stream)
    if kind.hasobject:
        raise InvalidInputError("it holds Python objects, which may run code; write plain numbers")
    if min(shape, default=0) < 0 or math.prod(shape) * kind.itemsize != len(data) - stream.tell():
        raise InvalidInputError(
            f"its header says shape {shape} of {kind}, the file holds another size"
        )
    return np.frombuffer(data, kind, offset=stream.tell()).reshape(
        shape, order="F" if by_column else "C"
    )


def _read_npy(data: bytes) -> np.ndarray:
    """An array (m, 3 or more), (height, width, 3 or more), or with fields x, y, z."""
    array = read_array(data)
    if array.dtype.names is not None:
        names = array.dtype.names
        return _points([Column(name, "") for name in names], lambda k: array[names[k]].reshape(-1))
    if array.dtype.kind not in "fiu" or array.ndim < 2 or array.shape[-1] < 3:
        raise InvalidInputError(
            f"it has shape {array.shape} of {array.dtype}; give numbers of shape (m, 3)"
        )
    return array.reshape(-1, array.shape[-1])[:, :3]


def _read_lines(data: bytes) -> np.ndarray:
    """Lines of numbers, the first three of which count, separated by blanks, commas or semicolons."""
    return _numbers(data.decode("utf-8").replace(",", " ").replace(";", " "), range(3))


def _read_pcd(data: bytes) -> np.ndarray:
    """Points (m, 3) as the Point Cloud Library writes them: ascii, binary, or compressed by LZF."""
    header, at = _pcd_header(data)
    columns, count = _pcd_columns(header), int(header["POINTS"][0])
    width, height = int(header.get("WIDTH", [str(count)])[0]), int(header.get("HEIGHT", ["1"])[0])
    if count < 0 or width * height != count:
        raise InvalidInputError(f"its header says {count} points, but {width} x {height}")
    body, form = data[at:], header["DATA"][0].lower()
    if form == "ascii":
        return _from_text(body.decode("ascii"), columns, count)
    if form == "binary":
        if body[count * _row_bytes(columns) :].strip(b"\0\n"):  # pages are filled up with zeros
            raise InvalidInputError(f"its header says {count} points, but the file holds more")
        return _from_rows(body, columns, count, "<")
    if form == "binary_compressed":
        return _unpacked(body, columns, count)
    raise InvalidInputError(f"its DATA is {form!r}; known: ascii, binary, binary_compressed")


def _pcd_header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """The header's words by their key, and where the points begin."""
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = data.find(b"\n", at, at + LONGEST_HEADER)
        if end < 0:
            raise InvalidInputError("its header has no line DATA: no PCD, or cut short")
        key, *words = data[at:end].decode("utf-8").split() or [""]
        at = end + 1
        if key and not key.startswith("#"):
            header[key] = words
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA") if not header.get(key)]
    if missing:
        raise InvalidInputError(f"its header has no {missing[0]}")
    return header, at


def _pcd_columns(header: Mapping[str, Sequence[str]]) -> list[Column]:
    """The numbers of each row; a field of several has several of one name."""
    fields, kinds, sizes = header["FIELDS"], header["TYPE"], [int(word) for word in header["SIZE"]]
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(fields))]
    if not len(fields) == len(kinds) == len(sizes) == len(counts):
        raise InvalidInputError(
            "its header's FIELDS, SIZE, TYPE and COUNT have not the same length"
        )
    if min(counts) < 1 or sum(counts) > MOST_COLUMNS:
        raise InvalidInputError(
            f"its header's COUNT is {counts}; give 1 or more, {MOST_COLUMNS} together"
        )
    for kind, size in zip(kinds, sizes, strict=True):
        if (kind, size) not in PCD_TYPES:
            raise InvalidInputError(f"its header's TYPE {kind} of SIZE {size} does not exist")
    described = zip(fields, kinds, sizes, counts, strict=True)
    columns = (
        (Column(name, PCD_TYPES[kind, size]), count) for name, kind, size, count in described
    )
    return [column for column, count in columns for _ in range(count)]


def _unpacked(body: bytes, columns: Sequence[Column], count: int) -> np.ndarray:
    """Points of a compressed body, which holds one column after the other."""
    if len(body) < 8:
        raise InvalidInputError("its compressed points are cut short")
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    row = _row_bytes(columns)
    if unpacked != count * row or packed > len(body) - 8 or unpacked > EXPANSION * packed:
        raise InvalidInputError(
            f"its header says {count} points of {row} bytes, its compressed part {unpacked} bytes "
            f"in {packed} "
            f"of {len(body) - 8}"
        )
    raw = lzf.decompress(body[8 : 8 + packed], unpacked) if unpacked else b""
    if raw is None or len(raw) != unpacked:
        raise InvalidInputError("its compressed points cannot be unpacked")
    begins = count * np.cumsum([0, *(np.dtype(column.kind).itemsize for column in columns)])
    return _points(
        columns, lambda k: np.frombuffer(raw, f"<{columns[k].kind}", count, int(begins[k]))
    )


def _read_ply(data: bytes) -> np.ndarray:
    """Points (m, 3) of the element "vertex", which must come first and hold plain numbers;
    others are not read.
    """
    end = data.find(b"end_header", 0, LONGEST_HEADER)
    begin = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or begin == 0:
        raise InvalidInputError("it does not begin with a PLY header: no PLY, or cut short")
    form, columns, count = _ply_vertices(
        [line.split() for line in data[:end].decode("utf-8").splitlines()]
    )
    body = data[begin:]
    if form == "ascii":
        lines = body.decode("ascii").split("\n", count)[:count] if 0 <= count <= len(body) else []
        return _from_text("\n".join(lines), columns, count)
    return _from_rows(body, columns, count, PLY_ORDERS[form])


def _ply_vertices(lines: Sequence[Sequence[str]]) -> tuple[str, list[Column], int]:
    """The format, the columns of the element "vertex" and how many there are."""
    form = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")
    if form not in PLY_ORDERS:
        raise InvalidInputError(f"its format is {form!r}; known: {', '.join(PLY_ORDERS)}")
    elements = [k for k, line in enumerate(lines) if line[:1] == ["element"]]
    if not elements or lines[elements[0]][1:2] != ["vertex"] or len(lines[elements[0]]) != 3:
        raise InvalidInputError("its first element is not 'vertex'")
    first, last = (*elements, len(lines))[:2]
    columns = []
    for line in lines[first + 1 : last]:
        if line[:1] == ["property"]:
            if len(line) != 3 or line[1] not in PLY_TYPES:
                raise InvalidInputError(
                    f"its property {' '.join(line[1:])!r} of 'vertex' is no plain number"
                )
            columns.append(Column(line[2], PLY_TYPES[line[1]]))
    if len(columns) > MOST_COLUMNS:
        raise InvalidInputError(
            f"its element 'vertex' has {len(columns)} properties; {MOST_COLUMNS} at most"
        )
    return form, columns, int(lines[first][2])


def _points(columns: Sequence[Column], values: Callable[[int], np.ndarray]) -> np.ndarray:
    """The columns x, y and z as points (m, 3); values gives column k."""
    return np.stack([values(k).astype(np.float64) for k in _places(columns)], axis=1)


def _places(columns: Sequence[Column]) -> list[int]:
    """Which columns are x, y and z; each must occur once."""
    names = [column.name for column in columns]
    for axis in "xyz":
        if names.count(axis) != 1:
            raise InvalidInputError(
                f"it has no single column {axis!r}; columns: {', '.join(names) or 'none'}"
            )
    return [names.index(axis) for axis in "xyz"]


def _row_bytes(columns: Sequence[Column]) -> int:
    return sum(np.dtype(column.kind).itemsize for column in columns)


def _from_rows(body: bytes, columns: Sequence[Column], count: int, order: str) -> np.ndarray:
    """Points of the first `count` binary rows; order: of their bytes, "<" or ">"."""
    size = _row_bytes(columns)
    if count < 0 or count * size > len(body):
        raise InvalidInputError(
            f"its header says {count} points, the file holds {len(body) // max(1, size)}: cut "
            f"short?"
        )
    kinds = np.dtype([(f"{k}", order + item.kind) for k, item in enumerate(columns)])
    rows = np.frombuffer(body, kinds, count)
    return _points(columns, lambda k: rows[f"{k}"])


def _from_text(text: str, columns: Sequence[Column], count: int) -> np.ndarray:
    """Points of `count` lines of numbers."""
    points = _numbers(text, _places(columns))
    if len(points) != count:
        raise InvalidInputError(f"its header says {count} points, the file holds {len(points)}")
    return points


def _numbers(text: str, chosen: Sequence[int]) -> np.ndarray:
    """Some columns of lines of numbers (m, k)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no data, which callers say themselves
        found = np.loadtxt(io.StringIO(text), usecols=chosen, ndmin=2, comments=("#", "//"))
    return found.reshape(-1, len(chosen))


def _write_pcd(points: np.ndarray) -> bytes:
    count = len(points)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE "
        "F F F\n"
        f"COUNT 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA "
        f"binary\n"
    )
    return header.encode() + points.tobytes()


def _write_ply(points: np.ndarray) -> bytes:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}end_header\n"
    )
    return header.encode() + points.tobytes()


def _write_npy(points: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, points)
    return stream.getvalue()


READERS: Mapping[str, Callable[[bytes], np.ndarray]] = {  # of points (m, 3), by the file's suffix
    ".npy": _read_npy,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".xyz": _read_lines,
    ".txt": _read_lines,
    ".csv": _read_lines,
}
Writer = Callable[[np.ndarray], bytes]
WRITERS: Mapping[str, Writer] = {".pcd": _write_pcd, ".ply": _write_ply, ".npy": _write_npy}
