"""The reader of training paths: splits, thinning, and what it refuses."""

import json
import os
import shutil

import numpy as np
import pytest
from training_data import LOWER, UPPER, shard, write_dataset, write_shard

from cvqmpt_lab.errors import CvqmptError, InvalidInputError
from cvqmpt_lab.training.dataset import open_dataset, with_few_trivial


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("data") / "paths")


@pytest.fixture(scope="module")
def dataset(folder):
    return open_dataset(folder)


def test_shards_are_joined_with_rows_counted_through(folder, dataset):
    assert dataset.robot.name == "panda" and dataset.families == ("cubes",)
    assert len(dataset.scenes) == 6 and len(dataset.paths) == 42
    assert dataset.scenes.seed.tolist() == [20, 1, 2, 40, 3, 4]
    assert dataset.paths.scene.tolist() == np.repeat(np.arange(6), 7).tolist()
    second = np.load(folder / "shards" / "000001.npz")
    for path in (0, 20):
        rows = slice(second["path_start"][path], second["path_start"][path + 1])
        np.testing.assert_array_equal(
            dataset.paths.joints(21 + path), second["waypoints"][rows] / np.float32(65535)
        )
    np.testing.assert_array_equal(dataset.scenes.shapes(4).size, second["shape_size"][5:10])
    assert dataset.paths.twin_of[22] == 21 and dataset.paths.twin_of[21] == -1


def test_splits_go_by_scene_seed_and_leave_twins_out(dataset):
    train, validation = dataset.split("train"), dataset.split("validation")
    assert set(dataset.scenes.seed[dataset.paths.scene[validation]]) == {20, 40}
    assert len(train) == 24 and len(validation) == 12  # 6 of 7 paths of a scene are no twins
    assert (dataset.paths.twin_of[np.concatenate((train, validation))] == -1).all()
    with pytest.raises(CvqmptError, match="unknown split 'test'; valid choices: train, validation"):
        dataset.split("test")


def test_the_share_of_trivial_paths_is_capped_and_drawn(dataset):
    rows = np.arange(42)
    kept = with_few_trivial(dataset.paths, rows, 0.2, np.random.default_rng(0))
    trivial = dataset.paths.trivial[kept]
    assert (~trivial).sum() == 28 and trivial.sum() == 7 and (np.diff(kept) > 0).all()
    again = with_few_trivial(dataset.paths, rows, 0.2, np.random.default_rng(0))
    other = with_few_trivial(dataset.paths, rows, 0.2, np.random.default_rng(1))
    assert kept.tolist() == again.tolist() != other.tolist()
    assert len(with_few_trivial(dataset.paths, rows, 1.0, np.random.default_rng(0))) == 42
    only = np.flatnonzero(dataset.paths.trivial)
    assert len(with_few_trivial(dataset.paths, only, 0.1, np.random.default_rng(0))) == len(only)


@pytest.mark.parametrize("spacing", [0.2, 0.5, 100.0])
def test_thinning_keeps_ends_and_spaces_evenly(dataset, spacing):
    thin = dataset.thinned(spacing)
    span = np.array(UPPER) - LOWER
    assert len(thin.paths) == 42
    for path in range(42):
        before, after = dataset.paths.joints(path), thin.paths.joints(path)
        np.testing.assert_array_equal(after[[0, -1]], before[[0, -1]])
        length = np.linalg.norm(np.diff(before * span, axis=0), axis=1).sum()
        assert len(after) == max(1, int(np.ceil(length / spacing))) + 1 or spacing < 0.3
        steps = np.linalg.norm(np.diff(after * span, axis=0), axis=1)
        assert steps.max() <= spacing + 0.131
        assert {tuple(row) for row in after} <= {tuple(row) for row in before}
    with pytest.raises(InvalidInputError, match="spacing of waypoints is 0"):
        dataset.thinned(0.0)


def test_a_missing_or_foreign_folder_is_named(tmp_path):
    with pytest.raises(InvalidInputError, match=r"no dataset in .*nowhere"):
        open_dataset(tmp_path / "nowhere")
    write_dataset(tmp_path / "later", schema=2)
    with pytest.raises(InvalidInputError, match="schema is 2; this version reads 1"):
        open_dataset(tmp_path / "later")
    for name, value in (
        ("upper", LOWER),
        ("lower", "low"),
        ("families", []),
        ("kinematics", {"rotation": [1]}),
    ):
        write_dataset(tmp_path / name, **{name: value})
        with pytest.raises(InvalidInputError, match=name):
            open_dataset(tmp_path / name)


