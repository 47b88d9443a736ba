import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cvqmpt_lab.errors import InvalidInputError, RunStoreError
from cvqmpt_lab.results import provenance as provenance_module
from cvqmpt_lab.results.provenance import ProvenanceFile, provenance, write_text_atomic
from cvqmpt_lab.results.store import (
    COLUMNS,
    PARTIAL_FILE,
    RUNS_FILE,
    ResultRow,
    RunStore,
    read_rows,
    write_rows,
)

CONFIGURATION = {"suite": "place", "cutoff_s": 10.0, "tolerance": {"rad": 0.1}}


def a_row(problem="place_0", planner="birrt", **values):
    defaults = {"suite": "place", "seed": 0, "backend": "compiled", "status": "solved", "solved": True}
    return ResultRow(problem=problem, planner=planner, **{**defaults, "certified": True, **values})


def a_failure(problem="place_0", planner="birrt", **values):
    return a_row(problem, planner, status="timeout", solved=False, certified=None, **values)


def names(directory):
    return sorted(path.name for path in directory.iterdir())


# ---------------------------------------------------------------- rows


def test_columns_are_the_documented_ones():
    assert ",".join(COLUMNS) == (
        "schema,suite,problem,planner,sampler_used,seed,backend,status,fail_reason,solved,certified,"
        "t_total_s,t_observe_s,t_goals_s,t_encode_s,t_predict_s,t_optimize_s,t_plan_s,t_simplify_s,"
        "n_projections,n_newton_iterations,n_state_checks,n_iterations,vertices,path_length_raw_rad,"
        "path_length_rad,execution_time_s,max_violation_rad,max_violation_m,min_clearance_m,path_sha256"
    )


def test_rows_come_back_exactly(tmp_path):
    rng = np.random.default_rng(1)
    rows = [a_row(f"p{i}", t_total_s=float(x)) for i, x in enumerate(rng.lognormal(size=50) * 1e-3)]
    rows += [
        a_failure("p50", fail_reason='said "no", twice', min_clearance_m=-0.25, n_projections=2**60),
        a_row("p51", t_total_s=0.1 + 0.2, sampler_used="μ, σ", path_sha256="0" * 64, vertices=0),
    ]
    write_rows(tmp_path / "rows.csv", rows)
    assert read_rows(tmp_path / "rows.csv") == rows


def test_numpy_scalars_become_python_values(tmp_path):
    row = a_row(seed=np.int64(3), solved=np.bool_(True), t_total_s=np.float64(0.1), vertices=np.int32(4))
    assert [type(v) for v in (row.seed, row.solved, row.t_total_s, row.vertices)] == [int, bool, float, int]
    write_rows(tmp_path / "rows.csv", [row])
    assert "np." not in (tmp_path / "rows.csv").read_text()


def test_undefined_is_empty_and_booleans_are_words(tmp_path):
    write_rows(tmp_path / "rows.csv", [a_failure(t_total_s=10.0)])
    fields = (tmp_path / "rows.csv").read_text().splitlines()[1].split(",")
    named = dict(zip(COLUMNS, fields, strict=True))
    assert named["vertices"] == named["path_length_rad"] == named["certified"] == ""
    assert (named["solved"], named["t_total_s"]) == ("false", "10.0")


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"path_length_rad": -1.0}, "path_length_rad"),
        ({"t_total_s": float("nan")}, "t_total_s"),
        ({"vertices": 3.0}, "vertices"),
        ({"vertices": True}, "vertices"),
        ({"fail_reason": ""}, "fail_reason"),
        ({"fail_reason": "two\nlines"}, "fail_reason"),
        ({"seed": None}, "seed"),
        ({"solved": 1}, "solved"),
        ({"certified": False}, "certified"),
        ({"schema": "0"}, "schema"),
    ],
)
def test_bad_values_are_refused_by_name(values, word):
    with pytest.raises(InvalidInputError, match=word):
        a_row(**values)


