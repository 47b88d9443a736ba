"""Result rows and their CSV form.

A row is one run of one planner on one problem, or on one phase of a task, with one seed; failed
runs have rows, too. Undefined values are None in Python and empty in CSV, never 0 or -1.
"""

import csv
import io
import re
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from functools import cache
from itertools import repeat, zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.base.errors import (
    CvqmptError,
    InvalidInputError,
    RunStoreError,
    require_choice,
    shown,
)
from cvqmpt_lab.base.files import csv_table, read_text, write_text
from cvqmpt_lab.base.values import scalar

ROW_SCHEMA = "2"
RUNS_FILE = "runs.csv"
MEASURE_PREFIX = "measure:"  # start of the names of columns of one suite alone

# phases whose time the paper reports
PAPER_PHASES = ("reach-handle", "reach-can", "carry")


class FailReason(StrEnum):
    """Reason why a run has no certified path, or why its execution deviates from the plan.

    The first group has the values of `PlanStatus` and NO_START for problems that cannot be made.
    The second group is ``uncertified_`` and a value of `FaultKind`. `experiments.run` derives both
    from a solution. The last group is for tasks, executions and worker processes.
    """

    TIMEOUT = "timeout"
    ITERATION_LIMIT = "iteration_limit"
    COST_LIMIT = "cost_limit"
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
    NOT_EXECUTED = "not_executed"
    UNDECIDED = "undecided"
    WORKER_DIED = "worker_died"
    WORKER_HUNG = "worker_hung"
    OUT_OF_MEMORY = "out_of_memory"

    @property
    def shown(self) -> str:
        """The reason as people read it: a refused path is "not certified: collision"."""
        return self.replace("uncertified_", "not certified: ").replace("_", " ")


