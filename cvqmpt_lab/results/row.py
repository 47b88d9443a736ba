"""Result rows and their csv form.

One row is one run of one planner on one problem, or on one phase of a task, with one seed; failed
runs have rows too. Undefined values are None in Python and empty in csv, never 0 or -1.
"""

import csv
import io
import re
import typing
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    RunStoreError,
    UnknownChoiceError,
    shown,
)
from cvqmpt_lab.base.files import csv_table, read_text, write_text
from cvqmpt_lab.base.values import scalar

SCHEMA = "2"
RUNS_FILE = "runs.csv"
BY_ROLLOUTS = "solved by rollouts"  # begins `detail` of planners that join states of a rollout
ROLLOUTS_ALONE = f"{BY_ROLLOUTS} alone"  # no tree was grown between them
# state checks that reading a clearance costs, see docs/performance.md
CLEARANCE_COST = 1 / 3
FORMULA = ("=", "+", "-", "@")  # how a cell begins that a spreadsheet would run

# the paper times these, as far as can be inferred
PAPER_PHASES = ("reach-handle", "reach-can", "carry")


class FailReason(StrEnum):
    """Why a run has no certified path."""

    TIMEOUT = "timeout"
    ITERATION_LIMIT = "iteration_limit"
    NO_START = "no_start"
    NO_GOAL = "no_goal"
    INVALID_START = "invalid_start"
    INVALID_GOAL = "invalid_goal"
    PLANNER_ERROR = "planner_error"
    MALFORMED_PATH = "malformed_path"
    OVERTIME = "overtime"
    NO_PATH = "no_path"
    UNCERTIFIED_SHAPE = "uncertified_shape"
    UNCERTIFIED_START = "uncertified_start"
    UNCERTIFIED_GOAL = "uncertified_goal"
    UNCERTIFIED_STEP = "uncertified_step"
    UNCERTIFIED_LIMITS = "uncertified_limits"
    UNCERTIFIED_MANIFOLD = "uncertified_manifold"
    UNCERTIFIED_COLLISION = "uncertified_collision"
    UNCERTIFIED_NOT_PROVEN = "uncertified_not_proven"
    NOT_TIMED = "not_timed"
    NOT_REACHED = "not_reached"
    WORKER_DIED = "worker_died"
    WORKER_HUNG = "worker_hung"
    OUT_OF_MEMORY = "out_of_memory"


