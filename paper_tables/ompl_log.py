"""A run as OMPL's benchmark log, which ``ompl_benchmark_statistics`` and Planner Arena read."""

from collections.abc import Callable, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

from cvqmpt_lab.results.provenance import ProvenanceFile
from cvqmpt_lab.results.row import FailReason, ResultRow
from paper_tables.measures import grouped
from paper_tables.suites import directory_rows

STATUSES = (
    "Unknown status", "Invalid start", "Invalid goal", "Unrecognized goal type", "Timeout",
    "Approximate solution", "Exact solution", "Crash", "Abort", "Infeasible",
)  # fmt: skip
"""OMPL's own, in its order: a database of several logs keeps one list."""
STATUS_OF: Mapping[FailReason | None, str] = {
    None: "Exact solution",
    FailReason.TIMEOUT: "Timeout",
    FailReason.ITERATION_LIMIT: "Timeout",
    FailReason.NO_START: "Invalid start",
    FailReason.INVALID_START: "Invalid start",
    FailReason.NO_GOAL: "Invalid goal",
    FailReason.INVALID_GOAL: "Invalid goal",
    FailReason.WORKER_DIED: "Crash",
    FailReason.WORKER_HUNG: "Crash",
    FailReason.OUT_OF_MEMORY: "Crash",
}  # other reasons are unknown to OMPL; the property "fail reason" has them all


PROPERTIES: Mapping[str, Callable[[ResultRow], Any]] = {
    "problem TEXT": attrgetter("problem"),
    "seed INTEGER": attrgetter("seed"),
    "solved BOOLEAN": lambda row: int(row.solved),
    "status ENUM": lambda row: STATUSES.index(STATUS_OF.get(row.fail_reason, "Unknown status")),
    "fail reason TEXT": attrgetter("fail_reason"),
    # all but the shortening, which OMPL counts apart [s]
    "time REAL": lambda row: row.t_total_s and row.t_total_s - (row.t_simplify_s or 0.0),
    "simplification time REAL": attrgetter("t_simplify_s"),
    "solution length REAL": attrgetter("path_length_raw_rad"),
    "simplified solution length REAL": attrgetter("path_length_rad"),
    "graph states INTEGER": attrgetter("vertices"),
    "projections INTEGER": attrgetter("n_projections"),
    "state checks INTEGER": attrgetter("n_state_checks"),
    "clearance REAL": attrgetter("min_clearance_m"),
}  # name and SQL type of each property of a run, in OMPL's words where it has any


def ompl_log(directory: Path) -> str:
    """A results directory as one experiment, named after its suite, in the grammar of OMPL's log.

    InvalidInputError: no readable runs with provenance.
    """
    rows, record = directory_rows(directory), ProvenanceFile(directory).read()
    settings = record["configuration"]
    ordered = sorted(rows, key=attrgetter("planner", "problem"))
    runs = grouped([(row.planner, row) for row in ordered])
    lines = [
        f"cvqmpt_lab version {record.get('versions', {}).get('cvqmpt-lab') or '0'}",
        f"Experiment {rows[0].suite}",
        "0 experiment properties",
        f"Running on {(record.get('platform') or 'unknown').split()[0]}",
        f"Starting at {record.get('date_utc') or 'unknown'}",
        *("<<<|", *(f"{name} = {value}" for name, value in settings.items()), "|>>>"),
        *("<<<|", record.get("cpu_model") or "unknown", "|>>>"),
        f"{min(row.seed for row in rows)} is the random seed",
        f"{settings.get('cutoff_s') or 'inf'} seconds per run",
        "inf MB per run",
        f"{max(map(len, runs.values()))} runs per planner",
        f"{sum(row.t_total_s or 0.0 for row in rows)} seconds spent to collect the data",
        "1 enum type",
        "|".join(("status", *STATUSES)),
        f"{len(runs)} planners",
    ]
    for planner, own in runs.items():
        lines += [
            planner,
            "0 common properties",
            f"{len(PROPERTIES)} properties for each run",
            *PROPERTIES,
        ]
        lines.append(f"{len(own)} runs")
        for row in own:
            values = [value_of(row) for value_of in PROPERTIES.values()]
            # every value followed by "; "; nothing where it is undefined
            cells = ["" if x is None else str(x).replace(";", ",") for x in values]
            lines.append("".join(f"{cell}; " for cell in cells))
        lines.append(".")
    return "\n".join(lines) + "\n"
