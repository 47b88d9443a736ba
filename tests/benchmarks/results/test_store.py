"""Rows, and results directories that keep rows and paths after any interruption."""

import json
import os

import numpy as np
import pytest
from made_rows import CONFIGURATION, a_failure, a_row, names
from refusals import refused

from cvqmpt_lab.base.errors import CvqmptError, InvalidInputError, RunStoreError
from cvqmpt_lab.benchmarks.results.provenance import ProvenanceFile, digests_in, provenance
from cvqmpt_lab.benchmarks.results.row import (
    ROW_COLUMNS,
    RUNS_FILE,
    cell_text,
    read_rows,
    write_rows,
)
from cvqmpt_lab.benchmarks.results.store import (
    PARTIAL_FILE,
    PARTIAL_PATHS,
    PATHS_FILE,
    RunStore,
    states_hash,
    stored_paths,
)


def path(seed):
    return np.random.default_rng(seed).standard_normal((40, 7))


def row(seed, **values):
    return a_row(f"p{seed}", path_sha256=states_hash(path(seed)), **values)


def opened(folder, **session):
    return RunStore.open(folder, CONFIGURATION, session)


def open_refused(words, folder, error=RunStoreError, **session):
    refused(words, opened(folder, **session).__enter__, error=error)


def killed_after(folder, *runs):
    """Write runs, each (rows, paths); return the partial files that a killed process leaves."""
    with opened(folder) as store:
        for run in runs:
            store.append(*run)
        left = {path.name: path.read_bytes() for path in folder.glob("*.partial.*")}
    for name in (RUNS_FILE, PATHS_FILE):
        (folder / name).unlink(missing_ok=True)
    return left


@pytest.fixture
def store(tmp_path):
    folder = tmp_path / "store"
    with opened(folder) as store:
        store.append([row(1)], [path(1)])
        store.append([row(2), row(3)], [path(2), path(3)])
    return folder


def test_a_store_has_rows_provenance_and_paths_equal_in_every_bit(tmp_path, store):
    directory = tmp_path / "deep" / "runs"
    with opened(directory, command=("a", "b")) as other:
        other.append([a_row("p2")])
        other.append([a_failure("p1")])
        assert other.done() == {("place", "p1", "birrt", 0, "compiled"), a_row("p2").key}
    assert names(directory) == ["provenance.json", RUNS_FILE]
    assert [row.problem for row in read_rows(directory / RUNS_FILE)] == ["p1", "p2"]
    record = json.loads((directory / "provenance.json").read_text())
    assert record["configuration"] == CONFIGURATION and record["command"] == ["a", "b"]
    assert names(store) == [PATHS_FILE, "provenance.json", RUNS_FILE]
    kept = stored_paths(store)
    assert set(kept) == {row.path_sha256 for row in read_rows(store / RUNS_FILE)} and len(kept) == 3
    for seed in (1, 2, 3):
        assert kept[states_hash(path(seed))].tobytes() == path(seed).tobytes()


def test_the_rows_of_one_run_are_kept_together_or_not_at_all(tmp_path):
    phases = [a_row(f"3/{k}-{name}") for k, name in enumerate(("reach", "carry"), 1)]
    data = killed_after(tmp_path, [phases])[PARTIAL_FILE]
    # truncate after the header and the first phase
    header, first, _ = data.split(b"\n", 2)
    (tmp_path / PARTIAL_FILE).write_bytes(header + b"\n" + first + b"\n")
    with opened(tmp_path) as again:
        assert again.rows() == [] and again.done() == frozenset()
        again.append(phases)
        assert again.done() == {("place", "3", "birrt", 0, "compiled")}


