import json
import os

import pytest
from made_rows import CONFIGURATION, a_failure, a_row, names

from cvqmpt_lab.errors import InvalidInputError, RunStoreError
from cvqmpt_lab.results.provenance import ProvenanceFile, digests_in
from cvqmpt_lab.results.row import RUNS_FILE, read_rows, write_rows
from cvqmpt_lab.results.store import PARTIAL_FILE, RunStore


def test_store_writes_rows_and_provenance(tmp_path):
    with RunStore.open(tmp_path / "deep" / "runs", CONFIGURATION, {"command": ("a", "b")}) as store:
        store.append([a_row("p2")])
        store.append([a_failure("p1")])
        assert store.done() == {("place", "p1", "birrt", 0, "compiled"), a_row("p2").key}
    directory = tmp_path / "deep" / "runs"
    assert names(directory) == ["provenance.json", RUNS_FILE]
    assert [row.problem for row in read_rows(directory / RUNS_FILE)] == ["p1", "p2"]
    record = json.loads((directory / "provenance.json").read_text())
    assert record["configuration"] == CONFIGURATION and record["command"] == ["a", "b"]


def test_the_rows_of_one_run_are_kept_together_or_not_at_all(tmp_path):
    phases = [a_row(f"3/{k}-{name}") for k, name in enumerate(("reach", "carry"), 1)]
    store = RunStore.open(tmp_path, CONFIGURATION)
    store.append(phases)
    assert store.done() == {("place", "3", "birrt", 0, "compiled")}
    data = (tmp_path / PARTIAL_FILE).read_bytes()
    store.finish()
    (tmp_path / RUNS_FILE).unlink()
    # cut behind the first phase
    (tmp_path / PARTIAL_FILE).write_bytes(data[: data.index(b"\n") + 1])
    with RunStore.open(tmp_path, CONFIGURATION) as again:
        assert again.rows() == [] and again.done() == frozenset()


def test_other_weights_are_refused_by_both_digests_and_further_models_are_added(tmp_path):
    with RunStore.open(tmp_path, CONFIGURATION, {"weights": {}}) as store:
        store.append([a_row("p1")])
    with RunStore.open(tmp_path, CONFIGURATION, {"weights": {"mpnet": "aaa"}}) as store:
        store.append([a_row("p1", "mpnet")])
    assert digests_in(ProvenanceFile(tmp_path).read(), "weights") == {"mpnet": "aaa"}
    with pytest.raises(RunStoreError, match=r'weights.mpnet was "aaa", now "bbb".*--out'):
        RunStore.open(tmp_path, CONFIGURATION, {"weights": {"mpnet": "bbb"}})
    RunStore.open(tmp_path, CONFIGURATION, {"weights": {"vq_mpt": "ccc"}}).finish()
    RunStore.open(tmp_path, CONFIGURATION, {"weights": {}}).finish()


def test_a_truncated_last_line_is_ignored_wherever_it_was_cut(tmp_path):
    store = RunStore.open(tmp_path, CONFIGURATION)
    rows = [a_row("p1", t_total_s=1.25), a_row("p2", sampler_used='μμμμμμμ, "b"', t_total_s=1.25)]
    for row in rows:
        store.append([row])
    data = (tmp_path / PARTIAL_FILE).read_bytes()
    store.finish()
    first = data.index(b"\n\n") + 2
    for cut in [*range(0, len(data), 3), first - 1, first, len(data)]:
        (tmp_path / RUNS_FILE).unlink(missing_ok=True)
        (tmp_path / PARTIAL_FILE).write_bytes(data[:cut])
        with RunStore.open(tmp_path, CONFIGURATION) as again:
            assert again.rows() == rows[: 2 if cut == len(data) else int(cut >= first)]


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
        store.append([a_row()])
    with pytest.raises(RunStoreError, match=words) as caught:
        RunStore.open(tmp_path, {**CONFIGURATION, **change})
    assert "--out" in str(caught.value) and "suite" not in str(caught.value)
    # equal by value, and not left locked
    RunStore.open(tmp_path, {**CONFIGURATION, "cutoff_s": 10}).finish()


def test_runs_without_provenance_or_with_foreign_columns_are_refused(tmp_path):
    with RunStore.open(tmp_path / "new", CONFIGURATION):
        pass
    (tmp_path / "new" / PARTIAL_FILE).write_text("1,place,rubbish\n\n")
    with pytest.raises(RunStoreError, match=r"runs\.partial\.csv, line 1"):
        RunStore.open(tmp_path / "new", CONFIGURATION)
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


def test_directories_and_configurations_that_cannot_be_used_are_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for value in (float("inf"), object()):
        with pytest.raises(RunStoreError, match="configuration"):
            RunStore.open(tmp_path / "new", {"cutoff_s": value})
    assert names(tmp_path / "new") == []
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(RunStoreError, match="--out"):
            RunStore.open(path, CONFIGURATION)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(RunStoreError, match="read-only"):
        RunStore.open(tmp_path / "sealed", CONFIGURATION)


def test_two_runs_cannot_share_a_directory_and_a_finished_store_takes_no_rows(tmp_path):
    with RunStore.open(tmp_path, CONFIGURATION), pytest.raises(InvalidInputError, match="in use"):
        RunStore.open(tmp_path, CONFIGURATION)
    store = RunStore.open(tmp_path, CONFIGURATION)
    store.finish()
    store.finish()
    with pytest.raises(RunStoreError, match="finished"):
        store.append([a_row()])