def test_order_is_deterministic_and_counts_numbers(tmp_path):
    rows = [a_row(p, planner=m, seed=s) for p in ("p10", "p2", "p02") for m in ("b", "a") for s in (1, 0)]
    write_rows(tmp_path / "one.csv", rows)
    write_rows(tmp_path / "two.csv", rows[::-1])
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()
    keys = [(r.problem, r.planner, r.seed) for r in read_rows(tmp_path / "one.csv")]
    assert keys[:4] == [("p02", "a", 0), ("p02", "a", 1), ("p02", "b", 0), ("p02", "b", 1)]
    assert [k[0] for k in keys[::4]] == ["p02", "p2", "p10"]


def edit(path, column, text, line=2):
    lines = path.read_text().splitlines()
    fields = lines[line - 1].split(",")
    fields[COLUMNS.index(column)] = text
    lines[line - 1] = ",".join(fields)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("column", "text"),
    [
        ("seed", "one"),
        ("t_total_s", "fast"),
        ("t_total_s", "nan"),
        ("vertices", "-1"),
        ("solved", "True"),
        ("schema", "2"),
    ],
)
def test_a_bad_field_is_named_with_file_line_and_column(tmp_path, column, text):
    path = tmp_path / "rows.csv"
    write_rows(path, [a_row("p1", t_total_s=1.0), a_row("p2", t_total_s=1.0)])
    edit(path, column, text, line=3)
    with pytest.raises(RunStoreError, match=f"rows.csv, line 3, column {column}") as caught:
        read_rows(path)
    assert "\n" not in str(caught.value)


def test_a_foreign_header_is_named(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [a_row()])
    path.write_text(path.read_text().replace("backend", "engine"))
    with pytest.raises(RunStoreError, match="line 1, column 7: expected backend, found engine"):
        read_rows(path)
    path.write_text("")
    with pytest.raises(RunStoreError, match="expected schema, found nothing"):
        read_rows(path)


def test_unreadable_files_are_run_store_errors(tmp_path):
    with pytest.raises(RunStoreError, match="cannot read"):
        read_rows(tmp_path / "absent.csv")
    (tmp_path / "rows.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(RunStoreError, match="UTF-8"):
        read_rows(tmp_path / "rows.csv")
    write_rows(tmp_path / "short.csv", [a_row()])
    (tmp_path / "short.csv").write_text((tmp_path / "short.csv").read_text()[:-3])
    with pytest.raises(RunStoreError, match="line 2, column min_clearance_m: 29 fields, expected 31"):
        read_rows(tmp_path / "short.csv")


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch):
    path = tmp_path / "rows.csv"
    write_rows(path, [a_row()])
    before = path.read_bytes()

    def refuse(self, target):
        raise PermissionError(13, "denied")

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(RunStoreError, match="cannot write"):
        write_rows(path, [a_row("p9")])
    assert path.read_bytes() == before and names(tmp_path) == ["rows.csv"]


# ---------------------------------------------------------------- store


def test_store_writes_rows_and_provenance(tmp_path):
    with RunStore.open(tmp_path / "deep" / "runs", CONFIGURATION, {"command": ("a", "b")}) as store:
        store.append(a_row("p2"))
        store.append(a_failure("p1"))
        assert store.done_keys() == {("place", "p1", "birrt", 0, "compiled"), a_row("p2").key}
    directory = tmp_path / "deep" / "runs"
    assert names(directory) == ["provenance.json", RUNS_FILE]
    assert [row.problem for row in read_rows(directory / RUNS_FILE)] == ["p1", "p2"]
    record = json.loads((directory / "provenance.json").read_text())
    assert record["configuration"] == CONFIGURATION and record["command"] == ["a", "b"]


def test_store_continues_and_replaces_repeated_keys(tmp_path):
    with RunStore.open(tmp_path, CONFIGURATION) as store:
        store.append(a_failure("p1"))
    with RunStore.open(tmp_path, dict(reversed(CONFIGURATION.items())), {"git_commit": "abc"}) as store:
        assert len(store.done_keys()) == 1
        store.append(a_row("p1", t_total_s=0.5))
        store.append(a_row("p0"))
    assert [(r.problem, r.solved) for r in read_rows(tmp_path / RUNS_FILE)] == [("p0", True), ("p1", True)]
    assert ProvenanceFile(tmp_path).read()["continued"] == [{"git_commit": "abc"}]


