"""Rendered results directories: files, the head line, and directories without runs."""

import json
from itertools import product

from made_rows import a_row
from refusals import refused

from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.results.row import write_rows
from cvqmpt_lab.results.store import PARTIAL_FILE, RunStore
from paper_tables.suites import SUITES, render_directory


def rows(suite="place-task", count=10):
    runs = product(("birrt", "ompl-projected"), range(count))
    return [a_row(f"p{k}", planner, suite=suite, t_total_s=1.0) for planner, k in runs]


def store(directory, some_rows, **session):
    with RunStore.open(directory, {"suite": "place-task", "cutoff_s": 10.0}, session) as opened:
        opened.append(some_rows)


def test_a_directory_is_rendered_beside_its_runs(tmp_path):
    machine = {"cpu_model": "Fast CPU", "cpu_count": 2}
    store(tmp_path, rows(), git_commit="a" * 40, weights={"mpnet": "f" * 64}, **machine)
    written = render_directory(tmp_path)
    assert [*written.texts] == ["table.md", "table.tex", "table.csv"]
    assert all((tmp_path / name).read_text() == text for name, text in written.texts.items())
    title, _, head, *_ = written.texts["table.md"].splitlines()
    assert title == f"# {SUITES['place-task'].title}"
    assert written.brief[0] == f"{SUITES['place-task'].title}: 10 problems, cutoff 10 s"
    traced = f"commit {'a' * 12} · weights mpnet {'f' * 12} · machine Fast CPU, 2 cores"
    assert head.startswith(f"cutoff 10 s · {traced}") and head.endswith("20 rows")
    assert render_directory(tmp_path) == written
    store(tmp_path, rows(count=11)[10:11], git_commit="b" * 40, git_dirty=True)
    head = render_directory(tmp_path).texts["table.md"].splitlines()[2]
    assert f"commit {'a' * 12} and {'b' * 12} WITH UNCOMMITTED CHANGES" in head


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
