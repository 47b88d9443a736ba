"""Render the runs of a results directory in the paper's layout: markdown, LaTeX and csv.

Plans nothing.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.files import write_text
from cvqmpt_lab.results.provenance import ProvenanceFile, digests_in, sessions
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, read_rows
from cvqmpt_lab.results.store import PARTIAL_FILE
from paper_tables.constraints_table import arms_table, constraints_table
from paper_tables.factorial_table import factorial_table
from paper_tables.multi_sequence_table import multi_sequence_table
from paper_tables.paper_numbers import read_published
from paper_tables.peers_table import peers_table
from paper_tables.place_task_table import place_task_table
from paper_tables.table_engine import Rendered, rows_of_one_suite


class SuiteTable(NamedTuple):
    """How the rows of a suite are rendered."""

    title: str
    render: Callable[..., Rendered] = place_task_table
    # file in ``published`` and environment there of its numbers
    paper: tuple[str, str] | None = None


PLACE = ("place_task.csv", "Place Task")
TABLES: Mapping[str, SuiteTable] = {  # by suite; others are rendered as problems of that name
    "place-task": SuiteTable("Place task: carry a can upright to the shelf", paper=PLACE),
    "place-task-with-can": SuiteTable("Place task, the carried can in the way", paper=PLACE),
    "place-task-mirrored": SuiteTable("Place task in a kitchen that no tuning has seen"),
    "place-task-single-goal": SuiteTable("Place task, a single goal instead of twenty"),
    "family-cubes-spheres": SuiteTable("Held-out scenes of cubes and balls, hand upright"),
    "family-kitchen-like": SuiteTable("Held-out scenes like kitchens, hand upright"),
    "family-shelves": SuiteTable("Held-out scenes with shelves, hand upright"),
    "family-table": SuiteTable("Held-out scenes with a table, hand upright"),
    "family-cluttered-table": SuiteTable("Held-out tables crowded with slim things, hand upright"),
    "family-narrow-shelves": SuiteTable(
        "Held-out shelves that a hand just fits into, hand upright"
    ),
    "family-cage": SuiteTable("Held-out cages of bars, hand upright"),
    "robots": SuiteTable("Nine arms of seven makers in held-out scenes, hand upright", arms_table),
    "sensor": SuiteTable(
        "Scanned scenes, hand upright: planned in the map, judged in truth",
        partial(place_task_table, sensed=True),
        ("place_task.csv", "Physical robot"),
    ),
    "constraints": SuiteTable(
        "Eight kinds of constraints, zero-shot, in held-out scenes", constraints_table
    ),
    "factorial": SuiteTable(
        "Factorial: predictor x Gaussians x update, place task", factorial_table
    ),
    "factorial-constraints": SuiteTable(
        "Factorial: predictor x Gaussians x update, eight kinds of constraints", factorial_table
    ),
    "peers": SuiteTable("Planners of others, place task with a single goal", peers_table),
    "open-door": SuiteTable("Open the shelf's door, the hand on its handle"),
    "multi-sequence": SuiteTable(
        "Multi-sequence task: open the shelf, take the can, stand it on the counter",
        multi_sequence_table,
        ("multi_sequence.csv", "Multi-sequence task"),
    ),
}


def table_of(suite: str) -> SuiteTable:
    """How the rows of a suite are rendered."""
    return TABLES.get(suite, SuiteTable(f"Suite {suite}"))


class RenderedFiles(NamedTuple):
    """What was written beside the rows, and the lines that a terminal shows."""

    paths: list[Path]
    brief: list[str]


def render_directory(directory: Path) -> RenderedFiles:
    """Write ``table.md``, ``.tex`` and ``.csv`` beside ``runs.csv``, whose rows are of one suite.

    InvalidInputError when the directory holds no readable runs with provenance, or cannot be
    written.
    """
    rows = rows_of_one_suite(directory_rows(directory))
    record = ProvenanceFile(directory).read()
    table = table_of(rows[0].suite)
    paper = read_published(*table.paper) if table.paper else ()
    made, head = table.render(rows, paper), _head(record, len(rows))
    texts = {
        "table.md": f"# {table.title}\n\n{head}\n\n{made.markdown}",
        "table.tex": f"% {head}\n{made.latex}",
        "table.csv": made.csv,
    }
    for name, text in texts.items():
        write_text(directory / name, text)
    title = f"{table.title}: {made.size}, {_cutoffs(record)}"
    return RenderedFiles([directory / name for name in texts], [title, *made.brief])


def directory_rows(directory: Path) -> list[ResultRow]:
    """Rows of a results directory; RunStoreError says what to do when it has none."""
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
    return rows


def _head(record: Mapping[str, Any], n_runs: int) -> str:
    """One line: cut-off, commits, models, machines, dates and the number of rows."""
    made = sessions(record)
    models = [
        f"{name} {digest[:12]}" for name, digest in sorted(digests_in(record, "weights").items())
    ]
    machines = [
        f"{s.get('cpu_model') or 'unknown'}, {s.get('cpu_count') or '?'} cores" for s in made
    ]
    return " · ".join(
        [
            _cutoffs(record),
            f"commit {_distinct(map(_commit, made))}",
            *([f"weights {_distinct(models)}"] if models else []),
            f"machine {_distinct(machines)}",
            f"date {_distinct(str(session.get('date_utc') or 'unknown') for session in made)}",
            f"{n_runs} rows",
        ]
    )


def _cutoffs(record: Mapping[str, Any]) -> str:
    """The budget of a run."""
    configuration = record["configuration"]
    seconds, iterations = configuration.get("cutoff_s"), configuration.get("iterations")
    limits = [f"cutoff {seconds:g} s"] if seconds else []
    return (
        ", ".join([*limits, f"{iterations} iterations"] if iterations else limits)
        or "cutoff not recorded"
    )


def _commit(session: Mapping[str, Any]) -> str:
    commit = (session.get("git_commit") or "unknown")[:12]
    return f"{commit} WITH UNCOMMITTED CHANGES" if session.get("git_dirty") else commit


def _distinct(texts: Iterable[str]) -> str:
    return " and ".join(dict.fromkeys(texts))