def test_looking_at_a_finished_store_changes_nothing(tmp_path):
    with RunStore.open(tmp_path, CONFIGURATION, {"git_commit": "abc"}) as store:
        store.append(a_row())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with RunStore.open(tmp_path, CONFIGURATION, {"git_commit": "def"}) as store:
        assert store.rows() == [a_row()]
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError])
def test_an_interrupted_block_keeps_its_rows(tmp_path, interruption):
    with pytest.raises(interruption), RunStore.open(tmp_path, CONFIGURATION) as store:
        store.append(a_row("p1"))
        raise interruption
    assert read_rows(tmp_path / RUNS_FILE) == [a_row("p1")]
    assert not (tmp_path / PARTIAL_FILE).exists()


def test_a_killed_process_loses_no_appended_row(tmp_path):
    script = (
        "import os, signal, sys; from pathlib import Path; sys.path.insert(0, sys.argv[2])\n"
        "from test_results import CONFIGURATION, RunStore, a_row\n"
        "store = RunStore.open(Path(sys.argv[1]), CONFIGURATION)\n"
        "for i in range(3): store.append(a_row(f'p{i}', t_total_s=0.1 * i))\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path), str(Path(__file__).parent)]
    assert subprocess.run(command, check=False).returncode == -9
    with RunStore.open(tmp_path, CONFIGURATION) as store:
        assert store.rows() == [a_row(f"p{i}", t_total_s=0.1 * i) for i in range(3)]


def test_a_truncated_last_line_is_ignored_wherever_it_was_cut(tmp_path):
    store = RunStore.open(tmp_path, CONFIGURATION)
    rows = [a_row("p1", t_total_s=1.25), a_row("p2", sampler_used='μμμμμμμ, "b"', t_total_s=1.25)]
    for row in rows:
        store.append(row)
    data = (tmp_path / PARTIAL_FILE).read_bytes()
    store.finish()
    first = data.index(b"\n") + 1
    for cut in [*range(0, len(data), 3), first, len(data)]:
        (tmp_path / RUNS_FILE).unlink(missing_ok=True)
        (tmp_path / PARTIAL_FILE).write_bytes(data[:cut])
        with RunStore.open(tmp_path, CONFIGURATION) as again:
            assert again.rows() == rows[: 2 if cut == len(data) else int(cut >= first)]


def test_a_damaged_line_that_is_not_the_last_is_an_error(tmp_path):
    with RunStore.open(tmp_path, CONFIGURATION):
        pass
    (tmp_path / PARTIAL_FILE).write_text("1,place,rubbish\n")
    with pytest.raises(RunStoreError, match=r"runs\.partial\.csv, line 1"):
        RunStore.open(tmp_path, CONFIGURATION)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cutoff_s": 20.0}, "cutoff_s was 10.0, now 20.0"),
        ({"tolerance": {"rad": 0.2}}, "tolerance.rad was 0.1, now 0.2"),
        ({"range": 2}, "range was null, now 2"),
    ],
)
def test_another_configuration_is_refused_by_setting(tmp_path, change, words):
    with RunStore.open(tmp_path, CONFIGURATION) as store:
        store.append(a_row())
    with pytest.raises(RunStoreError, match=words) as caught:
        RunStore.open(tmp_path, {**CONFIGURATION, **change})
    assert "--out" in str(caught.value) and "suite" not in str(caught.value)
    RunStore.open(tmp_path, {**CONFIGURATION, "cutoff_s": 10}).finish()  # equal by value, and not left locked


