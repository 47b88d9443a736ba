"""Paths of a finished run, from its rows and stored states: certified again, or on a page."""

from collections.abc import Iterator, Mapping
from itertools import groupby, takewhile
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cvqmpt_lab.base.errors import InvalidInputError, RunStoreError
from cvqmpt_lab.benchmarks.declarations import SUITES
from cvqmpt_lab.benchmarks.item import ExecutedProblem, SensedProblem
from cvqmpt_lab.benchmarks.results.provenance import ProvenanceFile, digests_in
from cvqmpt_lab.benchmarks.results.row import ResultRow
from cvqmpt_lab.benchmarks.results.store import directory_rows, stored_paths
from cvqmpt_lab.benchmarks.suite import folder_suite, suite_named
from cvqmpt_lab.benchmarks.suite_parts import Suite
from cvqmpt_lab.certificate.certificate import Certificate, certify
from cvqmpt_lab.features.tasks.task import Task
from cvqmpt_lab.features.tasks.world import phase_problems
from cvqmpt_lab.paper_tables.evidence import Evidence
from cvqmpt_lab.problem import PlanningProblem
from cvqmpt_lab.search.result import JointPath


class Recertified(NamedTuple):
    """The row of a path, and the new certificate."""

    row: ResultRow
    certificate: Certificate | None  # None where there is no path to judge
    trouble: str = ""  # why the row cannot be trusted


def recertify(directory: Path, problems_dir: Path | None = None) -> Iterator[Recertified]:
    """Certify all paths of a run again, problem by problem.

    problems_dir: folder of the problem files, of runs of such. RunStoreError: rows or paths are
        missing or damaged, the run was interrupted, or the problem files are others, or not given.
    """
    rows, paths = directory_rows(directory), stored_paths(directory)
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
            executed = isinstance(item, ExecutedProblem)  # such rows are of executions, not paths
            judged = (row for row in of_run if row.path_sha256 or (row.certified and not executed))
            yield from _recertified(item, list(judged), paths)


def _folder_of(directory: Path, problems_dir: Path | None) -> Suite | None:
    """Return the folder of a run's problem files after comparing digests; None for other runs."""
    file = ProvenanceFile(directory)
    known = digests_in(file.read(), "problem_files") if file.path.is_file() else {}
    if problems_dir is None and known:
        raise RunStoreError(
            f"{directory} holds runs of a folder of problem files; name it: cvqmpt certify "
            f"{directory} FOLDER"
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


def _recertified(
    item: object, rows: list[ResultRow], paths: Mapping[Any, np.ndarray]
) -> Iterator[Recertified]:
    """Yield new certificates of the paths of one run: of a problem, or of the phases of a task."""
    item = item.problem if isinstance(item, SensedProblem) else item
    if not isinstance(item, PlanningProblem | Task):
        for row in rows:
            yield Recertified(row, None, f"suite {row.suite} has no problem {row.item!r} now")
        return
    kept = [paths[row.path_sha256] for row in takewhile(lambda r: r.path_sha256 in paths, rows)]
    problems = phase_problems(item, kept) if isinstance(item, Task) else [item] * len(kept)
    for row, problem, states in zip(rows, problems, kept, strict=False):
        yield _compared(row, problem, states)
    for k, row in enumerate(rows[len(kept) :]):
        why = "its path is not kept" if row.path_sha256 else "certified in the row, without a path"
        yield Recertified(row, None, "a path before it is not kept" if k else why)


def _compared(row: ResultRow, problem: PlanningProblem, states: np.ndarray) -> Recertified:
    """Return the certificate of a row's path (m, n) [rad or m] and its contradictions."""
    try:
        certificate = certify(problem, JointPath(states), exact_clearance=True)
    except InvalidInputError as error:
        return Recertified(row, None, str(error))
    length, trouble = JointPath(states).length, ""
    if row.path_length_rad is None or abs(length - row.path_length_rad) > 1e-9:
        trouble = f"its path is {length:.6f} rad long, the row says {row.path_length_rad}"
    elif row.certified and not certificate.valid:
        trouble = f"certified in the row, not certified now: {'; '.join(certificate.reasons)}"
    elif not row.certified and certificate.valid:
        trouble = "not certified in the row, certified now"
    else:
        trouble = _other_number(row, certificate)
    return Recertified(row, certificate, trouble)


def _other_number(row: ResultRow, certificate: Certificate, rounding: float = 1e-6) -> str:
    """Return the first number of a row that is not the certificate's, in words; "" if none is.

    Args:
        row: the row of a path; empty columns are not compared.
        certificate: the new certificate.
        rounding: differences up to this come from other machines [m or rad].
    """
    obstacle, own = certificate.obstacle_clearance, certificate.self_clearance
    numbers = {
        "max_violation_rad": certificate.max_violation_rad,
        "max_violation_m": certificate.max_violation_m,
        "min_clearance_m": certificate.min_clearance_m,
        "obstacle_clearance_m": obstacle.distance_m if obstacle else np.inf,
        "self_clearance_m": own.distance_m if own else np.inf,
    }
    for name, now in numbers.items():
        then = getattr(row, name)
        if then is not None and not abs(then - now) <= rounding:
            return f"{name} is {then:.6g} in the row, {now:.6g} now"
    return ""


def first_path(found: Mapping[str, Evidence]) -> dict[str, dict[str, str]]:
    """Return a page of the first certified path of a problem, by name of the results directory."""
    # rendering takes a quarter of a second to import
    from cvqmpt_lab.features.pictures.web_page import path_html

    for evidence in found.values():
        paths = stored_paths(evidence.folder)
        for row in evidence.rows:
            states, suite = paths.get(row.path_sha256 or ""), SUITES.get(row.suite)
            if not row.solved or states is None or suite is None or not row.problem.isdecimal():
                continue
            # the suite may have other problems now
            index = int(row.problem)
            problem = suite.solvable(index) if index in suite.problems else None
            if isinstance(problem, PlanningProblem):
                name = f"certified path of {row.planner}"
                title = f"problem {row.problem}, {row.planner}, seed {row.seed}"
                html = path_html(problem, states, name, suite.carried)
                return {evidence.folder.name: {"title": title, "html": html}}
    return {}
