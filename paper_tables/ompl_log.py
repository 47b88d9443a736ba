"""A run as OMPL's benchmark log, which ``ompl_benchmark_statistics`` and Planner Arena read."""

from collections.abc import Callable, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

from cvqmpt_lab.base.errors import InvalidInputError
from cvqmpt_lab.benchmarks.results.provenance import ProvenanceFile
from cvqmpt_lab.benchmarks.results.row import FailReason, ResultRow
from cvqmpt_lab.benchmarks.results.store import directory_rows
from cvqmpt_lab.paper_tables.measures import grouped
from cvqmpt_lab.paper_tables.table_engine import rows_of_one_suite


def ompl_log(directory: Path) -> str:
    """Return a results directory as one experiment in OMPL's log format, named after its suite.

    InvalidInputError: no readable runs of one suite, or solved runs without times.
    """
    rows = rows_of_one_suite(directory_rows(directory))
    record = ProvenanceFile(directory).read()
    untimed = [row for row in rows if row.solved and row.t_total_s is None]
    if untimed:
        raise InvalidInputError(
            f"{directory}: {len(untimed)} solved runs have no time, first problem "
            f"{untimed[0].problem} of {untimed[0].planner}; OMPL's log needs times: run them again"
        )
    settings, properties = record["configuration"], _properties()
    runs = grouped((row.planner, row) for row in rows)
    lines = [
        f"cvqmpt_lab version {record.get('versions', {}).get('cvqmpt-lab') or '0'}",
        f"Experiment {rows[0].suite}",
        "0 experiment properties",
        f"Running on {((record.get('platform') or '').split() or ['unknown'])[0]}",
        f"Starting at {record.get('date_utc') or 'unknown'}",
        *("<<<|", *(f"{name} = {value}" for name, value in settings.items()), "|>>>"),
        *("<<<|", record.get("cpu_model") or "unknown", "|>>>"),
        f"{min(row.seed for row in rows)} is the random seed",
        f"{settings.get('cutoff_s') or 'inf'} seconds per run",
        "inf MB per run",
        f"{max(map(len, runs.values()))} runs per planner",
        f"{sum(row.t_total_s or 0.0 for row in rows)} seconds spent to collect the data",
        "1 enum type",
        "|".join(("status", *_statuses())),
        f"{len(runs)} planners",
    ]
    for planner, own in runs.items():
        lines += [planner, "0 common properties", f"{len(properties)} properties for each run"]
        lines += [*properties, f"{len(own)} runs"]
        for row in own:
            values = [value_of(row) for value_of in properties.values()]
            # every value is followed by "; "; an undefined one is empty
            cells = ["" if x is None else str(x).replace(";", ",") for x in values]
            lines.append("".join(f"{cell}; " for cell in cells))
        lines.append(".")
    return "\n".join(lines) + "\n"


def _statuses() -> dict[str, tuple[FailReason, ...]]:
    """Return OMPL's statuses in its order, each with the reasons here that it stands for."""
    reason = FailReason
    return {
        "Unknown status": (),  # of all other reasons; the property "fail reason" has them
        "Invalid start": (reason.NO_START, reason.INVALID_START),
        "Invalid goal": (reason.NO_GOAL, reason.INVALID_GOAL),
        "Unrecognized goal type": (),
        "Timeout": (reason.TIMEOUT, reason.ITERATION_LIMIT, reason.COST_LIMIT, reason.OVERTIME),
        "Approximate solution": (),
        "Exact solution": (),
        "Crash": (reason.WORKER_DIED, reason.WORKER_HUNG, reason.OUT_OF_MEMORY),
        "Abort": (),
        "Infeasible": (),
    }


def _properties() -> Mapping[str, Callable[[ResultRow], Any]]:
    """Return the properties of a run by name and SQL type, in OMPL's words where it has any."""
    statuses = _statuses()
    place: dict[FailReason | None, int] = {
        reason: k for k, found in enumerate(statuses.values()) for reason in found
    }
    solved = [*statuses].index("Exact solution")
    return {
        "problem TEXT": attrgetter("problem"),
        "seed INTEGER": attrgetter("seed"),
        "solved BOOLEAN": lambda row: int(row.solved),
        "status ENUM": lambda row: solved if row.solved else place.get(row.fail_reason, 0),
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
    }
