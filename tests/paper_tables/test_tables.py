"""Tables of results directories: files, LaTeX, the log for OMPL, and seeds that count once."""

import json
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest
from made_rows import a_failure, a_row
from refusals import refused

from cli.main import main
from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.results.row import write_rows
from cvqmpt_lab.results.store import PARTIAL_FILE, RunStore
from paper_tables.committed import RESULTS
from paper_tables.layouts import place_table
from paper_tables.statements import read_published
from paper_tables.suites import render_directory
from paper_tables.writers import latex_table


def rows(suite="place-task", count=10):
    runs = product(("birrt", "ompl-projected"), range(count))
    return [a_row(f"p{k}", planner, suite=suite, t_total_s=1.0) for planner, k in runs]


def store(directory, some_rows, **session):
    with RunStore.open(directory, {"suite": "place-task", "cutoff_s": 10.0}, session) as opened:
        opened.append(some_rows)


def test_the_head_line_names_every_commit_and_changes_that_were_not_committed(tmp_path):
    store(tmp_path, rows(), git_commit="a" * 40, cpu_model="Fast CPU", cpu_count=2)
    store(tmp_path, rows(count=11)[10:11], git_commit="b" * 40, git_dirty=True)
    head = render_directory(tmp_path).texts["table.md"].splitlines()[2]
    assert head.startswith(f"cutoff 10 s · commit {'a' * 12} and {'b' * 12} WITH UNCOMMITTED")


def test_directories_without_runs_say_what_to_do(tmp_path):
    def directory_refused(message, directory=tmp_path):
        refused(message, render_directory, directory, error=RunStoreError)

    directory_refused(r"not a directory; run an experiment with --out", tmp_path / "absent")
    directory_refused(r"no runs\.csv; run an experiment")
    (tmp_path / PARTIAL_FILE).write_text("")
    directory_refused("interrupted run; repeat its command")
    write_rows(tmp_path / "runs.csv", [])
    directory_refused("no rows")
    write_rows(tmp_path / "runs.csv", rows())
    directory_refused(r"no provenance\.json")
    (tmp_path / "provenance.json").write_text(json.dumps({"configuration": {}}))
    assert "cutoff not recorded · commit unknown" in render_directory(tmp_path).texts["table.md"]


TABLES = sorted(RESULTS.glob("*/table.tex"))
COMPILER = shutil.which("pdflatex")
DOCUMENT = (
    r"\documentclass[twocolumn]{article}\usepackage[a4paper,margin=15mm]{geometry}\usepackage{booktabs}"
    "\n\\begin{document}\n%s\n\\end{document}\n"
)


def test_names_are_escaped():
    escaped = latex_table("", "x", [[["", "", "my_50%_#1"], ["time", "ours", "–∞"]]])
    assert r"my\_50\%\_\#1" in escaped and escaped.isascii()


@pytest.mark.skipif(COMPILER is None, reason="no pdflatex (apt: texlive-latex-recommended)")
def test_committed_tables_compile_and_fit_on_pages(tmp_path):
    tables = "\n\\clearpage\n".join(path.read_text(encoding="utf-8") for path in TABLES)
    (tmp_path / "tables.tex").write_text(DOCUMENT % tables, encoding="utf-8")
    words = [COMPILER, "-halt-on-error", "-interaction=nonstopmode", "tables.tex"]
    how = {"capture_output": True, "text": True, "timeout": 120, "errors": "replace"}
    done = subprocess.run(words, cwd=tmp_path, **how)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in done.stdout and "too large" not in done.stdout


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


PAPER = read_published("place_task.csv", "Place Task")


def run(planner, problem, time=None, **values):
    """A row; a failure where `time` is None."""
    make, time = (a_failure, 10.0) if time is None else (a_row, time)
    return make(f"p{problem}", planner, **{"suite": "place-task", "t_total_s": time, **values})


def some_rows():
    counts = [{"path_length_rad": 5.0 + i, "vertices": 10 + i} for i in range(10)]
    rows = [run("birrt", i, 0.1 * (i + 1), **values) for i, values in enumerate(counts)]
    values = {"path_length_rad": 8.0, "vertices": 40}
    rows += [run("ompl-projected", i, 0.4 * (i + 1), **values) for i in range(8)]
    rows.append(run("ompl-projected", 8, detail="no path"))
    return [*rows, run("ompl-projected", 9, fail_reason="uncertified_goal")]


def found(rows):
    return {item.planner: item for item in place_table(rows, PAPER).found}


def test_the_same_runs_again_under_other_seeds_make_nothing_surer():
    once = [replace(row, n_state_checks=i, n_projections=1) for i, row in enumerate(some_rows())]
    five_times = [replace(row, seed=seed) for seed in range(5) for row in once]
    for one, five in zip(found(once).values(), found(five_times).values(), strict=True):
        assert five.n_runs == 5 * one.n_runs
        for name, interval in one.measured.items():
            same = five.measured[name]
            assert same.n == interval.n
            bounds = interval.estimate, interval.low, interval.high
            assert (same.estimate, same.low, same.high) == pytest.approx(bounds), name


@pytest.mark.parametrize("rows", [[], [run("birrt", 0, 1.0), run("birrt", 0, 1.0, suite="random")]])
def test_a_table_is_of_one_suite(rows):
    refused("one suite", place_table, rows, PAPER)
