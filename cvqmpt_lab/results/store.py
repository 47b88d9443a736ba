"""Result rows, their csv form, and a store of runs that survives interruption and can be continued.

One row is one run of one planner on one problem with one seed. Undefined values are None in Python
and empty in csv, never 0 or -1. A failed run is a row like any other.
"""

import contextlib
import csv
import dataclasses
import errno
import fcntl
import io
import math
import os
import re
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvqmpt_lab.errors import InvalidInputError, RunStoreError
from cvqmpt_lab.results.provenance import SCHEMA, ProvenanceFile, write_text_atomic

RUNS_FILE = "runs.csv"
PARTIAL_FILE = "runs.partial.csv"


class RunKey(typing.NamedTuple):
    """What identifies a run: a second row with the same key replaces the first."""

    suite: str
    problem: str
    planner: str
    seed: int
    backend: str


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """One run; the fields are the columns of ``runs.csv``, in this order.

    Times end in ``_s`` [s], lengths in ``_rad`` [rad, Euclidean in joint space] or ``_m`` [m].
    ``solved`` means certified success: the planner claimed a path and the independent certificate
    accepted it. ``certified`` is None when there was no path to certify. ``t_goals_s`` is goal inverse
    kinematics and is charged to every planner. ``t_plan_s`` is search alone; what networks took stands in
    ``t_encode_s``, ``t_predict_s`` and ``t_optimize_s``, and ``t_total_s`` is the sum of all these and
    ``t_simplify_s``. ``t_observe_s`` is not part of it: clouds are a camera's work. numpy scalars
    are converted to plain Python values.

    Raises
    ------
    InvalidInputError
        For a value of the wrong type, NaN, an empty or unprintable string, a negative number (other
        than ``min_clearance_m``, where it means penetration), or ``solved`` without ``certified``.
    """

    schema: str = SCHEMA
    suite: str
    problem: str
    planner: str
    sampler_used: str | None = None
    seed: int
    backend: str
    status: str
    fail_reason: str | None = None
    solved: bool
    certified: bool | None = None
    t_total_s: float | None = None
    t_observe_s: float | None = None
    t_goals_s: float | None = None
    t_encode_s: float | None = None
    t_predict_s: float | None = None
    t_optimize_s: float | None = None
    t_plan_s: float | None = None
    t_simplify_s: float | None = None
    n_projections: int | None = None
    n_newton_iterations: int | None = None
    n_state_checks: int | None = None
    n_iterations: int | None = None
    vertices: int | None = None
    path_length_raw_rad: float | None = None
    path_length_rad: float | None = None
    execution_time_s: float | None = None
    max_violation_rad: float | None = None
    max_violation_m: float | None = None
    min_clearance_m: float | None = None
    path_sha256: str | None = None

    def __post_init__(self) -> None:
        for column in _COLUMN_TYPES:
            object.__setattr__(self, column, _checked(column, getattr(self, column)))
        if self.solved and not self.certified:
            raise InvalidInputError(
                f"solved is True but certified is {self.certified}; a path without a certificate is a failure"
            )

    @property
    def key(self) -> RunKey:
        """The run this row belongs to."""
        return RunKey(self.suite, self.problem, self.planner, self.seed, self.backend)


def _column_types() -> dict[str, tuple[type, bool]]:
    """Map each column to its Python type and whether it may be undefined."""
    kinds: dict[str, tuple[type, bool]] = {}
    hints = typing.get_type_hints(ResultRow)
    for field in dataclasses.fields(ResultRow):
        hint = hints[field.name]
        optional = isinstance(hint, types.UnionType)
        kinds[field.name] = (typing.get_args(hint)[0] if optional else hint, optional)
    return kinds


_COLUMN_TYPES = _column_types()
COLUMNS: tuple[str, ...] = tuple(_COLUMN_TYPES)
_ACCEPTED: dict[type, tuple[type, ...]] = {
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (int, float, np.integer, np.floating),
    str: (str,),
}


def _checked(column: str, value: object) -> object:
    """Return `value` as the plain Python type of `column`; raise InvalidInputError when it is not one."""
    kind, optional = _COLUMN_TYPES[column]
    if value is None and optional:
        return None
    stray_bool = isinstance(value, bool | np.bool_) and kind is not bool
    if stray_bool or not isinstance(value, _ACCEPTED[kind]):
        suffix = " or None" if optional else ""
        raise InvalidInputError(f"{column} is {value!r}; it must be {kind.__name__}{suffix}")
    plain = kind(value)
    if kind is str and not (plain and plain.isprintable()):
        raise InvalidInputError(f"{column} is {plain!r}; it must be one non-empty line of text")
    if kind in (int, float) and (math.isnan(plain) or (plain < 0 and column != "min_clearance_m")):
        raise InvalidInputError(f"{column} is {plain}; it cannot be negative or NaN (undefined is None)")
    if column == "schema" and plain != SCHEMA:
        raise InvalidInputError(f"schema is {plain!r}; this version reads and writes {SCHEMA!r}")
    return plain


