"""OMPL's statistics script reads the log of a run."""

import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from made_rows import a_failure, a_row

from cli.main import main
from cvqmpt_lab.results.store import RunStore

SCRIPT = Path(sys.executable).parent / "ompl_benchmark_statistics"
TIMES = {"t_total_s": 2.5, "t_simplify_s": 0.5}
COUNTS = {"t_total_s": 1.0, "n_projections": 7, "n_state_checks": 9, "min_clearance_m": -0.001}
ROWS = (
    a_row(**TIMES, path_length_raw_rad=9.0, path_length_rad=8.0, vertices=40),
    a_row(problem="a; b", **COUNTS),
    a_failure(planner="mpnet", t_total_s=10.0),
    a_failure(planner="mpnet", problem="p2", fail_reason="uncertified_collision"),
)


@pytest.fixture
def database(tmp_path):
    """Output of the script for ROWS."""
    session = {"platform": "Linux-6 of a lab", "date_utc": "2026-01-02T03:04:05+00:00"}
    configuration = {"suite": "place", "cutoff_s": 10.0, "iterations": None}
    run, log, made = (tmp_path / f"run{ending}" for ending in ("", ".log", ".db"))
    with RunStore.open(run, configuration, {**session, "versions": {}}) as store:
        store.append(ROWS)
    assert main(["table", str(run), "--ompl-log", str(log)]) == 0
    subprocess.run([SCRIPT, "-d", made, log], check=True, capture_output=True)
    with sqlite3.connect(made) as connection:
        yield connection


def test_every_row_is_a_run_of_its_planner(database):
    found = database.execute(
        """SELECT plannerConfigs.name, problem, seed, solved, status, fail_reason, time,
        simplification_time, solution_length, simplified_solution_length, graph_states,
        projections, state_checks, clearance
        FROM runs JOIN plannerConfigs ON plannerid = plannerConfigs.id ORDER BY runs.id"""
    ).fetchall()
    assert found == [
        ("birrt", "a, b", 0, 1, 6, None, 1.0, None, None, None, None, 7, 9, -0.001),
        ("birrt", "place_0", 0, 1, 6, None, 2.0, 0.5, 9.0, 8.0, 40, None, None, None),
        ("mpnet", "p2", 0, 0, 0, "uncertified_collision", *[None] * 8),
        ("mpnet", "place_0", 0, 0, 4, "timeout", 10.0, *[None] * 7),
    ]
