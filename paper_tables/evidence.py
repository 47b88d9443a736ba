"""Results directories, and which of their rows verdicts count."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any

from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.results.provenance import (
    PROVENANCE_FILE,
    ProvenanceFile,
    sessions,
    streams_of,
)
from cvqmpt_lab.benchmarks.results.row import (
    PAPER_PHASES,
    RUNS_FILE,
    FailReason,
    ResultRow,
    read_rows,
    split_problem,
    without_ended,
)
from cvqmpt_lab.paper_tables.measures import Rows
from cvqmpt_lab.paper_tables.statements import CLAIMS, PROBLEMS, STREAMS


@dataclass(frozen=True, eq=False)
class Evidence:
    """A results directory."""

    folder: Path
    rows: Rows  # empty for a figure
    record: dict[str, Any]  # its provenance

    @cached_property
    def old_streams(self) -> bool:
        """Whether rows have random streams of a rule whose rows are not judged."""
        return min(map(streams_of, sessions(self.record))) < STREAMS

    @cached_property
    def judged(self) -> "Evidence":
        """The rows that verdicts may count, see `statements.PROBLEMS`."""
        ends = PROBLEMS.get(self.rows[0].suite) if self.rows else None
        kept = [x for x in self.rows if ends is None or ends[0] <= int(x.item) <= ends[1]]
        if self.old_streams or not kept:
            return replace(self, rows=())
        return self if len(kept) == len(self.rows) else replace(self, rows=kept)

    @cached_property
    def runs(self) -> dict[str, dict[tuple[str, int], Rows]]:
        """Rows of each run by planner, and by problem and seed.

        A run of a task has the rows of the phases that the paper times; a task in which another
        phase failed is left out. So are problems that could not be made.
        """
        suite = SUITES.get(self.rows[0].suite) if self.rows else None
        of_tasks = suite is not None and suite.of_tasks
        found: dict[str, dict[tuple[str, int], list[ResultRow]]] = {}
        for row in filter(attrgetter("made"), self.rows):
            problem = row.item if of_tasks else row.problem
            found.setdefault(row.planner, {}).setdefault((problem, row.seed), []).append(row)
        counted = _timed_phases if of_tasks else tuple
        return {
            planner: {key: kept for key, rows in runs.items() if (kept := counted(rows))}
            for planner, runs in found.items()
        }


def _timed_phases(task: Rows) -> Rows:
    """Return the rows of the phases that the paper times; none if another phase failed."""
    timed = [row for row in task if split_problem(row.problem).phase in PAPER_PHASES]
    others = [row for row in task if row not in timed and not row.solved]
    untimed_failure = any(row.fail_reason is not FailReason.NOT_REACHED for row in others)
    return () if untimed_failure else timed


def profiles(found: Mapping[str, Evidence]) -> list[str]:
    """Return the profiles of rows that are too small for verdicts: all except "full"."""
    records = [session for item in found.values() for session in sessions(item.record)]
    named = dict.fromkeys(session.get("profile") for session in records)
    return [name for name in named if name and name != "full"]


def banner(found: Mapping[str, Evidence]) -> str:
    """Return a warning if rows are not judged, or if their profile is too small, else ""."""
    small = profiles(found)
    texts = []
    if small:
        texts.append(
            f"These rows were made with --profile {', '.join(small)}, which is a quick trial: few "
            "problems and wide intervals. Verdicts on the paper need --profile full."
        )
    suites = {name for claim in CLAIMS for name in claim.suites}
    old = [name for name in found if name in suites and not found[name].judged.rows]
    if old:
        texts.append(
            f"Not judged: {', '.join(old)}. These rows have random streams of an earlier rule than "
            f"{STREAMS}, or none of the problems that are judged; run them again into another "
            "folder."
        )
    return " ".join(texts)


def evidence_below(results: Path) -> dict[str, Evidence]:
    """Return the results directories below a folder, by name."""
    folders = sorted(path.parent for path in Path(results).glob(f"*/{PROVENANCE_FILE}"))
    return {folder.name: read_evidence(folder) for folder in folders}


def read_evidence(folder: Path) -> Evidence:
    """Return rows and provenance of a results directory."""
    rows = read_rows(folder / RUNS_FILE) if (folder / RUNS_FILE).is_file() else []
    return Evidence(folder, without_ended(rows), ProvenanceFile(folder).read())