def _to_text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def _from_text(column: str, text: str) -> object:
    kind, optional = _COLUMN_TYPES[column]
    if text == "" and optional:
        return None
    if kind is bool:
        return _checked(column, {"true": True, "false": False}.get(text, text))
    try:
        return _checked(column, kind(text))
    except ValueError:
        return _checked(column, text)  # raises, naming the text and the type


def _csv_text(rows: Iterable[ResultRow], header: bool = True) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    if header:
        writer.writerow(COLUMNS)
    writer.writerows([_to_text(getattr(row, column)) for column in COLUMNS] for row in rows)
    return buffer.getvalue()


def natural_key(text: str) -> tuple[tuple[str | int, ...], str]:
    """Sort key in which ``p2`` precedes ``p10``."""
    parts = re.split(r"([0-9]+)", text)
    return tuple(int(part) if i % 2 else part for i, part in enumerate(parts)), text


def sorted_rows(rows: Iterable[ResultRow]) -> list[ResultRow]:
    """Rows in the one deterministic order: suite, problem (numbers as numbers), planner, seed, backend."""
    return sorted(rows, key=lambda r: (r.suite, natural_key(r.problem), r.planner, r.seed, r.backend))


def _parse_row(where: str, fields: list[str]) -> ResultRow:
    if len(fields) != len(COLUMNS):
        column = COLUMNS[len(fields)] if len(fields) < len(COLUMNS) else f"number {len(COLUMNS) + 1}"
        raise RunStoreError(f"{where}, column {column}: {len(fields)} fields, expected {len(COLUMNS)}")
    values: dict[str, typing.Any] = {}
    for column, text in zip(COLUMNS, fields, strict=True):
        try:
            values[column] = _from_text(column, text)
        except InvalidInputError as error:
            raise RunStoreError(f"{where}, column {column}: {error}") from None
    try:
        return ResultRow(**values)
    except InvalidInputError as error:
        raise RunStoreError(f"{where}, column solved: {error}") from None


def _parse_header(path: Path, fields: list[str]) -> None:
    for index in range(max(len(fields), len(COLUMNS))):
        found = fields[index] if index < len(fields) else "nothing"
        expected = COLUMNS[index] if index < len(COLUMNS) else "nothing"
        if found != expected:
            raise RunStoreError(
                f"{path}, line 1, column {index + 1}: expected {expected}, found {found}; "
                f"the file is not a table of runs of this version (schema {SCHEMA}), use another --out"
            )


def _parse_text(path: Path, text: str, header: bool = True) -> list[ResultRow]:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        if header:
            _parse_header(path, next(reader, []))
        return [_parse_row(f"{path}, line {reader.line_num}", fields) for fields in reader]
    except csv.Error as error:
        raise RunStoreError(f"{path}, line {reader.line_num}, column unknown: {error}") from error


def _read_text(path: Path, whole_lines: bool = False) -> str:
    """Read UTF-8 text; without the end of a last line that was cut short if `whole_lines`."""
    try:
        data = path.read_bytes()
        return (data[: data.rfind(b"\n") + 1] if whole_lines else data).decode("utf-8")
    except UnicodeDecodeError as error:
        raise RunStoreError(f"{path}: not UTF-8 text (byte {error.start})") from error
    except OSError as error:
        raise RunStoreError(f"cannot read {path}: {error.strerror}") from error


def read_rows(path: Path) -> list[ResultRow]:
    """Read a csv of runs; floats come back exactly as they were.

    Raises
    ------
    RunStoreError
        When the file cannot be read, or naming the file, line and column that are wrong.
    """
    return _parse_text(Path(path), _read_text(Path(path)))


def write_rows(path: Path, rows: Iterable[ResultRow]) -> None:
    """Write rows in the order of `sorted_rows`, replacing the file at once or not at all."""
    write_text_atomic(Path(path), _csv_text(sorted_rows(rows)))


