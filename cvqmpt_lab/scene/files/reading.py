"""What readers of clouds and meshes share: whole files, errors in one line, lengths that can be meant."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from cvqmpt_lab.codec.forms import FloatArray
from cvqmpt_lab.errors import InvalidInputError, UnknownChoiceError
from cvqmpt_lab.files import read_bytes

MOST_BYTES = 2**31  # of a file
FARTHEST = 1000.0  # [m] that a coordinate may be from the origin
ROOM = 50.0  # [m] within which at least half of all points must lie
SPECK = 1e-3  # [m] that the whole must exceed in some direction


def file_bytes(path: Path, what: str) -> bytes:
    """The content of a regular file; a pipe, a folder or one beyond `MOST_BYTES` is refused."""
    if path.exists() and not path.is_file():
        raise InvalidInputError(f"cannot read {what} {path}: it is no regular file")
    data = read_bytes(path, what) if not path.exists() or path.stat().st_size <= MOST_BYTES else None
    if data is None:
        raise InvalidInputError(f"cannot read {what} {path}: more than {MOST_BYTES} bytes; make it smaller")
    return data


def kind_of(path: Path, kinds: Mapping[str, object], what: str) -> str:
    """The suffix of a file, in small letters; UnknownChoiceError unless it is one of `kinds`."""
    suffix = path.suffix.lower()
    if suffix not in kinds:
        raise UnknownChoiceError(f"kind of {what} {path.name}: suffix", path.suffix, kinds)
    return suffix


@contextlib.contextmanager
def parsing(path: Path, what: str) -> Iterator[None]:
    """Whatever a parser raises on a damaged file becomes an InvalidInputError in one line that names the file."""
    try:
        yield
    except Exception as error:  # parsers of other people's formats raise anything
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise InvalidInputError(f"{what} {path}: {said}") from error


def check_lengths(points: FloatArray, what: str, room: float = ROOM) -> None:
    """Refuse points (m, 3) [m], m >= 1, that cannot be metres: the message says which unit they may be in.

    room: [m] within which at least half of them must lie.
    """
    off = np.maximum.reduce([np.abs(axis) for axis in points.T])
    largest = float(off.max())
    if largest > FARTHEST:
        row = int(np.argmax(off))
        raise InvalidInputError(
            f"{what}: point {row} is {largest:.3g} m off the origin, more than {FARTHEST:g}; "
            "scale or remove it (millimetres: scale 0.001)"
        )
    middling = float(np.median(off))
    if middling > room:
        raise InvalidInputError(
            f"{what}: half of it is more than {middling:.3g} m off the origin: no metres? give a scale "
            "(millimetres: 0.001), or move it to the robot"
        )
    extent = max(float(np.ptp(axis)) for axis in points.T)
    if len(points) > 1 and extent < SPECK:
        raise InvalidInputError(
            f"{what}: all of it lies within {1e3 * extent:.3g} mm: no metres? give a scale (kilometres: 1000)"
        )
