"""Arrays of NPY files, without the memory that a lying header asks for."""

import io
import math

import numpy as np

from cvqmpt_lab.errors import InvalidInputError

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_array(data: bytes) -> np.ndarray:
    """The array of a NPY file, read-only.

    Raises
    ------
    InvalidInputError: another size than the header says, Python objects, an unknown version.
    ValueError: what numpy says of a damaged header.
    """
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise InvalidInputError(f"NPY version {version} is not known; write version 1 or 2")
    shape, by_column, kind = HEADERS[version](stream)
    if kind.hasobject:
        raise InvalidInputError("it holds Python objects, which may run code; write plain numbers")
    if min(shape, default=0) < 0 or math.prod(shape) * kind.itemsize != len(data) - stream.tell():
        raise InvalidInputError(f"its header says shape {shape} of {kind}, the file holds another size")
    return np.frombuffer(data, kind, offset=stream.tell()).reshape(shape, order="F" if by_column else "C")