def test_a_truncated_last_line_is_ignored_wherever_it_was_cut(tmp_path):
    rows = [a_row("p1", t_total_s=1.25), a_row("p2", sampler_used='μμμμμμμ, "b"', t_total_s=1.25)]
    data = killed_after(tmp_path, *([[row]] for row in rows))[PARTIAL_FILE]
    first = data.index(b"\n\n") + 2
    for cut in [*range(0, len(data), 3), first - 1, first, len(data)]:
        (tmp_path / RUNS_FILE).unlink(missing_ok=True)
        (tmp_path / PARTIAL_FILE).write_bytes(data[:cut])
        with opened(tmp_path) as again:
            assert again.rows() == rows[: 2 if cut == len(data) else int(cut >= first)]


@pytest.mark.parametrize("cut", [1, 8, 60, 130, 1000])
def test_an_incomplete_path_of_a_killed_process_is_dropped_and_the_others_stay(tmp_path, cut):
    left = killed_after(tmp_path, ([row(1)], [path(1)]), ([row(2)], [path(2)]))
    whole = len(left[PARTIAL_PATHS]) // 2
    (tmp_path / PARTIAL_PATHS).write_bytes(left[PARTIAL_PATHS][: whole + cut])
    (tmp_path / PARTIAL_FILE).write_bytes(left[PARTIAL_FILE].partition(b"\n\n")[0] + b"\n\n")
    with opened(tmp_path) as again:
        again.append([row(2)], [path(2)])
    assert set(stored_paths(tmp_path)) == {states_hash(path(1)), states_hash(path(2))}


def test_a_damaged_store_is_refused_by_name_and_stops_a_run_before_it_begins(store):
    good = (store / PATHS_FILE).read_bytes()
    for where in (0.2, 0.5, 0.999):
        data = bytearray(good)
        data[int(where * len(data))] ^= 0xFF
        (store / PATHS_FILE).write_bytes(bytes(data))
        open_refused(r"paths\.npz is damaged.*another folder", store)
    forged = path(1)
    forged[0, 0] += 1e-15
    np.savez_compressed(store / PATHS_FILE, **{states_hash(path(1)): forged})
    refused(r"paths\.npz is damaged.*another hash", stored_paths, store, error=RunStoreError)


def test_other_weights_are_refused_by_both_digests_and_further_models_are_added(tmp_path):
    with opened(tmp_path, weights={}) as store:
        store.append([a_row("p1")])
    with opened(tmp_path, weights={"mpnet": "aaa"}) as store:
        store.append([a_row("p1", "mpnet")])
    assert digests_in(ProvenanceFile(tmp_path).read(), "weights") == {"mpnet": "aaa"}
    message = r'weights.mpnet was "aaa", now "bbb".*--out'
    open_refused(message, tmp_path, weights={"mpnet": "bbb"})
    for weights in ({"vq_mpt": "ccc"}, {}):
        with opened(tmp_path, weights=weights):
            pass


def test_another_configuration_is_refused_by_setting(tmp_path):
    with opened(tmp_path) as store:
        store.append([a_row()])
    for change, words in (
        ({"cutoff_s": 20.0}, "cutoff_s was 10.0, now 20.0"),
        ({"tolerance": {"rad": 0.2}}, "tolerance.rad was 0.1, now 0.2"),
        ({"range": 2}, "range was null, now 2"),
    ):
        other = RunStore.open(tmp_path, {**CONFIGURATION, **change})
        line = refused(words, other.__enter__, error=RunStoreError)
        assert "--out" in line and "suite" not in line
    # equal by value, and not left locked
    with RunStore.open(tmp_path, {**CONFIGURATION, "cutoff_s": 10}):
        pass


def test_runs_without_provenance_or_with_foreign_columns_are_refused(tmp_path):
    with opened(tmp_path / "new"):
        pass
    (tmp_path / "new" / PARTIAL_FILE).write_text("1,place,rubbish\n\n")
    open_refused(r"runs\.partial\.csv, line 1", tmp_path / "new")
    write_rows(tmp_path / RUNS_FILE, [a_row()])
    open_refused(r"no provenance\.json.*--out", tmp_path)
    for broken in ("not json", "[]", '{"configuration": 3}', "[" * 100_000):
        (tmp_path / "provenance.json").write_text(broken)
        open_refused(r"provenance\.json", tmp_path, error=InvalidInputError)
    (tmp_path / "provenance.json").write_text(json.dumps({"configuration": CONFIGURATION}))
    (tmp_path / RUNS_FILE).write_text("problem,time\n1,2\n")
    open_refused("line 1, column 1: expected schema, found problem", tmp_path)


