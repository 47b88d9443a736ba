"""Read and write point clouds: PCD, PLY, NPY, lines of numbers.

Counts in a header are compared with the size of the file before memory of that size is used.
"""

import io
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import lzf
import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, shown
from cvqmpt_lab.base.files import write_bytes
from cvqmpt_lab.base.readers import kind_of, read_array, read_by_suffix
from cvqmpt_lab.base.values import FloatArray

MAX_UNPACKED = 2**30  # of the points of a compressed file [bytes]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one camera or file, in its own frame."""

    points: FloatArray  # (m, 3) finite [m]
    dropped: int = 0  # number of points or pixels that were left out because they are not finite
    # (4, 4) pose of the camera or file; default: the robot's base frame
    T_world_camera: FloatArray = field(default_factory=lambda: np.eye(4))

    @property
    def in_world(self) -> FloatArray:
        """Points R p + t (m, 3) in the robot's base frame [m]."""
        return self.points @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def read_cloud(path: Path | str, scale: float = 1.0, posed: bool = False) -> Cloud:
    """Read the points of a file in a format of `CLOUD_READERS`, which the suffix names.

    Args:
        path: path of the file.
        scale: length of one unit of the file [m].
        posed: whether the caller has the pose of the file's frame, so that a pose in the file does
            not matter.

    Returns:
        The finite points, and the number of others.

    Raises:
        InvalidInputError: the file cannot be read, contradicts itself, has no finite point, has a
            pose of its own, or is evidently not in metres.
    """
    readers = dict(CLOUD_READERS)
    readers[".pcd"] = partial(_read_pcd, posed=posed)
    readers[".ply"] = partial(_read_ply, posed=posed)
    with np.errstate(over="ignore"):
        points = scale * read_by_suffix(readers, path, "cloud").astype(np.float64)
    # axis by axis: 5 times as fast as by rows
    finite = np.logical_and.reduce([np.isfinite(axis) for axis in points.T])
    if not finite.any():
        raise InvalidInputError(
            f"cloud {path}: none of its {len(points)} points is finite; give one that has some"
        )
    check_lengths(points[finite], f"cloud {path}")
    return Cloud(points[finite], int(len(points) - finite.sum()))


def write_cloud(path: Path | str, points: FloatArray, comment: str = "") -> None:
    """Write points in single precision; the suffix names a format of `CLOUD_HEADERS`.

    Args:
        path: path of the file.
        points: (m, 3) [m].
        comment: a line for the header, where the format has comments; "": none.
    """
    points = np.ascontiguousarray(points, dtype="<f4")
    header = CLOUD_HEADERS[kind_of(path, CLOUD_HEADERS, "cloud")].format(count=len(points))
    if header and comment:
        sign, behind = ("# ", "VERSION") if header.startswith("#") else ("comment ", "element")
        header = header.replace(behind, f"{sign}{comment}\n{behind}", 1)
    stream = io.BytesIO()
    if header:
        stream.write(header.encode() + points.tobytes())
    else:
        np.save(stream, points)
    write_bytes(Path(path), stream.getvalue())


def comment_of(path: Path, begin: str, most: int = 1000) -> str | None:
    """Return the rest of a comment in the header of a cloud that begins with `begin`, or None.

    Args:
        path: path of the file.
        begin: first words of the comment.
        most: number of bytes in which it stands.
    """
    if not CLOUD_HEADERS.get(path.suffix.lower()):
        return None
    with path.open("rb") as file:
        lines = file.read(most).split(b"\n")
    found = (line.decode(errors="replace").partition(begin) for line in lines)
    return next((rest for sign, word, rest in found if word and sign in ("# ", "comment ")), None)


