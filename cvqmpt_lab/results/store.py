"""A directory of runs that survives interruption and can be continued.

The paths of its rows lie beside them: ``paths.npz``, arrays of states by the hash that stands in
the row. Read one with ``numpy.load("paths.npz")[row.path_sha256]``.
"""

import errno
import hashlib
import io
import os
import time
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.files import lock as lock_folder
from cvqmpt_lab.files import read_bytes, replacing, unlock
from cvqmpt_lab.results import row as rows_csv
from cvqmpt_lab.results.provenance import ProvenanceFile
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, RowKey

PARTIAL_FILE = "runs.partial.csv"
PATHS_FILE = "paths.npz"
PARTIAL_PATHS = "paths.partial.npy"
BROKEN = (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error)


class RunStore:
    """A directory with ``runs.csv``, ``paths.npz`` and ``provenance.json`` that grows run by run.

    One process appends (its workers hand it their rows). Before `append` returns, the paths of a
    run and then its rows are on disk, the rows in ``runs.partial.csv`` with an empty line after
    them. `finish`, or leaving the ``with`` block for any reason, merges them into ``runs.csv`` and
    ``paths.npz``. After a kill the next `open` merges what was left, without a run whose rows were
    cut short.
    """

    def __init__(
        self, directory: Path, lock: int, later_session: Mapping[str, object] | None
    ) -> None:
        """Use `RunStore.open`."""
        self.directory = directory
        self._lock: int | None = lock
        self._later_session = later_session  # of a continuation, written with its first row
        self._began, self._appended = time.monotonic(), False
        self._partials: dict[str, io.FileIO] = {}
        self._rows: dict[RowKey, ResultRow] = {}

    @classmethod
    def open(
        cls,
        directory: Path,
        configuration: Mapping[str, object],
        session: Mapping[str, object] | None = None,
    ) -> "RunStore":
        """Create a store, or continue one with equal configuration and weights.

        configuration: every setting that must not change within one table (suite, cutoff, ...).
        session: of `provenance`; a continued store lists it when it adds a row.

        RunStoreError when the directory cannot be written, is in use, was made with another
        configuration or other weights (the message names which), or holds runs without provenance
        or with foreign columns.
        """
        directory = Path(directory)
        try:
            directory.mkdir(parents=True, exist_ok=True)
            lock = lock_folder(directory)
        except OSError as error:
            raise RunStoreError(
                f"cannot use {directory}: {error.strerror}; use another --out"
            ) from error
        try:
            if not os.access(directory, os.W_OK):
                raise RunStoreError(f"{directory} is read-only; choose a writable --out")
            record = ProvenanceFile(directory)
            names = (record.path.name, RUNS_FILE, PARTIAL_FILE)
            is_new = not any((directory / name).exists() for name in names)
            if is_new:
                record.create(configuration, session or {})
            else:
                record.require_same(configuration, session or {})
            store = cls(directory, lock, None if is_new else session)
            store._recover()
        except BaseException:
            unlock(lock)
            raise
        return store

    def _recover(self) -> None:
        """Load the merged rows, and merge what an interrupted session left behind."""
        merged, partial = self.directory / RUNS_FILE, self.directory / PARTIAL_FILE
        StoredPaths(self.directory)  # refused before hours of work, not after
        if merged.is_file():
            self._rows = {row.key: row for row in rows_csv.read_rows(merged)}
        if partial.is_file():
            data = read_bytes(partial)
            whole = data[: data.rfind(b"\n\n") + 2] if b"\n\n" in data else b""
            left = rows_csv.parse_rows(partial, whole.decode("utf-8", "replace"), header=False)
            self._rows |= {row.key: row for row in left}
        if partial.is_file() or (self.directory / PARTIAL_PATHS).is_file():
            self._merge()

    def _merge(self) -> None:
        merge_paths(
            self.directory, {row.path_sha256 for row in self._rows.values() if row.path_sha256}
        )
        rows_csv.write_rows(self.directory / RUNS_FILE, self._rows.values())
        (self.directory / PARTIAL_FILE).unlink(missing_ok=True)

    def rows(self) -> list[ResultRow]:
        """All rows so far, in the order of `sorted_rows`."""
        return rows_csv.sorted_rows(self._rows.values())

    def done(self) -> frozenset[RowKey]:
        """Keys of finished runs; a task counts as one run, under its own name."""
        return frozenset(row.run_key for row in self._rows.values())

    def append(self, rows: Sequence[ResultRow], paths: Sequence[np.ndarray] = ()) -> None:
        """Add all rows of one run and its paths' states (m, n), and force them to disk.

        A row with a known key replaces the earlier one. RunStoreError: finished, or disk full.
        """
        if self._lock is None:
            raise RunStoreError(f"the store {self.directory} is finished; open it again to append")
        if self._later_session is not None:
            ProvenanceFile(self.directory).add_continuation(self._later_session)
            self._later_session = None
        self._appended = True
        self._rows |= {row.key: row for row in rows}
        try:
            if paths:
                self._append_to(PARTIAL_PATHS, b"".join(map(array_bytes, paths)))
            self._append_to(
                PARTIAL_FILE, (rows_csv.csv_text(rows, header=False) + "\n").encode("utf-8")
            )
        except OSError as error:
            raise RunStoreError(f"cannot append to {self.directory}: {error.strerror}") from error

    def _append_to(self, name: str, data: bytes) -> None:
        """Append all of it to a file or, when the disk is full, nothing."""
        if name not in self._partials:
            self._partials[name] = io.FileIO(self.directory / name, "a")
        handle = self._partials[name]
        size = os.fstat(handle.fileno()).st_size
        if handle.write(data) != len(data):
            handle.truncate(size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(handle.fileno())

    def finish(self) -> None:
        """Merge everything into ``runs.csv``, remove the partial file and release the directory."""
        if self._lock is None:
            return
        lock, self._lock = self._lock, None
        try:
            for handle in self._partials.values():
                handle.close()
            self._merge()
            if self._appended:
                ProvenanceFile(self.directory).add_wall_clock(time.monotonic() - self._began)
        finally:
            unlock(lock)

    def __enter__(self) -> "RunStore":
        return self

    def __exit__(self, *exception: object) -> None:
        self.finish()


def states_hash(states: np.ndarray) -> str:
    """sha256 of the bytes of states (m, n): equal for bit-for-bit equal paths."""
    return hashlib.sha256(np.ascontiguousarray(states, dtype=np.float64).tobytes()).hexdigest()


def array_bytes(states: np.ndarray) -> bytes:
    """States as they are appended to PARTIAL_PATHS."""
    stream = io.BytesIO()
    np.save(stream, np.ascontiguousarray(states, dtype=np.float64), allow_pickle=False)
    return stream.getvalue()


class StoredPaths(Mapping[str, np.ndarray]):
    """Read-only view of ``paths.npz``; a path is read, and its hash compared, on access."""

    def __init__(self, directory: Path) -> None:
        """Empty when there is no such file; RunStoreError when it is damaged."""
        self._path = Path(directory) / PATHS_FILE
        try:
            self._arrays = np.load(self._path, allow_pickle=False) if self._path.exists() else {}
            self._names = frozenset(self._arrays)
        except BROKEN as error:
            raise RunStoreError(
                f"{self._path} is damaged: {error}; run again into another folder"
            ) from error

    def __getitem__(self, sha256: str) -> np.ndarray:
        """States (m, n) [rad or m]; RunStoreError when they are not those that were stored."""
        if sha256 not in self._names:
            raise KeyError(sha256)
        try:
            states = self._arrays[sha256]
        except BROKEN as error:
            raise RunStoreError(
                f"{self._path} is damaged: path {sha256} cannot be read: {error}"
            ) from error
        if not isinstance(states, np.ndarray) or states_hash(states) != sha256:
            raise RunStoreError(
                f"{self._path} is damaged: what it holds as path {sha256} has another hash"
            )
        return states

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._names))

    def __len__(self) -> int:
        return len(self._names)


def merge_paths(directory: Path, wanted: Collection[str]) -> None:
    """Merge PARTIAL_PATHS into PATHS_FILE, which then holds the paths with wanted hashes.

    Reading ends at an array cut short by a kill or a full disk: its row was never written.
    """
    partial = Path(directory) / PARTIAL_PATHS
    if not partial.is_file():
        return
    kept = {states_hash(states): states for states in _whole_arrays(read_bytes(partial))}
    arrays: dict[str, Any] = {**StoredPaths(directory), **kept}
    with replacing(Path(directory) / PATHS_FILE) as temporary, temporary.open("wb") as handle:
        np.savez_compressed(
            handle, **{name: arrays[name] for name in sorted(arrays.keys() & set(wanted))}
        )
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