def test_rows_of_another_suite_stop_a_run_before_it_begins(store):
    write_rows(store / RUNS_FILE, [a_row("p1", suite="maze"), a_row("p2")])
    open_refused("runs.csv has rows of maze, but provenance.json is of suite place", store)


def test_directories_that_cannot_be_used_are_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        open_refused("cannot make folder", path, error=InvalidInputError)
    with opened(tmp_path / "new"):
        open_refused("in use", tmp_path / "new", error=InvalidInputError)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    open_refused("read-only", tmp_path / "sealed")


def test_provenance_names_versions_machine_and_seeds():
    record = provenance(["cvqmpt", "run"], np.arange(3), {"mpnet": "abc"}, 2)
    assert json.loads(json.dumps(record)) == record
    assert record["seeds"] == [0, 1, 2] and record["processes"] == 2
    assert record["weights"] == {"mpnet": "abc"}
    assert record["versions"]["numpy"] == np.__version__
    assert {"pin", "coal", "ompl", "numba", "torch", "rerun-sdk"} < set(record["versions"])
    assert record["cpu_count"] >= 1 and record["date_utc"].endswith("+00:00")


def test_rows_of_another_rule_of_random_streams_are_refused_by_name(tmp_path):
    """Records without the field are of rule 1, by the start alone."""
    with RunStore.open(tmp_path, {"suite": "place"}, {}) as store:
        store.append([a_row()])
    with pytest.raises(RunStoreError, match=r"rule of random streams was 1, now 2.*another --out"):
        RunStore.open(tmp_path, {"suite": "place"}, {"streams": 2}).__enter__()
    with RunStore.open(tmp_path, {"suite": "place"}, {}) as store:
        store.append([a_row("p2")])


def test_a_malformed_record_is_refused_by_field(tmp_path):
    file = ProvenanceFile(tmp_path)
    file.create({"cutoff_s": 10.0}, provenance(["cvqmpt"], [0], {"mpnet": "abc"}))
    good = file.read()
    for changes, words in (
        ({"continued": 3}, "continued is 3"),
        ({"continued": [None]}, r"continued\[0\] is None"),
        ({"git_commit": 7}, "git_commit is 7"),
        ({"platform": 7}, "platform is 7"),
        ({"versions": [1]}, "versions is .1."),
        ({"weights": {"mpnet": None}}, "weights.mpnet is None"),
        ({"configuration": {"cutoff_s": "10"}}, "cutoff_s is '10'"),
    ):
        file.path.write_text(json.dumps(good | changes))
        refused(rf"provenance.json: {words}", file.read)


def test_files_from_before_the_last_columns_are_read(tmp_path):
    path, row = tmp_path / "rows.csv", a_row(t_total_s=1.5, path_sha256="0" * 64)
    for gone in (1, len(ROW_COLUMNS) - ROW_COLUMNS.index("t_sense_s")):
        write_rows(path, [row])
        lines = path.read_text().splitlines()
        path.write_text("".join(",".join(line.split(",")[:-gone]) + "\n" for line in lines))
        assert read_rows(path) == [row]
    lines = path.read_text().splitlines()
    path.write_text("".join(line.rpartition(",")[0] + "\n" for line in lines))
    refused("column 31: expected path_sha256, found nothing", read_rows, path, error=RunStoreError)