def check_lengths(
    points: FloatArray,
    what: str,
    usual: float = 50.0,
    farthest: float = 1000.0,
    smallest: float = 1e-3,
) -> None:
    """Refuse points that cannot be in metres; errors name the likely unit.

    Args:
        points: (m, 3) [m], m >= 1.
        what: noun for the points in errors.
        usual: at least half of the points must be within this distance of the origin [m].
        farthest: all points must be within this distance of the origin [m].
        smallest: the extent of all points along some axis must be larger [m].
    """
    distances = np.maximum.reduce([np.abs(axis) for axis in points.T])
    largest = float(distances.max())
    median = float(np.median(distances))
    if largest > farthest:
        raise InvalidInputError(
            f"{what}: point {int(np.argmax(distances))} is {largest:.3g} m from the origin, more "
            f"than {farthest:g}; scale or remove it (millimetres: scale 0.001)"
        )
    if median > usual:
        raise InvalidInputError(
            f"{what}: half of it is more than {median:.3g} m from the origin: not in metres? give "
            "a scale (millimetres: 0.001), or move it to the robot"
        )
    extent = max(float(np.ptp(axis)) for axis in points.T)
    if len(points) > 1 and extent < smallest:
        raise InvalidInputError(
            f"{what}: all of it is within {1e3 * extent:.3g} mm: not in metres? give a scale "
            "(kilometres: 1000)"
        )


def _read_npy(data: bytes) -> np.ndarray:
    """Return points (m, 3) of an array (m, 3), (height, width, 3), or with fields x, y, z."""
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
    """Return points (m, 3): the first three numbers of each line.

    The first line decides whether blanks, commas or semicolons separate the numbers. It may have
    names of columns, of which x, y and z are read, or the number of points alone. A comment above
    that names other columns first is refused.
    """
    text = data.decode("utf-8-sig")  # some programs begin a text with a byte order mark
    first = re.search(r"^\s*[^#/\s][^#/\n]*", text, re.MULTILINE)
    between = next((mark for mark in ";," if first is not None and mark in first[0]), None)
    words = [word.strip(" \t\r\n\"'") for word in first[0].split(between)] if first else []
    columns: Sequence[int] = range(3)
    stated = None
    if first is not None and any(map(_is_number, words)):
        _refuse_other_columns(text[: first.start()], len(words))
    if first is not None and words and not any(map(_is_number, words)):
        columns, text = _axes_among([word.lower() for word in words]), text[first.end() :]
    elif first is not None and len(words) == 1 and words[0].isdecimal():
        stated, text = int(words[0]), text[first.end() :]
    try:
        points = _numbers(text, columns, between)
    except ValueError as error:
        raise InvalidInputError(f"{error} write decimal points, x, y, z in each line") from error
    if stated not in (None, len(points)):
        raise InvalidInputError(
            f"its first line says {stated} points, the file holds {len(points)}; remove that line"
        )
    return points


def _refuse_other_columns(comments: str, width: int) -> None:
    """Refuse comments above lines of `width` numbers that name columns, x, y, z not the first.

    Of lines whose length varies (COLMAP's points) the comment has fewer names than the line.
    """
    for line in comments.splitlines():
        names = re.findall(r"[^\s,;]+", line.strip().lstrip("#/").lower())
        named = all(names.count(axis) == 1 for axis in "xyz") and names[:3] != ["x", "y", "z"]
        # a sentence that has these words names another number of columns
        if named and (len(names) == width or names[0].endswith("id")):
            raise InvalidInputError(
                f"its comment {shown(line.strip())} names columns of which x, y, z are not the "
                "first; remove the other columns, or write the names without # or //"
            )


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        # a decimal comma is a fault of a number, not a name
        return not word or word[0] in "+-.0123456789"
    return True


def _read_pcd(data: bytes, posed: bool = False) -> np.ndarray:
    """Return points (m, 3) of a PCD file: ASCII, binary, or compressed by LZF.

    Programs of PCL disagree on whether the points are in the frame of the sensor whose pose is
    VIEWPOINT, so only a caller that has a pose (`posed`) reads a file with one.
    """
    top = re.match(rb"(?s).{0,99999}?^DATA[^\n]*\n", data, re.MULTILINE)
    if top is None:
        raise InvalidInputError("its header has no line DATA: not a PCD file, or cut short")
    words = [line.split() for line in top[0].decode("utf-8").splitlines()]
    header = {line[0]: line[1:] for line in words if line}
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA") if not header.get(key)]
    if missing:
        raise InvalidInputError(f"its header has no {missing[0]}")
    if header.get("VIEWPOINT") and not posed:
        _refuse_viewpoint(header["VIEWPOINT"])
    names = header["FIELDS"]
    count = int(header["POINTS"][0])
    body = data[top.end() :]
    width = int(header.get("WIDTH", [count])[0])
    height = int(header.get("HEIGHT", [1])[0])
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