RowKey = tuple[str, str, str, int, str]  # suite, problem, planner, seed, backend


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """One run; the fields are the columns of ``runs.csv``, in this order.

    Names of times end in ``_s`` [s], names of lengths in ``_rad`` [rad, Euclidean in joint space]
    or ``_m`` [m]. Numbers of numpy are converted to Python numbers.

    Raises:
        InvalidInputError, UnknownChoiceError: a value of the wrong type or not finite; text that is
            empty, unprintable or starts like a formula; a negative number (except clearances);
            ``solved`` without ``certified``; a run that is solved and has a ``fail_reason``, or
            neither.
    """

    schema: str = ROW_SCHEMA
    suite: str
    problem: str  # name; ``TASK/NUMBER-PHASE`` for a phase of a task
    planner: str
    sampler_used: str | None = None
    seed: int
    backend: str
    solved: bool  # the planner returned a path, and the independent certificate accepted it
    fail_reason: FailReason | None = None
    detail: str | None = None  # explanation in one line
    fallback: str | None = None  # reason why another method than the named planner found the path
    certified: bool | None = None  # None: there was no path to certify
    t_total_s: float | None = None  # sum of the times below
    t_goals_s: float | None = None  # inverse kinematics of goals, measured for every planner
    t_encode_s: float | None = None
    t_predict_s: float | None = None
    t_optimize_s: float | None = None
    t_plan_s: float | None = None  # search without networks
    t_simplify_s: float | None = None
    n_projections: int | None = None
    n_newton_iterations: int | None = None
    n_state_checks: int | None = None
    n_iterations: int | None = None
    vertices: int | None = None
    path_length_raw_rad: float | None = None  # before simplification
    path_length_rad: float | None = None
    execution_time_s: float | None = None  # duration of the timed motion, for phases of tasks
    max_violation_rad: float | None = None
    max_violation_m: float | None = None
    min_clearance_m: float | None = None  # negative where bodies overlap
    path_sha256: str | None = None
    # Scanned scenes only: time from depth images to the map (not part of `t_total_s`), and to the
    # certificate; whether the path is free in the true scene, and its clearance there.
    t_sense_s: float | None = None
    t_whole_s: float | None = None
    true_free: bool | None = None
    true_clearance_m: float | None = None
    # Improved paths only: time used (part of `t_total_s`), number of searches, and the length of
    # the first path after shortcutting; `path_length_rad` is the length of the best path.
    t_improve_s: float | None = None
    n_restarts: int | None = None
    path_length_first_rad: float | None = None
    # Learned samplers only: parts of the sampler, see `vqmpt.sampler_choice`.
    predictor: str | None = None
    gaussians: str | None = None
    update: str | None = None
    cloud: str | None = None
    uniform_share: float | None = None
    sequences: str | None = None
    # mean of G = F(q)^T F(q) over fixed samples before projection [constraint's units, squared]
    g_sampled: float | None = None
    # Whether the scene's cloud was encoded in this run; then `t_encode_s` (part of `t_total_s`) is
    # the cost of a new scene, and `t_total_s - t_encode_s` is the time in a known scene.
    scene_new: bool | None = None
    # number of states whose clearance was read from a distance field (approximate checks)
    n_clearances: int | None = None
    # wall-clock time of `pipeline.solve`, without goals, clouds, `t_improve_s` and certificate
    t_wall_s: float | None = None
    # `min_clearance_m` is the smaller of these: to obstacles, and between pieces of the robot
    obstacle_clearance_m: float | None = None
    self_clearance_m: float | None = None
    # Learned samplers only, like `predictor`.
    reading: str | None = None
    draws: str | None = None
    goals: str | None = None
    reach: float | None = None  # [rad]; None: no limit
    std: float | None = None  # standard deviation of Gaussians along a sequence [rad]
    # Number of tree extensions that added nodes. OMPL stores only their last states; `vertices` of
    # our planners counts every state. None: no tree grew.
    n_extensions: int | None = None
    # Projections of samples before trees extend towards them: parts of `n_projections` and
    # `n_newton_iterations`. None: no sample was projected.
    n_draw_projections: int | None = None
    n_draw_newton_iterations: int | None = None
    # Number of starts and goals of all trees. `n_extensions + n_roots` is what OMPL's PlannerData
    # counts. None: no tree grew.
    n_roots: int | None = None
    n_goals_tried: int | None = None  # number of searches for one goal each, one after the other
    # length of the path after OMPL's own simplification, as the published code measures it
    path_length_ompl_rad: float | None = None
    # Learned samplers only, like `predictor`.
    host: str | None = None
    half: str | None = None
    chosen: str | None = None
    t_certify_s: float | None = None  # certificates before an improvement; not part of `t_total_s`
    # Numbers that only one suite measures, by name; None: undefined. In files they are the last
    # columns, with names ``measure:NAME``.
    measures: Mapping[str, float | None] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        for column in _columns():
            value = column.checked(getattr(self, column.name))
            object.__setattr__(self, column.name, value)
        checked = {
            name: _measure_column(name).checked(value) for name, value in self.measures.items()
        }
        object.__setattr__(self, "measures", checked)
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
                f"solved is {self.solved} but fail_reason is {self.fail_reason}; only failed runs "
                "must have a reason"
            )

    @property
    def key(self) -> RowKey:
        """Key of the row; a later row with the same key replaces the row."""
        return self.suite, self.problem, self.planner, self.seed, self.backend

    @property
    def run_key(self) -> RowKey:
        """Key of the run; the rows of all planned phases of a task have the same one."""
        return self.suite, self.item, self.planner, self.seed, self.backend

    @property
    def made(self) -> bool:
        """Whether there was a problem to plan; no planner had a part in it if there was none."""
        return self.fail_reason is not FailReason.NO_START

    @property
    def item(self) -> str:
        """Name of the run's problem or task."""
        return self.problem.partition("/")[0]


def ended_runs(rows: Iterable[ResultRow]) -> dict[RowKey, ResultRow]:
    """Return the runs that the guard of worker processes ended, by key: they have no result."""
    return {row.run_key: row for row in rows if row.fail_reason is FailReason.WORKER_HUNG}