RowKey = tuple[str, str, str, int, str]  # suite, problem, planner, seed, backend


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """One run; the fields are the columns of ``runs.csv``, in this order.

    Times end in ``_s`` [s], lengths in ``_rad`` [rad, Euclidean in joint space] or ``_m`` [m].
    numbers of numpy are converted to plain Python ones.

    InvalidInputError or UnknownChoiceError for a value of the wrong type or not finite, text that
    is empty, unprintable or like a formula, a negative number (other than a clearance), ``solved``
    without ``certified``, or a run that neither is solved nor has a ``fail_reason``, or both.
    """

    schema: str = SCHEMA
    suite: str
    problem: str  # its name; ``TASK/NUMBER-PHASE`` for a phase of a task
    planner: str
    sampler_used: str | None = None
    seed: int
    backend: str
    # certified: the planner claimed a path and the independent certificate accepted it
    solved: bool
    fail_reason: FailReason | None = None
    detail: str | None = None  # one line more, for people
    fallback: str | None = None  # why the path did not come the way the planner's name promises
    certified: bool | None = None  # None when there was no path to certify
    t_total_s: float | None = None  # sum of the times below
    t_goals_s: float | None = None  # goal inverse kinematics, charged to every planner alike
    t_encode_s: float | None = None
    t_predict_s: float | None = None
    t_optimize_s: float | None = None
    t_plan_s: float | None = None  # search alone, without networks
    t_simplify_s: float | None = None
    n_projections: int | None = None
    n_newton_iterations: int | None = None
    n_state_checks: int | None = None
    n_iterations: int | None = None
    vertices: int | None = None
    path_length_raw_rad: float | None = None  # before simplification
    path_length_rad: float | None = None
    execution_time_s: float | None = None  # duration of the timed motion, of phases of tasks
    max_violation_rad: float | None = None
    max_violation_m: float | None = None
    min_clearance_m: float | None = None  # negative where bodies overlap
    path_sha256: str | None = None
    # Of scanned scenes: time from depth images to the map (not in `t_total_s`), and to the
    # certificate; whether the path is free in the real scene, and its clearance there.
    t_sense_s: float | None = None
    t_whole_s: float | None = None
    true_free: bool | None = None
    true_clearance_m: float | None = None
    # Of improved paths: time used (in `t_total_s`), searches begun, and the length of the first
    # path, shortened; `path_length_rad` is the best path's.
    t_improve_s: float | None = None
    n_restarts: int | None = None
    path_length_first_rad: float | None = None
    # Of learned samplers: the product, see `vqmpt.sampler_choice`.
    predictor: str | None = None
    gaussians: str | None = None
    update: str | None = None
    cloud: str | None = None
    uniform_share: float | None = None
    sequences: str | None = None
    # G = F(q)^T F(q), mean over fixed draws before projection [the constraint's units, squared].
    g_sampled: float | None = None
    # Whether the scene's cloud was encoded in this run: then `t_encode_s`, a part of `t_total_s`,
    # is the cost of a new scene, and `t_total_s - t_encode_s` the time in a known one.
    scene_new: bool | None = None
    # States whose clearance was read from a distance field: approximate checks.
    n_clearances: int | None = None
    # Wall clock of `pipeline.solve` without goals, clouds, `t_improve_s` and certificate.
    t_wall_s: float | None = None
    # The two parts of `min_clearance_m`: from obstacles, and of the robot's own pieces.
    obstacle_clearance_m: float | None = None
    self_clearance_m: float | None = None
    # Of learned samplers, like `predictor`.
    reading: str | None = None
    draws: str | None = None
    goals: str | None = None
    reach: float | None = None  # [rad] empty: no limit
    std: float | None = None  # [rad] of Gaussians along a sequence
    # Ends of extensions in trees, roots left out: OMPL stores these alone, we (`vertices`) every
    # state of an extension. Empty where no tree grew.
    n_extensions: int | None = None
    # Of draws that were projected before trees extended towards them: parts of `n_projections` and
    # `n_newton_iterations`. Empty where none was.
    n_draw_projections: int | None = None
    n_draw_newton_iterations: int | None = None

    def __post_init__(self) -> None:
        for column in _COLUMNS:
            value = column.checked(getattr(self, column.name))
            object.__setattr__(self, column.name, value)
        self.require_consistent()

    def require_consistent(self) -> None:
        """Refuse a solved run without a certificate, and a failure without a reason."""
        if self.solved and not self.certified:
            raise InvalidInputError(
                f"solved is True but certified is {self.certified}; a path without a certificate "
                "is a failure"
            )
        if self.solved is not (self.fail_reason is None):
            raise InvalidInputError(
                f"solved is {self.solved} but fail_reason is {self.fail_reason}; give one to "
                "failures only"
            )

    @property
    def key(self) -> RowKey:
        """Key of the row; a later row with an equal key replaces it."""
        return self.suite, self.problem, self.planner, self.seed, self.backend

    @property
    def run_key(self) -> RowKey:
        """Key of the run; a task's run has a row for each planned phase."""
        return self.suite, self.item, self.planner, self.seed, self.backend

    @property
    def item(self) -> str:
        """The run's problem or whole task."""
        return self.problem.partition("/")[0]


class _Column(NamedTuple):
    """A column of ``runs.csv``."""

    name: str
    kind: Any  # str, int, float, bool or FailReason
    optional: bool  # empty where undefined

    def checked(self, value: Any) -> Any:
        """A value as its plain Python type; the message of an error begins with the column."""
        if value is None and self.optional:
            return None
        if self.kind is FailReason:
            if value not in list(FailReason):
                raise UnknownChoiceError(self.name, value, FailReason)
            return FailReason(value)
        value = scalar(self.kind, value, self.name)
        if self.kind is str and not (value and value.isprintable() and value[0] not in FORMULA):
            raise InvalidInputError(
                f"{self.name} is {value!r}; it must be one non-empty line that does not begin like "
                "a formula"
            )
        if self.name == "schema" and value != SCHEMA:
            raise InvalidInputError(
                f"schema is {value!r}; this version reads and writes {SCHEMA!r}"
            )
        # a clearance is negative where bodies overlap
        if self.kind is float and value < 0.0 and not self.name.endswith("_clearance_m"):
            raise InvalidInputError(f"{self.name} is {value}; it cannot be negative")
        return value

    def read(self, text: str) -> Any:
        """The value of a cell; an error as of `checked`."""
        try:
            if text == "" and self.optional:
                return None
            if self.kind is bool:
                return ("false", "true").index(text) == 1
            if self.kind in (int, float):
                return self.checked(self.kind(text))
        except ValueError:
            pass
        return self.checked(text)

    def read_all(self, texts: Sequence[str], places: Sequence[str]) -> list[Any]:
        """The values of cells; plain numbers cost no call of Python each: cells are many."""
        plain = PLAIN.get(self.kind)
        known = {text: self.kind(text) for text in set(texts) if plain and plain.fullmatch(text)}
        for text, place in zip(texts, places, strict=True):
            if text not in known:
                try:
                    known[text] = self.read(text)
                except CvqmptError as error:
                    raise RunStoreError(f"{place}: {error}") from None
        return [known[text] for text in texts]


def _columns() -> tuple[_Column, ...]:
    found = []
    for field in fields(ResultRow):
        kind, *optional = typing.get_args(field.type) or (field.type,)
        found.append(_Column(field.name, kind, bool(optional)))
    return tuple(found)