def _refuse_viewpoint(words: Sequence[str]) -> None:
    """Refuse a pose x, y, z, qw, qx, qy, qz that is not the identity."""
    if len(words) != 7:
        raise InvalidInputError(
            f"its VIEWPOINT has {len(words)} numbers; it has seven: x, y, z, qw, qx, qy, qz"
        )
    x, y, z, qw, qx, qy, qz = map(float, words)
    if any((x, y, z, qx, qy, qz)):
        raise InvalidInputError(
            f"its VIEWPOINT is the pose of a sensor, xyz {[x, y, z]}, quaternion x, y, z, w "
            f"{[qx, qy, qz, qw]}: give that pose as --extrinsics (or as the object's "
            "T_world_object), or the identity if its points are in the base frame, and without "
            "--extrinsics write VIEWPOINT 0 0 0 1 0 0 0"
        )


def _from_rows(body: bytes, row: np.dtype, axes: Sequence[int], count: int) -> np.ndarray:
    """Return points (m, 3) of binary rows; x, y and z are the fields `axes`."""
    if not 0 <= count * row.itemsize <= len(body):
        raise InvalidInputError(
            f"its header says {count} points, the file holds {len(body) // max(1, row.itemsize)}: "
            "cut short?"
        )
    _refuse_more(body[count * row.itemsize :], count)
    rows = np.frombuffer(body, row, count)
    return np.concatenate([rows[str(k)].astype(np.float64) for k in axes], axis=1)


def _unpacked(body: bytes, row: np.dtype, axes: Sequence[int], count: int) -> np.ndarray:
    """Return points (m, 3) of a compressed body: all values of one field after another."""
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    # LZF compresses at most by a factor of 300
    if unpacked != count * row.itemsize or packed > len(body) - 8 or unpacked > 300 * packed:
        raise InvalidInputError(
            f"its header says {count} points of {row.itemsize} bytes, its compressed part "
            f"{unpacked} bytes in {packed} of {len(body) - 8}"
        )
    if unpacked > MAX_UNPACKED:
        raise InvalidInputError(
            f"its points unpack to {unpacked} bytes, at most {MAX_UNPACKED} are read: give fewer "
            "points"
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
    """Refuse data after the last point, except zeros: PCL fills a page of memory with them."""
    if len(rest) >= page or rest.strip(b"\0"):
        raise InvalidInputError(
            f"its header says {count} points, but the file holds more: {len(rest)} bytes"
        )


def _read_ply(data: bytes, posed: bool = False) -> np.ndarray:
    """Return points (m, 3) of the element "vertex" of a PLY file; its properties are no lists.

    PCL writes the pose of the sensor as an element "camera"; as in a PCD file, only a caller that
    has a pose (`posed`) reads a file with one.
    """
    top = re.match(
        rb"ply\s+format (ascii|binary_little_endian|binary_big_endian) "
        rb"(?s:.{0,999999}?)^end_header\r?\n",
        data,
        re.MULTILINE,
    )
    elements: list[tuple[str, int, list[str]]] = []  # name, count, properties, "list NAME" of lists
    for line in top[0].decode("utf-8").splitlines() if top else ():
        words = line.split()
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[-1] if len(words) == 3 else f"list {words[-1]}")
    counts = [count for name, count, _ in elements if name == "vertex"]
    if top is None or len(counts) != 1:
        raise InvalidInputError("it does not begin with a PLY header of ascii or binary vertices")
    read = elements[: [name for name, *_ in elements].index("vertex") + 1]
    for name, _, properties in read:
        listed = [item for item in properties if item.startswith("list ")]
        # trimesh takes the length of the first list for all rows; ascii elements are whole lines
        if listed and (name == "vertex" or top[1] != b"ascii"):
            raise InvalidInputError(
                f"property {listed[0][5:]!r} of its element {name!r} is a list, no plain numbers; "
                "write the vertices first, and without lists"
            )
    if top[1] == b"ascii":
        return _ascii_vertices(data[top.end() :].decode("ascii"), elements, posed)
    # trimesh cannot read empty lines in a header
    data = re.sub(rb"\n\s*\n", b"\n", top[0]) + data[top.end() :]
    import trimesh  # takes 1 s to import

    try:
        loaded = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
        points = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
        camera = loaded.metadata.get("_ply_raw", {}).get("camera", {}).get("data")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InvalidInputError(
            f"its vertices x, y, z cannot be read ({error}): cut short, or no plain numbers?"
        ) from error
    if len(points) != counts[0]:
        raise InvalidInputError(f"its header says {counts[0]} points, the file holds {len(points)}")
    if camera is not None and len(camera) and not posed:
        names = [name for name in camera.dtype.names if re.match("view_p|[xyz]_axis", name)]
        _refuse_camera({name: float(camera[0][name]) for name in names})
    return points