def without_ended(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Return the rows of all runs except runs that the guard of worker processes ended."""
    ended = ended_runs(rows)
    return [row for row in rows if row.run_key not in ended]


class _Column(NamedTuple):
    """A column of ``runs.csv``."""

    name: str
    kind: Any  # str, int, float, bool or FailReason
    optional: bool  # empty where undefined

    def checked(self, value: Any) -> Any:
        """Return a value as its plain Python type; errors begin with the name of the column."""
        if value is None and self.optional:
            return None
        if self.kind is FailReason:
            return FailReason(require_choice(self.name, value, list(FailReason)))
        value = scalar(self.kind, value, self.name)
        if self.kind is str and not (value and value.isprintable() and not _is_formula(value)):
            raise InvalidInputError(
                f"{self.name} is {value!r}; it must be one non-empty line that does not begin like "
                "a formula"
            )
        if self.name == "schema" and value != ROW_SCHEMA:
            raise InvalidInputError(
                f"schema is {value!r}; this version reads and writes {ROW_SCHEMA!r}"
            )
        # a clearance is negative where bodies overlap
        if self.kind is float and value < 0.0 and not self.name.endswith("_clearance_m"):
            raise InvalidInputError(f"{self.name} is {value}; it cannot be negative")
        return value

    def read(self, text: str) -> Any:
        """Return the value of a cell; raise the errors of `checked`."""
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
        """Return the values of many cells; equal cells and plain numbers are read once."""
        known = {}
        if self.kind in (int, float):
            # such numbers are finite and not negative, so they need no check
            plain = re.compile(r"\d{1,9}" if self.kind is int else r"\d{1,9}\.\d+(e-\d+)?")
            known = {text: self.kind(text) for text in set(texts) if plain.fullmatch(text)}
        for text, place in zip(texts, places, strict=True):
            if text not in known:
                try:
                    known[text] = self.read(text)
                except CvqmptError as error:
                    raise RunStoreError(f"{place}: {error}") from None
        return [known[text] for text in texts]


@cache
def _columns() -> tuple[_Column, ...]:
    found = []
    for each in fields(ResultRow):
        if each.name != "measures":
            kind, *optional = typing.get_args(each.type) or (each.type,)
            found.append(_Column(each.name, kind, bool(optional)))
    return tuple(found)


def _measure_column(name: str) -> _Column:
    return _Column(MEASURE_PREFIX + name, float, optional=True)


ROW_COLUMNS = tuple(column.name for column in _columns())


def _is_formula(text: str) -> bool:
    """Return whether a spreadsheet would run a cell with this text."""
    return text.startswith(("=", "+", "-", "@"))


def cell_text(text: str) -> str | None:
    """Return text as one printable line for a cell, with ' before a formula; None if empty."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return f"'{line}" if _is_formula(line) else line or None


def csv_text(rows: Iterable[ResultRow]) -> str:
    """Return rows as CSV text with a header."""
    rows = list(rows)
    measures = dict.fromkeys(name for row in rows for name in row.measures)
    header = [*ROW_COLUMNS, *(MEASURE_PREFIX + name for name in measures)]
    lines = []
    for row in rows:
        cells = [getattr(row, column) for column in ROW_COLUMNS]
        cells += [row.measures.get(name) for name in measures]
        lines.append([str(x).lower() if isinstance(x, bool) else x for x in cells])
    return csv_table([header, *lines])


def natural_key(text: str) -> tuple[tuple[str | int, ...], str]:
    """Return a sort key by which ``p2`` precedes ``p10``."""
    parts = re.split(r"([0-9]+)", text)
    return tuple(int(part) if i % 2 else part for i, part in enumerate(parts)), text


def sorted_rows(rows: Iterable[ResultRow]) -> list[ResultRow]:
    """Return rows sorted by suite, problem (in natural order), planner, seed and backend."""
    rows = list(rows)
    places = {problem: natural_key(problem) for problem in {row.problem for row in rows}}
    return sorted(rows, key=lambda r: (r.suite, places[r.problem], r.planner, r.seed, r.backend))


def _parse_header(path: Path, fields: list[str]) -> tuple[int, list[str]]:
    """Return the number of columns of `ROW_COLUMNS` that a file has, and its measures."""
    measures = [name for name in fields if name.startswith(MEASURE_PREFIX)]
    fields = fields[: len(fields) - len(measures)]
    # older files have fewer columns, but at least those before this one
    known = ROW_COLUMNS[: max(ROW_COLUMNS.index("t_sense_s"), len(fields))]
    for index, (found, expected) in enumerate(
        zip_longest(fields, known, fillvalue="nothing"), start=1
    ):
        if found != expected:
            raise RunStoreError(
                f"{path}, line 1, column {index}: expected {expected}, found "
                f"{shown(found)[1:-1]}; the file is not a table of runs of this version (schema "
                f"{ROW_SCHEMA}), use another --out"
            )
    return len(known), [name.removeprefix(MEASURE_PREFIX) for name in measures]


def parse_rows(path: Path, text: str) -> list[ResultRow]:
    """Return rows of CSV text without its empty lines; errors as in `read_rows`."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        count, measures = _parse_header(path, next(reader, []))
        lines = [(reader.line_num, cells) for cells in reader if cells]
    except csv.Error as error:
        raise RunStoreError(f"{path}, line {reader.line_num}: {error}") from error
    columns = [*_columns()[:count], *map(_measure_column, measures)]
    for line, cells in lines:
        if len(cells) != len(columns):
            raise RunStoreError(
                f"{path}, line {line}: {len(cells)} fields, expected {len(columns)}"
            )
    file = str(path)
    places = [f"{file}, line {line}" for line, _ in lines]
    by_column = zip(*(cells for _, cells in lines), strict=True)
    values = [
        column.read_all(texts, places) for column, texts in zip(columns, by_column, strict=False)
    ]
    missing = [[None] * len(lines)] * (len(ROW_COLUMNS) - count)
    of_rows = zip(*values[:count], *missing, strict=True)
    own_of_rows = zip(*values[count:], strict=True) if measures else repeat(())
    rows = []
    for place, read, own in zip(places, of_rows, own_of_rows, strict=False):
        row = _row_of_checked(read, dict(zip(measures, own, strict=True)))
        try:
            row.require_consistent()
        except InvalidInputError as error:
            raise RunStoreError(f"{place}: {error}") from None
        rows.append(row)
    places_by_key: dict[RowKey, str] = {}
    for place, row in zip(places, rows, strict=True):
        if places_by_key.setdefault(row.key, place) != place:
            first = places_by_key[row.key].rpartition(", ")[2]
            raise RunStoreError(
                f"{place}: problem {row.problem}, planner {row.planner}, seed {row.seed} is in "
                f"{first}, too; delete one of the two rows"
            )
    return rows


def _row_of_checked(values: Sequence[Any], measures: Mapping[str, float | None]) -> ResultRow:
    """Return a row with values that `_Column.read_all` has checked, in the order of columns.

    `__post_init__` is not called: a second check would triple the time of reading.
    """
    row = object.__new__(ResultRow)
    vars(row).update(zip(ROW_COLUMNS, values, strict=True), measures=measures)
    return row


def read_rows(path: Path) -> list[ResultRow]:
    """Read a CSV file of runs; floats are read exactly as they were written.

    Raises:
        InvalidInputError: the file cannot be read.
        RunStoreError: wrong content; the message names file, line and column.
    """
    text = read_text(path)
    rows = parse_rows(Path(path), text)
    if not text.endswith(("\n", "\r")):  # a cut number is still a number, but another one
        raise RunStoreError(
            f"{path}, line {len(text.splitlines())}: the file ends within this line, so it may be "
            "cut; copy it again, or end a complete line with a line break"
        )
    return rows


def write_rows(path: Path, rows: Iterable[ResultRow]) -> None:
    """Write rows in the order of `sorted_rows`; the file is replaced completely or not at all."""
    write_text(path, csv_text(sorted_rows(rows)))


class PhaseName(NamedTuple):
    """Name of a planned phase of a task: in rows ``TASK/NUMBER-PHASE``, e.g. ``3/5-carry``."""

    task: str
    number: int  # number of the phase among planned phases, from 1
    phase: str


def phase_problem(task: str, number: int, phase: str) -> str:
    """Return the name of a phase in the column `problem`."""
    return f"{task}/{number}-{phase}"


def split_problem(problem: str) -> PhaseName:
    """Return the parts of a phase's name in rows; InvalidInputError for another problem."""
    task, slash, rest = problem.rpartition("/")
    number, dash, phase = rest.partition("-")
    if not (slash and dash and number.isdecimal()):
        raise InvalidInputError(f"problem {problem!r} is not a phase of a task such as 3/5-carry")
    return PhaseName(task, int(number), phase)
