"""Certify every path of a finished run again, from its rows and stored states."""

from collections.abc import Iterator
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cvqmpt_lab.benchmarks.item import SensedProblem
from cvqmpt_lab.benchmarks.suite import Suite, folder_suite, suite_named
from cvqmpt_lab.certificate import Certificate, certify
from cvqmpt_lab.errors import InvalidInputError, RunStoreError
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.results.provenance import ProvenanceFile, digests_in
from cvqmpt_lab.results.row import RUNS_FILE, ResultRow, read_rows, sorted_rows
from cvqmpt_lab.results.store import PARTIAL_FILE, StoredPaths
from cvqmpt_lab.search.result import JointPath
from cvqmpt_lab.tasks.phase_goals import phase_problems
from cvqmpt_lab.tasks.task import Task

LENGTH_TOLERANCE = 1e-9  # [rad] between the length in a row and that of its path


class Verdict(NamedTuple):
    """The row of a path, and the new certificate."""

    row: ResultRow
    certificate: Certificate | None  # None where there is no path to judge
    trouble: str = ""  # why the row cannot be trusted


def recertify(directory: Path, problems_dir: Path | None = None) -> Iterator[Verdict]:
    """Verdicts on all rows of a run that have a path, problem by problem.

    problems_dir: folder of the problem files, of runs of such. RunStoreError: rows or paths are
        missing or damaged, the run was interrupted, or the problem files are others, or not given.
    """
    if (directory / PARTIAL_FILE).is_file():
        raise RunStoreError(
            f"{directory} holds an interrupted run; repeat its command to continue it"
        )
    rows, paths = sorted_rows(read_rows(directory / RUNS_FILE)), StoredPaths(directory)
    if not paths and any(row.path_sha256 for row in rows):
        raise RunStoreError(
            f"{directory} keeps no paths.npz: it was made by an earlier version; run it again"
        )
    folder, run_key = _folder_of(directory, problems_dir), attrgetter("run_key")
    for (suite, name), of_item in groupby(
        sorted(rows, key=run_key), key=lambda row: row.run_key[:2]
    ):
        if folder is not None:
            item = folder.item(name) if name in folder.problems else None
        else:
            item = suite_named(suite).item(int(name)) if name.isdecimal() else None
        for _, of_run in groupby(of_item, key=run_key):
            yield from _verdicts(item, list(of_run), paths)


def _folder_of(directory: Path, problems_dir: Path | None) -> Suite | None:
    """Folder of a run's problem files, with digests checked; None for other runs."""
    file = ProvenanceFile(directory)
    known = digests_in(file.read(), "problem_files") if file.path.is_file() else {}
    if problems_dir is None and known:
        raise RunStoreError(
            f"{directory} holds runs of a folder of problem files; name it with --problems-dir"
        )
    if problems_dir is None:
        return None
    folder = folder_suite(problems_dir)
    for name, digest in known.items():
        if folder.digests.get(name) != digest:
            raise RunStoreError(
                f"problem {name!r} of {problems_dir} is not the one that was run in {directory}"
            )
    return folder


def _verdicts(item: object, rows: list[ResultRow], paths: StoredPaths) -> Iterator[Verdict]:
    """Verdicts on the rows of one run, of a problem or of the phases of a task."""
    rows = [row for row in rows if row.path_sha256]
    item = item.problem if isinstance(item, SensedProblem) else item
    if not isinstance(item, PlanningProblem | Task):
        for row in rows:
            yield Verdict(row, None, f"suite {row.suite} has no problem {row.item!r} now")
        return
    kept = [paths.get(row.path_sha256) for row in rows if row.path_sha256]
    missing = next((k for k, states in enumerate(kept) if states is None), len(kept))
    known = [states for states in kept[:missing] if states is not None]
    problems = phase_problems(item, known) if isinstance(item, Task) else [item] * len(known)
    for row, problem, states in zip(rows, problems, known, strict=False):
        yield _verdict(row, problem, states)
    for k, row in enumerate(rows[missing:]):
        yield Verdict(row, None, "a path before it is not kept" if k else "its path is not kept")


def _verdict(row: ResultRow, problem: PlanningProblem, states: np.ndarray) -> Verdict:
    try:
        certificate = certify(problem, JointPath(states), clearance=False)
    except InvalidInputError as error:
        return Verdict(row, None, str(error))
    length, trouble = JointPath(states).length, ""
    if row.path_length_rad is None or abs(length - row.path_length_rad) > LENGTH_TOLERANCE:
        trouble = f"its path is {length:.6f} rad long, the row says {row.path_length_rad}"
    elif row.certified and not certificate.valid:
        trouble = f"certified in the row, refused now: {'; '.join(certificate.reasons)}"
    elif not row.certified and certificate.valid:
        trouble = "refused in the row, certified now"
    return Verdict(row, certificate, trouble)
