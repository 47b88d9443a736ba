"""A directory of runs that survives interruption and can be continued.

The paths of its rows lie beside them: ``paths.npz``, arrays of states by the hash that stands in
the row. Read one with ``numpy.load("paths.npz")[row.path_sha256]``.
"""

import contextlib
import hashlib
import io
import os
import time
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.files import locked, make_folder, read_bytes, write_bytes
from cvqmpt_lab.results.provenance import PROVENANCE_FILE, ProvenanceFile
from cvqmpt_lab.results.row import (
    RUNS_FILE,
    ResultRow,
    RowKey,
    csv_text,
    parse_rows,
    read_rows,
    sorted_rows,
    write_rows,
)

PARTIAL_FILE = "runs.partial.csv"
PATHS_FILE = "paths.npz"
PARTIAL_PATHS = "paths.partial.npy"
BROKEN = (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error)


class RunStore:
    """A directory with ``runs.csv``, ``paths.npz`` and ``provenance.json`` that grows run by run.

    One process appends (its workers hand it their rows). Before `append` returns, the paths of a
    run and then its rows are on disk, the rows in ``runs.partial.csv`` with an empty line after
    them. Leaving the ``with`` block of `open`, for any reason, merges them into ``runs.csv`` and
    ``paths.npz``. After a kill the next `open` merges what was left, without a run whose rows were
    cut short.
    """

    def __init__(self, directory: Path, later_session: Mapping[str, object] | None) -> None:
        """Use `RunStore.open`."""
        self.directory = directory
        self._later_session = later_session  # of a continuation, written with its first row
        self._appended = False
        self._rows: dict[RowKey, ResultRow] = {}

    @classmethod
    @contextlib.contextmanager
    def open(
        cls,
        directory: Path,
        configuration: Mapping[str, object],
        session: Mapping[str, object] | None = None,
    ) -> Iterator["RunStore"]:
        """Create a store, or continue one with equal configuration and weights.

        Args:
            configuration: every setting that must not change within one table (suite, cutoff, ...).
            session: of `provenance`; a continued store lists it when it adds a row.

        InvalidInputError: the directory cannot be made, or is in use. RunStoreError: it is
        read-only, was made with another configuration or other weights (the message names which),
        or holds runs without provenance or with foreign columns.
        """
        directory = make_folder(directory)
        if not os.access(directory, os.R_OK | os.W_OK):
            raise RunStoreError(f"{directory} is read-only; choose a writable --out")
        with locked(directory):
            record = ProvenanceFile(directory)
            files = (PROVENANCE_FILE, RUNS_FILE, PARTIAL_FILE)
            is_new = not any((directory / name).exists() for name in files)
            if is_new:
                record.create(configuration, session or {})
            else:
                record.require_same(configuration, session or {})
            store, began = cls(directory, None if is_new else session), time.monotonic()
            store._recover()
            try:
                yield store
            finally:
                store._merge()
                if store._appended:
                    record.add_wall_clock(time.monotonic() - began)

    def _recover(self) -> None:
        """Load the merged rows, and merge what an interrupted session left behind."""
        merged, partial = self.directory / RUNS_FILE, self.directory / PARTIAL_FILE
        stored_paths(self.directory)  # refused before hours of work, not after
        if merged.is_file():
            self._rows = {row.key: row for row in read_rows(merged)}
        if partial.is_file():
            whole = read_bytes(partial).rpartition(b"\n\n")[0]
            left = parse_rows(partial, whole.decode("utf-8", "replace"), header=False)
            self._rows |= {row.key: row for row in left}
        if partial.is_file() or (self.directory / PARTIAL_PATHS).is_file():
            self._merge()

    def _merge(self) -> None:
        """Merge the partial files; of paths those that stand in rows are kept."""
        partial = self.directory / PARTIAL_PATHS
        if partial.is_file():
            known: dict[str, Any] = stored_paths(self.directory)
            known |= {states_hash(states): states for states in _whole_arrays(read_bytes(partial))}
            wanted = sorted(known.keys() & {row.path_sha256 for row in self._rows.values()})
            buffer = io.BytesIO()
            np.savez_compressed(buffer, **{name: known[name] for name in wanted})
            write_bytes(self.directory / PATHS_FILE, buffer.getvalue())
            partial.unlink()
        write_rows(self.directory / RUNS_FILE, self._rows.values())
        (self.directory / PARTIAL_FILE).unlink(missing_ok=True)

    def rows(self) -> list[ResultRow]:
        """All rows so far, in the order of `sorted_rows`."""
        return sorted_rows(self._rows.values())

    def done(self) -> frozenset[RowKey]:
        """Keys of finished runs; a task counts as one run, under its own name."""
        return frozenset(row.run_key for row in self._rows.values())

    def append(self, rows: Sequence[ResultRow], paths: Sequence[np.ndarray] = ()) -> None:
        """Add all rows of one run and its paths' states (m, n), and force them to disk.

        A row with a known key replaces the earlier one. RunStoreError: the disk is full.
        """
        if self._later_session is not None:
            ProvenanceFile(self.directory).add_continuation(self._later_session)
            self._later_session = None
        self._appended = True
        # before they are on disk: an interrupt in between merges these and drops the partial file
        self._rows |= {row.key: row for row in rows}
        arrays, text = io.BytesIO(), csv_text(rows, header=False) + "\n"
        for states in paths:
            np.save(arrays, np.ascontiguousarray(states, dtype=np.float64), allow_pickle=False)
        if paths:
            self._append_to(PARTIAL_PATHS, arrays.getvalue())
        self._append_to(PARTIAL_FILE, text.encode("utf-8"))

    def _append_to(self, name: str, data: bytes) -> None:
        """Append to a file and wait until it is on the disk; `_recover` drops what is cut short."""
        try:
            with (self.directory / name).open("ab") as handle:
                handle.write(data)
                handle.flush()
                os.fsync(handle.fileno())
        except OSError as error:
            raise RunStoreError(f"cannot append to {self.directory}: {error.strerror}") from error


def states_hash(states: np.ndarray) -> str:
    """sha256 of the bytes of states (m, n): equal for bit-for-bit equal paths."""
    return hashlib.sha256(np.ascontiguousarray(states, dtype=np.float64).tobytes()).hexdigest()


def stored_paths(directory: Path) -> dict[str, np.ndarray]:
    """States (m, n) [rad or m] of ``paths.npz`` by their hash; none where there is no such file.

    RunStoreError: the file is damaged, or an array has another hash.
    """
    path = Path(directory) / PATHS_FILE
    if not path.exists():
        return {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            found = dict(arrays)
    except BROKEN as error:
        raise RunStoreError(f"{path} is damaged: {error}; run again into another folder") from error
    for sha256, states in found.items():
        if states_hash(states) != sha256:
            raise RunStoreError(
                f"{path} is damaged: what it holds as path {sha256} has another hash"
            )
    return found


def _whole_arrays(data: bytes) -> Iterator[np.ndarray]:
    """The arrays in a file of them, up to one that a kill or a full disk has cut short."""
    stream = io.BytesIO(data)
    while stream.tell() < len(data):
        try:
            yield np.load(stream, allow_pickle=False)
        except BROKEN:
            return
