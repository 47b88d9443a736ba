"""A results directory that keeps finished runs after an interruption and can be continued.

``paths.npz`` has the states of the rows' paths; the name of each array is the row's `path_sha256`.
Read a path by ``numpy.load("paths.npz")[row.path_sha256]``.
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

from cvqmpt_lab.base.errors import InvalidInputError, RunStoreError
from cvqmpt_lab.base.files import locked, make_folder, read_bytes, write_bytes
from cvqmpt_lab.base.readers import read_arrays
from cvqmpt_lab.benchmarks.results.provenance import PROVENANCE_FILE, ProvenanceFile
from cvqmpt_lab.benchmarks.results.row import (
    RUNS_FILE,
    ResultRow,
    RowKey,
    csv_text,
    ended_runs,
    parse_rows,
    read_rows,
    sorted_rows,
    without_ended,
    write_rows,
)

PARTIAL_FILE = "runs.partial.csv"
PATHS_FILE = "paths.npz"
PARTIAL_PATHS = "paths.partial.npy"
# errors of numpy for a damaged file
DAMAGE_ERRORS = (ValueError, EOFError, OSError, KeyError, zipfile.BadZipFile, zlib.error)


class RunStore:
    """A directory with ``runs.csv``, ``paths.npz`` and ``provenance.json`` that grows run by run.

    Only one process appends (workers send it their rows). `append` writes the paths of a run to
    ``paths.partial.npy`` and then its rows, with a header, to ``runs.partial.csv``; an empty line
    after them marks the run as complete. The end of the ``with`` block of `open` merges both into
    ``paths.npz`` and ``runs.csv``. If the process was killed, the next `open` merges them; it drops
    a run whose rows are incomplete.
    """

    def __init__(self, directory: Path, later_session: Mapping[str, object] | None) -> None:
        """Make a store; use `RunStore.open` instead."""
        self.directory = directory
        self._later_session = later_session  # written with the first row of a continuation
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
            directory: folder of the store; it is made if it does not exist.
            configuration: settings that must not change within one table (suite, cutoff, ...).
            session: result of `provenance`; a continued store writes it with the first new row.

        Raises:
            InvalidInputError: the directory cannot be made, or is in use.
            RunStoreError: the directory is read-only, has another configuration or other weights
                (the message names them), or has runs without provenance or with other columns.
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
            store = cls(directory, None if is_new else session)
            began = time.monotonic()
            store._recover()
            suite = configuration.get("suite")
            foreign = sorted({row.suite for row in store.rows()} - {suite})
            if suite and foreign:  # refused now, not by the tables after hours of work
                raise RunStoreError(
                    f"{directory / RUNS_FILE} has rows of {', '.join(foreign)}, but "
                    f"{PROVENANCE_FILE} is of suite {suite}; use another --out"
                )
            try:
                yield store
            finally:
                store._merge()
                if store._appended:
                    record.add_wall_clock(time.monotonic() - began)

    def _recover(self) -> None:
        """Load the merged rows, then merge the partial files of an interrupted session."""
        merged, partial = self.directory / RUNS_FILE, self.directory / PARTIAL_FILE
        stored_paths(self.directory)  # refuses a damaged file now, not after hours of work
        if merged.is_file():
            self._rows = {row.key: row for row in read_rows(merged)}
        if partial.is_file():
            *whole, _ = read_bytes(partial).decode("utf-8", "replace").split("\n\n")
            for run in whole:
                self._rows |= {row.key: row for row in parse_rows(partial, run)}
        if partial.is_file() or (self.directory / PARTIAL_PATHS).is_file():
            self._merge()

    def _merge(self) -> None:
        """Merge the partial files into the final ones; drop paths that no row refers to."""
        partial = self.directory / PARTIAL_PATHS
        if partial.is_file():
            known: dict[str, Any] = stored_paths(self.directory)
            known |= {states_hash(states): states for states in _intact_arrays(read_bytes(partial))}
            wanted = sorted(known.keys() & {row.path_sha256 for row in self._rows.values()})
            buffer = io.BytesIO()
            np.savez_compressed(buffer, **{name: known[name] for name in wanted})
            write_bytes(self.directory / PATHS_FILE, buffer.getvalue())
            partial.unlink()
        write_rows(self.directory / RUNS_FILE, self._rows.values())
        (self.directory / PARTIAL_FILE).unlink(missing_ok=True)

    def rows(self) -> list[ResultRow]:
        """Return all rows so far, in the order of `sorted_rows`."""
        return sorted_rows(self._rows.values())

    def done(self) -> frozenset[RowKey]:
        """Return the keys of finished runs; a task is one run with the name of the task."""
        return frozenset(row.run_key for row in without_ended([*self._rows.values()]))

    def append(self, rows: Sequence[ResultRow], paths: Sequence[np.ndarray] = ()) -> None:
        """Add all rows of one run and the states (m, n) of its paths; wait until they are on disk.

        A row replaces an earlier one with the same key. RunStoreError: the disk is full.
        """
        if self._later_session is not None:
            ProvenanceFile(self.directory).add_continuation(self._later_session)
            self._later_session = None
        self._appended = True
        # before writing: after an interrupt in between, `_merge` still writes these rows
        self._rows |= {row.key: row for row in rows}
        arrays = io.BytesIO()
        text = csv_text(rows) + "\n"
        for states in paths:
            np.save(arrays, np.ascontiguousarray(states, dtype=np.float64), allow_pickle=False)
        if paths:
            self._append_to(PARTIAL_PATHS, arrays.getvalue())
        self._append_to(PARTIAL_FILE, text.encode("utf-8"))

    def _append_to(self, name: str, data: bytes) -> None:
        """Append to a file and wait until it is on disk; `_recover` drops an incomplete end."""
        try:
            with (self.directory / name).open("ab") as handle:
                handle.write(data)
                handle.flush()
                os.fsync(handle.fileno())
        except OSError as error:
            raise RunStoreError(f"cannot append to {self.directory}: {error.strerror}") from error


def directory_rows(directory: Path) -> list[ResultRow]:
    """Return the rows of a results directory, see `rows_and_note`."""
    return rows_and_note(directory)[0]


def rows_and_note(directory: Path) -> tuple[list[ResultRow], str]:
    """Return the rows without runs that the guard ended, and a sentence on these, or "".

    RunStoreError: there are no rows; the message has advice.
    """
    advice = f"run an experiment with --out {directory} first"
    if not directory.is_dir():
        raise RunStoreError(f"{directory} is not a directory; {advice}")
    if not (directory / RUNS_FILE).is_file():
        if (directory / PARTIAL_FILE).is_file():
            raise RunStoreError(
                f"{directory} holds an interrupted run; repeat its command to continue it"
            )
        raise RunStoreError(f"{directory} has no {RUNS_FILE}; {advice}")
    rows = read_rows(directory / RUNS_FILE)
    if not rows:
        raise RunStoreError(f"{directory / RUNS_FILE} has no rows; {advice}")
    counted = without_ended(rows)
    if not counted:
        raise RunStoreError(f"{directory}: every run was ended by the guard; repeat the command")
    ended = ended_runs(rows)
    if not ended:
        return counted, ""
    first = next(iter(ended.values()))
    return counted, (
        f"Left out, also of shares: {len(ended)} runs that the guard of processor time ended, such "
        f"as {first.planner} on {first.problem} ({first.detail}). The same command runs them again."
    )


def states_hash(states: np.ndarray) -> str:
    """Return the sha256 of states (m, n): equal only for paths equal in every bit."""
    return hashlib.sha256(np.ascontiguousarray(states, dtype=np.float64).tobytes()).hexdigest()


def stored_paths(directory: Path) -> dict[str, np.ndarray]:
    """Return the states (m, n) [rad or m] in ``paths.npz`` by their hash; empty without the file.

    RunStoreError: the file is damaged, or the name of an array is not its hash.
    """
    path = Path(directory) / PATHS_FILE
    if not path.exists():
        return {}
    try:
        found = read_arrays(read_bytes(path))
    except (*DAMAGE_ERRORS, InvalidInputError) as error:
        raise RunStoreError(f"{path} is damaged: {error}; run again into another folder") from error
    for sha256, states in found.items():
        if states_hash(states) != sha256:
            raise RunStoreError(f"{path} is damaged: its path {sha256} has another hash")
    return found


def _intact_arrays(data: bytes) -> Iterator[np.ndarray]:
    """Yield arrays that `numpy.save` wrote one after another; drop an incomplete last one."""
    stream = io.BytesIO(data)
    while stream.tell() < len(data):
        try:
            yield np.load(stream, allow_pickle=False)
        except DAMAGE_ERRORS:
            return