# numbers that need no check: finite and not negative
PLAIN = {int: re.compile(r"\d{1,9}"), float: re.compile(r"\d{1,9}\.\d+(e-\d+)?")}
_COLUMNS = _columns()
COLUMNS = tuple(column.name for column in _COLUMNS)


def one_line(text: str) -> str | None:
    """Text for a cell: one printable line, quoted if it starts like a formula; None if empty."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return f"'{line}" if line.startswith(FORMULA) else line or None


def csv_text(rows: Iterable[ResultRow], header: bool = True) -> str:
    """Rows as csv."""
    cells = ([getattr(row, column) for column in COLUMNS] for row in rows)
    lines = [[str(x).lower() if isinstance(x, bool) else x for x in row] for row in cells]
    return csv_table([COLUMNS, *lines] if header else lines)


def natural_key(text: str) -> tuple[tuple[str | int, ...], str]:
    """Sort key in which ``p2`` precedes ``p10``."""
    parts = re.split(r"([0-9]+)", text)
    return tuple(int(part) if i % 2 else part for i, part in enumerate(parts)), text


def sorted_rows(rows: Iterable[ResultRow]) -> list[ResultRow]:
    """Rows by suite, problem (numbers as numbers), planner, seed and backend."""
    rows = list(rows)
    places = {problem: natural_key(problem) for problem in {row.problem for row in rows}}
    return sorted(rows, key=lambda r: (r.suite, places[r.problem], r.planner, r.seed, r.backend))


def _parse_header(path: Path, fields: list[str]) -> int:
    """Number of the columns that a file has."""
    # older files lack the columns from this one on, or from a later one
    known = COLUMNS[: max(COLUMNS.index("t_sense_s"), len(fields))]
    for index, (found, expected) in enumerate(
        zip_longest(fields, known, fillvalue="nothing"), start=1
    ):
        if found != expected:
            raise RunStoreError(
                f"{path}, line 1, column {index}: expected {expected}, found "
                f"{shown(found)[1:-1]}; the file is not a table of runs of this version (schema "
                f"{SCHEMA}), use another --out"
            )
    return len(known)


def parse_rows(path: Path, text: str, header: bool = True) -> list[ResultRow]:
    """Rows of the text of a csv; empty lines are skipped. Raises as `read_rows`, naming `path`."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        columns = _parse_header(path, next(reader, [])) if header else len(COLUMNS)
        lines = [(reader.line_num, cells) for cells in reader if cells]
    except csv.Error as error:
        raise RunStoreError(f"{path}, line {reader.line_num}: {error}") from error
    for line, cells in lines:
        if len(cells) != columns:
            raise RunStoreError(f"{path}, line {line}: {len(cells)} fields, expected {columns}")
    file = str(path)
    places = [f"{file}, line {line}" for line, _ in lines]
    by_column = zip(*(cells for _, cells in lines), strict=True)
    values = [
        column.read_all(texts, places) for column, texts in zip(_COLUMNS, by_column, strict=False)
    ]
    missing = [[None] * len(lines)] * (len(COLUMNS) - len(values))
    rows = []
    for place, read in zip(places, zip(*values, *missing, strict=True), strict=True):
        row = object.__new__(ResultRow)  # each of its values is checked
        vars(row).update(zip(COLUMNS, read, strict=True))
        try:
            row.require_consistent()
        except InvalidInputError as error:
            raise RunStoreError(f"{place}: {error}") from None
        rows.append(row)
    return rows


def search_work(projections: int, state_checks: int, clearances: int | None) -> float:
    """Work of a search: `projections + state checks + CLEARANCE_COST * clearances`.

    clearances: None in rows that are older than their count, or of planners that read none.
    """
    return projections + state_checks + CLEARANCE_COST * (clearances or 0)


def read_rows(path: Path) -> list[ResultRow]:
    """Read a csv of runs; floats come back exactly as they were.

    InvalidInputError: the file cannot be read. RunStoreError: names file, line and column.
    """
    return parse_rows(Path(path), read_text(path))


def write_rows(path: Path, rows: Iterable[ResultRow]) -> None:
    """Write rows in the order of `sorted_rows`, replacing the file at once or not at all."""
    write_text(path, csv_text(sorted_rows(rows)))


class PhaseName(NamedTuple):
    """A planned phase of a task, named ``TASK/NUMBER-PHASE`` in rows, such as ``3/5-carry``."""

    task: str
    number: int  # among the planned ones, from 1
    phase: str


def phase_problem(task: str, number: int, phase: str) -> str:
    """Name of a phase's problem in rows."""
    return f"{task}/{number}-{phase}"


def split_problem(problem: str) -> PhaseName:
    """Inverse of `phase_problem`; InvalidInputError for rows of another kind."""
    task, slash, rest = problem.rpartition("/")
    number, dash, phase = rest.partition("-")
    if not (slash and dash and number.isdecimal()):
        raise InvalidInputError(f"problem {problem!r} is no phase of a task, such as 3/5-carry")
    return PhaseName(task, int(number), phase)
