"""Read files by their suffix, and fields of plain data that somebody else wrote."""

import contextlib
import io
import math
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    at,
    require_choice,
    shown,
)
from cvqmpt_lab.base.files import json_value, read_bytes, yaml_value

NPZ_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def read_by_suffix(
    readers: Mapping[str, Callable[..., Any]],
    path: Path | str,
    what: str,
    *more: Any,
    most: int = 2**31,
) -> Any:
    """Return the result of the reader for a file's suffix; errors are one line with the file.

    Args:
        readers: functions of the file's bytes, by suffix in small letters.
        path: path of a regular file.
        what: noun for the file in errors.
        more: arguments of the reader after the bytes.
        most: largest size of the file [bytes].

    Raises:
        InvalidInputError: the file cannot be read.
        UnknownChoiceError: no reader has this suffix.
    """
    path = Path(path)
    reader = readers[kind_of(path, readers, what)]
    if path.is_file() and path.stat().st_size > most:
        raise InvalidInputError(
            f"cannot read {what} {path}: more than {most} bytes; make it smaller"
        )
    data = read_bytes(path, what)
    with parsing(path, what), np.errstate(over="ignore", invalid="ignore"):
        return reader(data, *more)


def plain_readers(
    read: Callable[..., Any] = lambda value: value,
) -> dict[str, Callable[..., Any]]:
    """Return readers of json and yaml files by suffix: `read` gets the value, then the others."""

    def of_json(data: bytes, *more: Any) -> Any:
        return read(json_value(data.decode("utf-8-sig"), "it"), *more)

    def of_yaml(data: bytes, *more: Any) -> Any:
        return read(yaml_value(data.decode("utf-8-sig")), *more)

    return {".json": of_json, ".yaml": of_yaml, ".yml": of_yaml}


def kind_of(path: Path | str, kinds: Collection[str], what: str) -> str:
    """Return the suffix of a file in small letters; UnknownChoiceError if it is not in `kinds`."""
    path = Path(path)
    return require_choice(f"kind of {what} {path.name}: suffix", path.suffix.lower(), kinds)


@contextlib.contextmanager
def parsing(path: Path, what: str) -> Iterator[None]:
    """Convert every error of a parser inside the block to an InvalidInputError with the file."""
    try:
        yield
    except Exception as error:  # parsers of other packages raise all kinds of errors
        said = " ".join(str(error).split()) or type(error).__name__
        if not isinstance(error, CvqmptError):  # own messages end with the cure
            said = said[:200]
        raise InvalidInputError(f"{what} {path} cannot be parsed: {said}") from error


def listed(value: Any, what: str) -> Sequence[Any]:
    """Return a list, empty for None; refuse any other value."""
    if value is not None and not isinstance(value, list):
        raise InvalidInputError(f"{at('', what)} is {shown(value)}; it must be a list")
    return value or []


def field_of(value: Any, name: str) -> Any:
    """Return a field of a mapping, or None."""
    return value.get(name) if isinstance(value, Mapping) else None


def read_array(data: bytes | bytearray) -> np.ndarray:
    """Return the array of an NPY file of version 1 or 2, read-only.

    Raises:
        InvalidInputError, ValueError: the file is damaged or has Python objects.
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
    if 0 in (kind.itemsize, *shape):
        return np.empty(shape, kind)
    array = np.frombuffer(data, kind, offset=stream.tell())
    return array.reshape(shape, order="F" if by_column else "C")


def read_arrays(data: bytes, most: int = 2**31) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ file by name.

    Sizes are compared with `most` before anything is unpacked: 4 MB can hold 4 GB of zeros.

    Args:
        data: content of the file.
        most: largest size of all arrays together [bytes].

    Raises:
        InvalidInputError, ValueError, zipfile.BadZipFile: the file is damaged, too large or has
            Python objects.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        odd = next((one for one in members if one.compress_type not in NPZ_COMPRESSIONS), None)
        if odd is not None:
            raise InvalidInputError(
                f"{shown(odd.filename)} is compressed in a way that numpy does not write; save it "
                "by np.savez_compressed"
            )
        size = sum(one.file_size for one in members)
        if size > most:
            raise InvalidInputError(
                f"it unpacks to {size} bytes, at most {most} are read: save fewer or smaller arrays"
            )
        return {
            one.filename.removesuffix(".npy"): read_array(bytearray(archive.read(one)))
            for one in members
        }
