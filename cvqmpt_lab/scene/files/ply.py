"""Points of a PLY file: its element "vertex", which must come first and hold plain numbers."""

from collections.abc import Sequence

import numpy as np

from cvqmpt_lab.errors import InvalidInputError
from cvqmpt_lab.scene.files.columns import MOST_COLUMNS, Column, as_counted, from_rows, from_text

TYPES = {
    **{"char": "i1", "short": "i2", "int": "i4", "uchar": "u1", "ushort": "u2", "uint": "u4"},
    **{"int8": "i1", "int16": "i2", "int32": "i4", "uint8": "u1", "uint16": "u2", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
LONGEST_HEADER = 1_000_000  # [bytes]


def read_ply(data: bytes) -> np.ndarray:
    """Points (m, 3) of a PLY file; elements after the vertices are not looked at."""
    end = data.find(b"end_header", 0, LONGEST_HEADER)
    begin = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or begin == 0:
        raise InvalidInputError("it does not begin with a PLY header: no PLY, or cut short")
    form, columns, count = _vertices([line.split() for line in data[:end].decode("utf-8").splitlines()])
    body = data[begin:]
    if form == "ascii":
        lines = body.decode("ascii").split("\n", count)[:count] if 0 <= count <= len(body) else []
        return as_counted(from_text("\n".join(lines), columns), count)
    return from_rows(body, columns, count, FORMATS[form])


def _vertices(lines: Sequence[Sequence[str]]) -> tuple[str, list[Column], int]:
    """The format, the columns of the element "vertex" and how many there are."""
    form = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), "")
    if form not in FORMATS:
        raise InvalidInputError(f"its format is {form!r}; known: {', '.join(FORMATS)}")
    elements = [k for k, line in enumerate(lines) if line[:1] == ["element"]]
    if not elements or lines[elements[0]][1:2] != ["vertex"] or len(lines[elements[0]]) != 3:
        raise InvalidInputError("its first element is not 'vertex'")
    first, last = elements[0], elements[1] if len(elements) > 1 else len(lines)
    columns = []
    for line in lines[first + 1 : last]:
        if line[:1] == ["property"]:
            if len(line) != 3 or line[1] not in TYPES:
                raise InvalidInputError(f"its property {' '.join(line[1:])!r} of 'vertex' is no plain number")
            columns.append(Column(line[2], TYPES[line[1]]))
    if len(columns) > MOST_COLUMNS:
        raise InvalidInputError(f"its element 'vertex' has {len(columns)} properties; {MOST_COLUMNS} at most")
    return form, columns, int(lines[first][2])
