"""Tables of results directories in the paper's layout: Markdown, LaTeX and csv."""

import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from cvqmpt_lab.base.files import write_text
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.results.provenance import (
    STREAMS,
    ProvenanceFile,
    digests_in,
    sessions,
    streams_of,
)
from cvqmpt_lab.benchmarks.results.row import RUNS_FILE, ResultRow
from cvqmpt_lab.benchmarks.results.store import rows_and_note
from cvqmpt_lab.paper_tables.layouts import place_table
from cvqmpt_lab.paper_tables.statements import PublishedValue, read_published
from cvqmpt_lab.paper_tables.table_engine import SuiteTable, goalless_text, rows_of_one_suite
from cvqmpt_lab.paper_tables.writers import markdown, markdown_text
from cvqmpt_lab.vqmpt.sampler_choice import CHOICES, NAMED_SAMPLERS

OLDER = (
    "Older rows: random numbers depended on the start alone. Title, notes and the descriptions of "
    "planners are the present ones, and these rows may be of an earlier form of the suite."
)


def earlier_samplers(rows: Iterable[ResultRow]) -> str:
    """Return which planners of rows sampled otherwise than those names do now, or ""."""
    found: dict[str, set[str]] = {}
    for row in rows:
        now = NAMED_SAMPLERS.get(row.planner)
        for field in CHOICES if now else ():
            then = getattr(row, field)
            if then and then != getattr(now, field):
                found.setdefault(row.planner, set()).add(then)
    named = [f"`{name}` ({', '.join(sorted(words))})" for name, words in found.items()]
    return f"Earlier samplers with the same names: {', '.join(named)}." if named else ""


def title_of(suite: str) -> str:
    """Return the title of the tables of a suite or of a folder of problem files."""
    return SUITES[suite].title if suite in SUITES else f"Folder {suite}"


def published_of(suite: str) -> tuple[PublishedValue, ...]:
    """Return the paper's numbers of a suite; empty where the paper has none."""
    paper = SUITES[suite].paper if suite in SUITES else None
    return read_published(*paper) if paper else ()


def table_of(rows: Iterable[ResultRow]) -> SuiteTable:
    """Return the table of rows; a folder of problem files has the place task's table.

    Raises:
        InvalidInputError: the rows are not of exactly one suite.
    """
    rows = rows_of_one_suite(rows)
    suite = rows[0].suite
    if suite not in SUITES:
        return place_table(rows, own=True)
    made: SuiteTable = SUITES[suite].table(rows, published_of(suite))
    return made


class Rendered(NamedTuple):
    """Tables of a results directory by the file's name, and lines for the terminal."""

    texts: dict[str, str]
    brief: list[str]


def rendered_tables(directory: Path) -> Rendered:
    """``table.md``, ``.tex`` and ``.csv`` of rows of one suite.

    InvalidInputError: no readable runs with provenance.
    """
    rows, note = rows_and_note(directory)
    record = ProvenanceFile(directory).read()
    made, head = table_of(rows), _head(record, len(rows))
    title, label = title_of(made.suite), directory.resolve().name
    notes = [str(line) for line in made.sections.get("Notes", ())]
    ended = [note] if note else []
    older = [OLDER] * (min(map(streams_of, sessions(record))) < STREAMS)
    older += filter(None, [earlier_samplers(rows)])
    caption = f"{title}, {made.size}. In brackets: 95 % intervals. Bold: the best value."
    texts = {
        "table.md": "\n\n".join(
            [
                f"# {markdown_text(title)}",
                *map(markdown_text, (head, *older, *ended)),
                made.markdown,
            ]
        )
        + "\n"
        + markdown({f"Sessions that made {RUNS_FILE}": [*map(session_text, sessions(record))]}),
        "table.tex": "".join(f"% {line}\n" for line in (head, *ended, *notes))
        + made.latex(caption, label),
        "table.csv": made.csv,
    }
    facts = filter(None, (made.size, goalless_text(rows), _cutoffs(record)))
    brief = [f"{title}: {', '.join(facts)}", *ended, *made.brief]
    return Rendered(texts, brief)


def render_directory(directory: Path) -> Rendered:
    """Write `rendered_tables` beside ``runs.csv``."""
    made = rendered_tables(directory)
    for name, text in made.texts.items():
        write_text(directory / name, text)
    return made


def _head(record: Mapping[str, Any], n_runs: int) -> str:
    """One line: cut-off, commits, models, machines, dates and the number of rows."""
    made = sessions(record)
    models = [
        f"{name} {digest[:12]}" for name, digest in sorted(digests_in(record, "weights").items())
    ]
    return " · ".join(
        [
            _cutoffs(record),
            f"commit {_distinct(map(_commit, made))}",
            *([f"weights {_distinct(models)}"] if models else []),
            f"machine {_distinct(map(_machine, made))}",
            f"date {_distinct(str(s.get('date_utc') or 'unknown') for s in made)}",
            f"{n_runs} rows",
        ]
    )


def session_text(session: Mapping[str, Any]) -> str:
    """Return the command, commit, machine and date of a session of runs."""
    command = shlex.join(session.get("command") or ["unknown"])
    date = session.get("date_utc") or "unknown"
    return f"`{command}`, commit {_commit(session)}, machine {_machine(session)}, date {date}"


def _commit(session: Mapping[str, Any]) -> str:
    changed = " WITH UNCOMMITTED CHANGES" if session.get("git_dirty") else ""
    return (session.get("git_commit") or "unknown")[:12] + changed


def _machine(session: Mapping[str, Any]) -> str:
    return f"{session.get('cpu_model') or 'unknown'}, {session.get('cpu_count') or '?'} cores"


def _cutoffs(record: Mapping[str, Any]) -> str:
    """The budget of a run."""
    configuration = record["configuration"]
    seconds, iterations = configuration.get("cutoff_s"), configuration.get("iterations")
    limits = [f"cutoff {seconds:g} s"] if seconds else []
    limits += [f"{iterations} iterations"] if iterations else []
    cost = configuration.get("cost_s")
    limits += [f"cutoff {cost:g} s at the paper's prices"] if cost else []
    return ", ".join(limits) or "cutoff not recorded"


def _distinct(texts: Iterable[str]) -> str:
    return " and ".join(dict.fromkeys(texts))