def _refuse_camera(camera: Mapping[str, float]) -> None:
    """Refuse the pose of a sensor that is not the identity, in an element that PCL writes."""
    position = [camera.get(f"view_p{k}", 0.0) for k in "xyz"]
    axes = [[camera.get(f"{a}_axis{k}", float(a == k)) for k in "xyz"] for a in "xyz"]
    if any(position) or axes != np.eye(3).tolist():
        raise InvalidInputError(
            f"its element camera is the pose of a sensor, xyz {position}, axes {axes}: give that "
            "pose as --extrinsics (or as the object's T_world_object), or the identity if its "
            "points are in the base frame, and without --extrinsics remove that element"
        )


def _ascii_vertices(
    text: str, elements: Sequence[tuple[str, int, list[str]]], posed: bool
) -> np.ndarray:
    """Return points (m, 3) of "vertex"; elements: (name, count, properties), a line for each."""
    lines = [line for line in text.splitlines() if line.strip()]
    if sum(count for _, count, _ in elements) != len(lines):
        said = ", ".join(f"{count} {name}" for name, count, _ in elements)
        raise InvalidInputError(f"its header says {said}, the file holds {len(lines)} lines")
    names = [name for name, _, _ in elements]
    if "camera" in names and not posed:
        at = names.index("camera")
        first = sum(count for _, count, _ in elements[:at])
        for line in lines[first : first + elements[at][1]]:
            _refuse_camera(dict(zip(elements[at][2], map(float, line.split()), strict=False)))
    k = names.index("vertex")
    before = sum(count for _, count, _ in elements[:k])
    _, count, properties = elements[k]
    rows = _rows("\n".join(lines[before : before + count]), len(properties))
    return rows[:, _axes_among(properties)]


def _axes_among(names: Sequence[str]) -> list[int]:
    """Return the indices of the columns x, y and z; each must occur once."""
    for axis in "xyz":
        if list(names).count(axis) != 1:
            raise InvalidInputError(
                f"it has no single column {axis!r}; columns: {', '.join(names) or 'none'}"
            )
    return [list(names).index(axis) for axis in "xyz"]


def _rows(text: str, width: int) -> np.ndarray:
    """Return lines of `width` numbers each as an array (m, width)."""
    found = _numbers(text)
    if found.size and found.shape[1] != width:
        raise InvalidInputError(f"it has {found.shape[1]} numbers a line, its header says {width}")
    return found.reshape(-1, width)


def _numbers(
    text: str, chosen: Sequence[int] | None = None, between: str | None = None
) -> np.ndarray:
    """Return all or the chosen columns (m, k) of lines of numbers, with separator `between`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "no data": callers report it
        return np.loadtxt(
            io.StringIO(text), usecols=chosen, ndmin=2, comments=("#", "//"), delimiter=between
        )


# readers of points (m, 3) by the file's suffix
CLOUD_READERS: Mapping[str, Callable[[bytes], np.ndarray]] = {
    ".npy": _read_npy,
    ".pcd": _read_pcd,
    ".ply": _read_ply,
    ".xyz": _read_lines,
    ".txt": _read_lines,
    ".csv": _read_lines,
}
CLOUD_HEADERS = {
    ".pcd": "# .PCD v0.7 - Point Cloud Data file format\n"
    "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    "WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n",
    ".ply": "ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n",
    ".npy": "",  # numpy writes it
}
"""Headers of written clouds by the file's suffix; the points follow."""