def test_measures_of_one_suite_are_columns_after_all_others_and_survive_a_killed_process(tmp_path):
    plain = a_row("p1")
    write_rows(tmp_path / "plain.csv", [plain])
    assert "measure" not in (tmp_path / "plain.csv").read_text()
    rows = [a_row("p2", measures={"drift_mm": 0.1, "contacts": 3}), a_row("p3")]
    write_rows(tmp_path / "rows.csv", [plain, *rows])
    header, *lines = (tmp_path / "rows.csv").read_text().splitlines()
    assert header.endswith(",measure:drift_mm,measure:contacts") and lines[1].endswith(",0.1,3.0")
    found = read_rows(tmp_path / "rows.csv")
    assert found[1] == rows[0] and found[2].measures == {"drift_mm": None, "contacts": None}
    data = killed_after(tmp_path / "killed", [[rows[0]]], [[plain]])[PARTIAL_FILE]
    (tmp_path / "killed" / PARTIAL_FILE).write_bytes(data)
    with opened(tmp_path / "killed") as store:
        assert [row.measures for row in store.rows()] == [{}, rows[0].measures]
    refused("measure:drift_mm is 'far'", a_row, error=CvqmptError, measures={"drift_mm": "far"})


def test_bad_values_are_refused_by_name():
    for values, word in (
        ({"path_length_rad": -1.0}, "path_length_rad"),
        ({"t_total_s": float("nan")}, "t_total_s"),
        *(({"vertices": value}, "vertices") for value in (3.0, True)),
        *(({"detail": text}, "detail") for text in ("", "two\nlines")),
        ({"suite": "=1+1"}, "suite is '=1[+]1'.*formula"),
        ({"planner": "@x"}, "planner"),
        ({"solved": False, "fail_reason": "bored"}, "'bored'; valid choices: timeout, iteration"),
        ({"solved": False}, "solved is False but fail_reason is None"),
        ({"fail_reason": "timeout"}, "solved is True but fail_reason is timeout"),
        *(({name: value}, name) for name, value in BAD.items()),
    ):
        refused(word, a_row, error=CvqmptError, **values)


BAD = {"seed": None, "solved": 1, "certified": False, "schema": "0"}
TEXTS = {"two\n lines\x1b": "two lines", "=1+1": "'=1+1", "-3 off": "'-3 off", " \t": None}


def test_a_file_that_was_cut_within_its_last_number_is_refused(tmp_path):
    path = tmp_path / RUNS_FILE
    write_rows(path, [a_row(measures={"drift_mm": 14.557})])
    whole = path.read_bytes()
    for cut in (whole[:-1], whole[:-3]):
        path.write_bytes(cut)
        refused("line 2: the file ends within this line", read_rows, path, error=RunStoreError)
    path.write_bytes(whole.replace(b"\n", b"\r\n"))
    assert read_rows(path)[0].measures == {"drift_mm": 14.557}


def test_no_text_becomes_a_formula_of_a_spreadsheet():
    for text, cell in (*TEXTS.items(), ("ok", "ok")):
        assert cell_text(text) == a_row(detail=cell_text(text)).detail == cell


FIELDS = {"seed": "one", "t_total_s": "nan", "vertices": "-1", "solved": "True", "schema": "1"}


def test_a_malformed_file_of_rows_is_refused_by_line_and_column(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [a_row("p1", t_total_s=1.0), a_row("p2", t_total_s=1.0)])
    good = path.read_text()
    *lines, last = good.splitlines()
    cases = [
        (good.replace("backend", "engine"), "line 1, column 7: expected backend, found engine"),
        ("schema\x1b[31m" + "x" * 9000, "found schema.*use another --out"),
        ("", "expected schema, found nothing"),
        (good[:-3], f"line 3: {len(ROW_COLUMNS) - 2} fields, expected {len(ROW_COLUMNS)}"),
    ]
    for column, text in (*FIELDS.items(), ("t_total_s", "fast")):
        fields = last.split(",")
        fields[ROW_COLUMNS.index(column)] = text
        bad = "\n".join([*lines, ",".join(fields)]) + "\n"
        cases.append((bad, f"rows.csv, line 3: {column} is '?{text}"))
    for text, words in cases:
        path.write_text(text)
        line = refused(words, read_rows, path, error=RunStoreError)
        assert line.isprintable() and len(line) < 600