class RunStore:
    """A directory with ``runs.csv`` and ``provenance.json`` that grows one run at a time.

    One process appends (its workers hand it their rows). Each row is on disk, in ``runs.partial.csv``,
    before `append` returns; `finish`, or leaving the ``with`` block for any reason, merges it into
    ``runs.csv``. After a kill the next `open` merges what was left and ignores a truncated last line.
    """

    def __init__(self, directory: Path, lock: int, later_session: Mapping[str, object] | None) -> None:
        """Use `RunStore.open`."""
        self.directory = directory
        self._lock: int | None = lock
        self._later_session = later_session  # provenance of a continuation, written with its first row
        self._partial: io.FileIO | None = None
        self._rows: dict[RunKey, ResultRow] = {}

    @classmethod
    def open(
        cls,
        directory: Path,
        configuration: Mapping[str, object],
        provenance: Mapping[str, object] | None = None,
    ) -> "RunStore":
        """Create a store, or continue one that was made with an equal configuration.

        Parameters
        ----------
        directory
            The results directory; made when missing.
        configuration
            Every setting that must not change within one table (suite, cutoff, ...), as json values.
        provenance
            What `cvqmpt_lab.results.provenance.provenance` returns. A continued store keeps the
            first one and lists later ones, once they add a row, under ``continued``.

        Raises
        ------
        RunStoreError
            When the directory cannot be written, is in use, was made with another configuration (the
            message names the setting), or holds runs without provenance or with foreign columns.
        """
        directory = Path(directory)
        try:
            directory.mkdir(parents=True, exist_ok=True)
            lock = _lock(directory)
        except OSError as error:
            raise RunStoreError(f"cannot use {directory}: {error.strerror}; use another --out") from error
        try:
            if not os.access(directory, os.W_OK):
                raise RunStoreError(f"{directory} is read-only; choose a writable --out")
            record = ProvenanceFile(directory)
            names = (record.path.name, RUNS_FILE, PARTIAL_FILE)
            is_new = not any((directory / name).exists() for name in names)
            if is_new:
                record.create(configuration, provenance or {})
            else:
                record.require_equal(configuration)
            store = cls(directory, lock, None if is_new else provenance)
            store._recover()
        except BaseException:
            _unlock(lock)
            raise
        return store

    def _recover(self) -> None:
        """Load the merged rows and what an interrupted run left behind, and merge the latter."""
        merged, partial = self.directory / RUNS_FILE, self.directory / PARTIAL_FILE
        if merged.is_file():
            self._rows = {row.key: row for row in read_rows(merged)}
        if partial.is_file():
            left = _parse_text(partial, _read_text(partial, whole_lines=True), header=False)
            self._rows |= {row.key: row for row in left}
            self._merge()

    def _merge(self) -> None:
        write_rows(self.directory / RUNS_FILE, self._rows.values())
        (self.directory / PARTIAL_FILE).unlink(missing_ok=True)

    def rows(self) -> list[ResultRow]:
        """All rows so far, in the order of `sorted_rows`."""
        return sorted_rows(self._rows.values())

    def done_keys(self) -> frozenset[RunKey]:
        """Keys of the runs that need not be run again."""
        return frozenset(self._rows)

    def append(self, row: ResultRow) -> None:
        """Add one row and force it to disk; a row with a known key replaces the earlier one.

        Raises
        ------
        RunStoreError
            When the store is finished or the disk refuses the row.
        """
        if self._lock is None:
            raise RunStoreError(f"the store {self.directory} is finished; open it again to append")
        if self._later_session is not None:
            ProvenanceFile(self.directory).add_continuation(self._later_session)
            self._later_session = None
        self._rows[row.key] = row
        try:
            self._append_line(_csv_text([row], header=False).encode("utf-8"))
        except OSError as error:
            raise RunStoreError(f"cannot append to {self.directory}: {error.strerror}") from error

    def _append_line(self, line: bytes) -> None:
        """Put one whole line on disk or, when the disk is full, none of it."""
        if self._partial is None:
            self._partial = io.FileIO(self.directory / PARTIAL_FILE, "a")
        size = os.fstat(self._partial.fileno()).st_size
        if self._partial.write(line) != len(line):
            self._partial.truncate(size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(self._partial.fileno())

    def finish(self) -> None:
        """Merge everything into ``runs.csv``, remove the partial file and release the directory."""
        if self._lock is None:
            return
        lock, self._lock = self._lock, None
        try:
            if self._partial is not None:
                self._partial.close()
            self._merge()
        finally:
            _unlock(lock)

    def __enter__(self) -> "RunStore":
        return self

    def __exit__(self, *exception: object) -> None:
        self.finish()


def _lock(directory: Path) -> int:
    """Take the directory's advisory lock, so that two runs never write one store; return its handle."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise RunStoreError(f"{directory} is in use by another run; wait or use another --out") from None
    except OSError:
        pass  # a file system without locks: go on without one
    return handle


def _unlock(handle: int) -> None:
    with contextlib.suppress(OSError):
        fcntl.flock(handle, fcntl.LOCK_UN)  # explicit: forked workers may still hold the handle
    os.close(handle)
