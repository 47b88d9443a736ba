"""The paths of a run's rows, kept beside them: ``paths.npz``, arrays of states by the hash that stands in the row.

Read one with ``numpy.load("paths.npz")[row.path_sha256]``. While a run goes on, paths are appended to
``paths.partial.npy``, one array after another; `merge_paths` moves them over.
"""

import hashlib
import io
import os
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.files import read_bytes, replacing

PATHS_FILE = "paths.npz"
PARTIAL_PATHS = "paths.partial.npy"
BROKEN = (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error)


def states_hash(states: np.ndarray) -> str:
    """sha256 of the bytes of states (m, n): equal for bit-for-bit equal paths."""
    return hashlib.sha256(np.ascontiguousarray(states, dtype=np.float64).tobytes()).hexdigest()


def array_bytes(states: np.ndarray) -> bytes:
    """States as they are appended to PARTIAL_PATHS."""
    stream = io.BytesIO()
    np.save(stream, np.ascontiguousarray(states, dtype=np.float64), allow_pickle=False)
    return stream.getvalue()


class KeptPaths(Mapping[str, np.ndarray]):
    """Read-only view of a folder's ``paths.npz``; a path is read, and compared with its hash, when it is asked for."""

    def __init__(self, directory: Path) -> None:
        """Empty when there is no such file; RunStoreError when it is damaged."""
        self._path = Path(directory) / PATHS_FILE
        try:
            self._arrays = np.load(self._path, allow_pickle=False) if self._path.exists() else {}
            self._names = frozenset(self._arrays)
        except BROKEN as error:
            raise RunStoreError(f"{self._path} is damaged: {error}; run again into another folder") from error

    def __getitem__(self, sha256: str) -> np.ndarray:
        """States (m, n) [rad or m]; RunStoreError when they are not those that were kept."""
        if sha256 not in self._names:
            raise KeyError(sha256)
        try:
            states = self._arrays[sha256]
        except BROKEN as error:
            raise RunStoreError(f"{self._path} is damaged: path {sha256} cannot be read: {error}") from error
        if not isinstance(states, np.ndarray) or states_hash(states) != sha256:
            raise RunStoreError(f"{self._path} is damaged: what it holds as path {sha256} has another hash")
        return states

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._names))

    def __len__(self) -> int:
        return len(self._names)


def merge_paths(directory: Path, wanted: Collection[str]) -> None:
    """Move what `array_bytes` left in PARTIAL_PATHS to PATHS_FILE, which then holds the paths with wanted hashes.

    An array that was cut short, by a kill or a full disk, ends what is read: its row was never written.
    """
    partial = Path(directory) / PARTIAL_PATHS
    if not partial.is_file():
        return
    kept = {states_hash(states): states for states in _whole_arrays(read_bytes(partial))}
    arrays: dict[str, Any] = {**KeptPaths(directory), **kept}
    with replacing(Path(directory) / PATHS_FILE) as temporary, temporary.open("wb") as handle:
        np.savez_compressed(handle, **{name: arrays[name] for name in sorted(arrays.keys() & set(wanted))})
        handle.flush()
        os.fsync(handle.fileno())
    partial.unlink()


def _whole_arrays(data: bytes) -> Iterator[np.ndarray]:
    stream = io.BytesIO(data)
    while stream.tell() < len(data):
        try:
            yield np.load(stream, allow_pickle=False)
        except BROKEN:
            return