def test_damaged_and_missing_shards_are_named(tmp_path):
    folder = write_dataset(tmp_path / "d")
    path = folder / "shards" / "000001.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[:-100] + bytes(100))
    with pytest.raises(InvalidInputError, match=r"000001.npz is damaged \(sha256\)"):
        open_dataset(folder)
    with pytest.raises(InvalidInputError, match=r"000001.npz is not a readable archive"):
        open_dataset(folder, verify=False)
    path.unlink()
    with pytest.raises(InvalidInputError, match=r"cannot read .*000001.npz"):
        open_dataset(folder)
    path.write_bytes(whole)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InvalidInputError, match=r"000001.npz: it is not a regular file"):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[:-3], "is cut short; generate again"),
        (lambda text: text[:-30], "is cut short"),
        (lambda text: text[:-30] + "\n", "line 3 is damaged"),
        (lambda text: text + "000002,abc\n", "line 4 is damaged"),
        (lambda text: text + "../000001,abc,3,21\n", "line 4 is damaged"),
        (lambda text: text + text.splitlines()[1] + "\n", "lists a shard twice"),
        (lambda text: text.splitlines()[0] + "\n", "lists no shard"),
        (lambda text: "shard,paths\n0,1\n", "the first line must be shard,sha256,scenes,paths"),
        (lambda text: "", "the first line must be"),
    ],
)
def test_a_damaged_index_is_refused(folder, tmp_path, change, message):
    shutil.copytree(folder, tmp_path / "d")
    index = tmp_path / "d" / "shards.csv"
    index.write_text(change(index.read_text()))
    with pytest.raises(InvalidInputError, match=f"shards.csv.*{message}"):
        open_dataset(tmp_path / "d")


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"a": ' * 100_000, '{"schema": 1}', '{"schema": 1, "schema": 1}']
)
def test_a_damaged_description_is_one_line(folder, tmp_path, text):
    shutil.copytree(folder, tmp_path / "d")
    (tmp_path / "d" / "dataset.json").write_text(text)
    with pytest.raises(InvalidInputError, match=r"dataset\.json") as caught:
        open_dataset(tmp_path / "d")
    assert "\n" not in str(caught.value)


def test_a_shard_damaged_anywhere_is_refused_or_reads_the_same(folder, tmp_path):
    """Without checksums: every 97th byte turned over, and the file cut there."""
    shutil.copytree(folder, tmp_path / "d")
    path = tmp_path / "d" / "shards" / "000000.npz"
    whole = path.read_bytes()
    refused = 0
    for place in range(0, len(whole), 97):
        for damaged in (whole[:place], whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :]):
            path.write_bytes(damaged)
            try:
                open_dataset(tmp_path / "d", verify=False)
            except InvalidInputError as error:
                assert "000000.npz" in str(error)
                refused += 1
    assert refused > len(whole) / 97


def test_a_pickle_in_a_shard_is_refused(tmp_path):
    folder = write_dataset(tmp_path / "d")
    arrays = shard(np.random.default_rng(5), (7,), 2)
    write_shard(folder, 2, {**arrays, "family": np.array([{"a": 1}], dtype=object)})
    with pytest.raises(InvalidInputError, match=r"000002.npz is not a readable archive.*: .*pickle"):
        open_dataset(folder)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("waypoints", lambda a: a[:, :6]),
        ("waypoints", lambda a: a.astype(np.int64)),
        ("path_start", lambda a: a[:-1]),
        ("path_scene", lambda a: a + 9),
        ("twin_of", lambda a: a + 99),
        ("shape_kind", lambda a: a + 3),
        ("shape_pose", lambda a: a * np.nan),
        ("trivial", lambda a: a[1:]),
    ],
)
def test_arrays_that_contradict_each_other_are_named(tmp_path, name, change):
    arrays = shard(np.random.default_rng(5), (7, 8), 3)
    folder = write_dataset(tmp_path / "d", shards=())
    write_shard(folder, 0, {**arrays, name: change(arrays[name])})
    with pytest.raises(InvalidInputError, match=rf"000000.npz: .*{name}"):
        open_dataset(folder)


def test_without_validation_scenes_nothing_is_trained(tmp_path):
    dataset = open_dataset(write_dataset(tmp_path / "d", shards=((1, 2),)))
    with pytest.raises(InvalidInputError, match="no validation path"):
        dataset.require_splits()


def test_the_hash_tells_datasets_apart(tmp_path, dataset):
    same = open_dataset(write_dataset(tmp_path / "same"))
    other = open_dataset(write_dataset(tmp_path / "other", seed=1))
    assert dataset.sha256 == same.sha256 != other.sha256
    assert json.loads((tmp_path / "same" / "dataset.json").read_text())["schema"] == 1