def test_runs_without_provenance_or_with_foreign_columns_are_refused(tmp_path):
    write_rows(tmp_path / RUNS_FILE, [a_row()])
    with pytest.raises(RunStoreError, match=r"no provenance\.json.*--out"):
        RunStore.open(tmp_path, CONFIGURATION)
    for broken in ("not json", "[]", '{"configuration": 3}', "[" * 100_000):
        (tmp_path / "provenance.json").write_text(broken)
        with pytest.raises(RunStoreError, match=r"provenance\.json"):
            RunStore.open(tmp_path, CONFIGURATION)
    (tmp_path / "provenance.json").write_text(json.dumps({"configuration": CONFIGURATION}))
    (tmp_path / RUNS_FILE).write_text("problem,time\n1,2\n")
    with pytest.raises(RunStoreError, match=r"line 1, column 1: expected schema, found problem"):
        RunStore.open(tmp_path, CONFIGURATION)


def test_directories_that_cannot_be_used_are_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(RunStoreError, match="--out"):
            RunStore.open(path, CONFIGURATION)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(RunStoreError, match="read-only"):
        RunStore.open(tmp_path / "sealed", CONFIGURATION)
    with pytest.raises(RunStoreError, match="cannot write"):
        write_text_atomic(tmp_path / "file" / "below", "")


def test_configuration_must_be_json(tmp_path):
    for value in (float("inf"), object()):
        with pytest.raises(RunStoreError, match="configuration"):
            RunStore.open(tmp_path / "new", {"cutoff_s": value})
    assert names(tmp_path / "new") == []


def test_two_runs_cannot_share_a_directory(tmp_path):
    with RunStore.open(tmp_path, CONFIGURATION), pytest.raises(RunStoreError, match="in use"):
        RunStore.open(tmp_path, CONFIGURATION)
    RunStore.open(tmp_path, CONFIGURATION).finish()


def test_a_finished_store_takes_no_rows(tmp_path):
    store = RunStore.open(tmp_path, CONFIGURATION)
    store.finish()
    store.finish()
    with pytest.raises(RunStoreError, match="finished"):
        store.append(a_row())


def test_a_full_disk_is_an_error_and_leaves_whole_lines(tmp_path, monkeypatch):
    store = RunStore.open(tmp_path, CONFIGURATION)
    store.append(a_row("p1"))

    def full(handle):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(RunStoreError, match="No space left"):
            store.append(a_row("p2"))
    store.finish()
    assert {row.problem for row in read_rows(tmp_path / RUNS_FILE)} == {"p1", "p2"}


# ---------------------------------------------------------------- provenance


def test_provenance_names_versions_machine_and_seeds():
    record = provenance(["cvqmpt", "run"], CONFIGURATION, np.arange(3), "abc", calibration_ns=1.5, threads=1)
    assert json.loads(json.dumps(record)) == record
    assert record["seeds"] == [0, 1, 2] and record["calibration_ns"] == 1.5 and record["model_hash"] == "abc"
    assert record["versions"]["numpy"] == np.__version__
    assert {"pin", "coal", "ompl", "numba", "torch", "rerun-sdk"} < set(record["versions"])
    assert record["cpu_count"] >= 1 and record["date_utc"].endswith("+00:00")


def git(directory, *arguments):
    identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", "-C", directory, *identity, *arguments], check=True, capture_output=True)


def test_git_state_is_read_and_never_fails(tmp_path, monkeypatch):
    root = tmp_path.resolve()
    assert provenance_module._git_state(root) == (None, None)
    git(root, "init")
    assert provenance_module._git_state(root) == (None, False)
    (root / "file").write_text("1")
    git(root, "add", "file")
    git(root, "commit", "-m", "one")
    commit, dirty = provenance_module._git_state(root)
    assert commit is not None and len(commit) == 40 and dirty is False
    (root / "file").write_text("2")
    assert provenance_module._git_state(root) == (commit, True)
    (root / "below").mkdir()
    assert provenance_module._git_state(root / "below") == (None, None)  # another project's repository
    monkeypatch.setenv("PATH", "")
    assert provenance_module._git_state(root) == (None, None)


def test_rows_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        a_row().solved = False
