"""Paths beside rows: they match their hashes after any interruption; damage is named."""

import numpy as np
import pytest
from made_rows import CONFIGURATION, a_row, names

from cvqmpt_lab.errors import RunStoreError
from cvqmpt_lab.results.row import RUNS_FILE, read_rows
from cvqmpt_lab.results.store import PARTIAL_PATHS, PATHS_FILE, RunStore, StoredPaths, states_hash


def path(seed):
    return np.random.default_rng(seed).standard_normal((40, 7))


def row(seed, **values):
    return a_row(f"p{seed}", path_sha256=states_hash(path(seed)), **values)


@pytest.fixture
def store(tmp_path):
    with RunStore.open(tmp_path, CONFIGURATION) as store:
        store.append([row(1)], [path(1)])
        store.append([row(2), row(3)], [path(2), path(3)])
    return tmp_path


def test_what_was_hashed_comes_back_bit_for_bit(store):
    assert names(store) == [PATHS_FILE, "provenance.json", RUNS_FILE]
    kept = StoredPaths(store)
    assert set(kept) == {row.path_sha256 for row in read_rows(store / RUNS_FILE)} and len(kept) == 3
    for seed in (1, 2, 3):
        assert kept[states_hash(path(seed))].tobytes() == path(seed).tobytes()
    assert np.load(store / PATHS_FILE)[states_hash(path(2))].shape == (40, 7), (
        "no reader of ours is needed"
    )


@pytest.mark.parametrize("cut", [1, 8, 60, 130, 1000])
def test_a_path_cut_short_by_a_kill_is_left_out_and_the_others_stay(tmp_path, cut):
    killed = RunStore.open(tmp_path, CONFIGURATION)
    killed.append([row(1)], [path(1)])
    data = (tmp_path / PARTIAL_PATHS).read_bytes()
    killed.append([row(2)], [path(2)])
    rows = (tmp_path / "runs.partial.csv").read_bytes()
    killed.finish()
    for name in (RUNS_FILE, PATHS_FILE):
        (tmp_path / name).unlink()
    (tmp_path / PARTIAL_PATHS).write_bytes(data + data[:cut])
    (tmp_path / "runs.partial.csv").write_bytes(rows[: rows.index(b"\n\n") + 2])
    with RunStore.open(tmp_path, CONFIGURATION) as again:
        again.append([row(2)], [path(2)])
    assert set(StoredPaths(tmp_path)) == {states_hash(path(1)), states_hash(path(2))}


def test_a_damaged_store_is_refused_by_name_and_stops_a_run_before_it_begins(store):
    good = (store / PATHS_FILE).read_bytes()
    for where in (0.2, 0.5, 0.999):
        data = bytearray(good)
        data[int(where * len(data))] ^= 0xFF
        (store / PATHS_FILE).write_bytes(bytes(data))
        with pytest.raises(RunStoreError, match=r"paths\.npz is damaged"):
            dict(StoredPaths(store))
    (store / PATHS_FILE).write_bytes(b"no zip")
    with pytest.raises(RunStoreError, match=r"paths\.npz is damaged.*another folder"):
        RunStore.open(store, CONFIGURATION)


def test_another_path_under_a_row_s_hash_is_refused(store):
    forged = {states_hash(path(1)): path(1) + 1e-16 * (path(1) == path(1).max())}
    forged[states_hash(path(1))][0, 0] += 1e-15
    np.savez_compressed(store / PATHS_FILE, **forged)
    with pytest.raises(RunStoreError, match=r"paths\.npz is damaged.*another hash"):
        StoredPaths(store)[states_hash(path(1))]
