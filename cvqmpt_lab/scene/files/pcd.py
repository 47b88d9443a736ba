"""Points as the Point Cloud Library writes them: ascii, binary, or compressed by LZF."""

from collections.abc import Mapping, Sequence

import lzf
import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.files.columns import (
    MOST_COLUMNS,
    Column,
    as_counted,
    from_rows,
    from_text,
    row_bytes,
    three,
)

TYPES = {("F", 4): "f4", ("F", 8): "f8"} | {
    (kind, size): f"{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)
}
EXPANSION = 300  # bytes at most that LZF makes of one
LONGEST_LINE = 100_000  # [bytes] of a header


def read_pcd(data: bytes) -> np.ndarray:
    """Points (m, 3) of a PCD file."""
    header, at = _header(data)
    columns = _columns(header)
    count = int(header["POINTS"][0])
    width, height = int(header.get("WIDTH", [str(count)])[0]), int(header.get("HEIGHT", ["1"])[0])
    if count < 0 or width * height != count:
        raise InvalidInputError(f"its header says {count} points, but {width} x {height}")
    body, form = data[at:], header["DATA"][0].lower()
    if form == "ascii":
        return as_counted(from_text(body.decode("ascii"), columns), count)
    if form == "binary":
        if body[count * row_bytes(columns) :].strip(b"\0\n"):  # pages are filled up with zeros
            raise InvalidInputError(f"its header says {count} points, but the file holds more")
        return from_rows(body, columns, count, "<")
    if form == "binary_compressed":
        return _unpacked(body, columns, count)
    raise InvalidInputError(f"its DATA is {form!r}; known: ascii, binary, binary_compressed")


def _header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """The header's words by their key, and where the points begin."""
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = data.find(b"\n", at, at + LONGEST_LINE)
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


def _columns(header: Mapping[str, Sequence[str]]) -> list[Column]:
    """The numbers of each row; a field of several has several of one name."""
    fields, kinds, sizes = header["FIELDS"], header["TYPE"], [int(word) for word in header["SIZE"]]
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(fields))]
    if not len(fields) == len(kinds) == len(sizes) == len(counts):
        raise InvalidInputError("its header's FIELDS, SIZE, TYPE and COUNT have not the same length")
    if min(counts) < 1 or sum(counts) > MOST_COLUMNS:
        raise InvalidInputError(f"its header's COUNT is {counts}; give 1 or more, {MOST_COLUMNS} together")
    for kind, size in zip(kinds, sizes, strict=True):
        if (kind, size) not in TYPES:
            raise InvalidInputError(f"its header's TYPE {kind} of SIZE {size} does not exist")
    described = zip(fields, kinds, sizes, counts, strict=True)
    return [Column(name, TYPES[kind, size]) for name, kind, size, count in described for _ in range(count)]


def _unpacked(body: bytes, columns: Sequence[Column], count: int) -> np.ndarray:
    """Points of a compressed body, which holds one column after the other."""
    if len(body) < 8:
        raise InvalidInputError("its compressed points are cut short")
    packed, unpacked = (int(size) for size in np.frombuffer(body, "<u4", 2))
    row = row_bytes(columns)
    if unpacked != count * row or packed > len(body) - 8 or unpacked > EXPANSION * packed:
        raise InvalidInputError(
            f"its header says {count} points of {row} bytes, its compressed part {unpacked} bytes in {packed} "
            f"of {len(body) - 8}"
        )
    raw = lzf.decompress(body[8 : 8 + packed], unpacked) if unpacked else b""
    if raw is None or len(raw) != unpacked:
        raise InvalidInputError("its compressed points cannot be unpacked")
    begins = count * np.cumsum([0, *(np.dtype(column.kind).itemsize for column in columns)])
    return three(columns, lambda k: np.frombuffer(raw, f"<{columns[k].kind}", count, int(begins[k])))
